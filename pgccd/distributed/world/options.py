"""Keyword arguments of `World.create`, `World.add` and `World.step`."""

from collections.abc import Collection, Sequence
from typing import TypedDict

from torch import Tensor

#: Names of payload.
Names = Collection[str]
#: Which bodies may be stopped.
Movable = Tensor | Sequence[bool] | None


class NewBodies(TypedDict, total=False):
    """Of `World.create` and `World.add`: columns of bodies, which `World.create` describes with their defaults."""

    id: Tensor | None
    mesh_index: Tensor | None
    group: Tensor | None
    mask: Tensor | None
    world: Tensor | None
    static: Tensor | None
    margin: Tensor | float | None
    exclude: Tensor | Sequence[Sequence[int]] | None
    self_collision: Tensor | bool
    payload: dict[str, Tensor] | None
    vertex_payload: dict[str, Tensor] | None


def require_known(bodies: NewBodies) -> None:
    """Raises TypeError for a name that is no argument."""
    for name in bodies:
        if name not in NewBodies.__annotations__:
            raise TypeError(f"{name}: expected one of {list(NewBodies.__annotations__)}")
