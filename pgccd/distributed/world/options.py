"""Keyword arguments of `World.create`, `World.load` and `World.add`."""

from collections.abc import Collection, Sequence
from typing import Literal, TypedDict

from torch import Tensor

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.interface import Triple
from pgccd.motion.paths import PathKind
from pgccd.search.broad import BroadPhase
from pgccd.search.checks import Initial

#: Names of payload.
Names = Collection[str]
#: Which bodies may be stopped.
Movable = Tensor | Sequence[bool] | None


class WorldOptions(TypedDict, total=False):
    """Of both, besides `report`."""

    comm: Comm | None
    min_separation: float
    tolerance: float | None
    nonzero_toi: bool
    initial: Initial
    broad_phase: BroadPhase
    path: PathKind
    balance: BalanceOptions | None
    overlap: bool


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


class NewWorld(NewBodies, WorldOptions, total=False):
    """Of `World.create`."""

    partition: Literal["auto", "cells", "bisection"]
    axes: int
    cells: int | Triple


def require_known(bodies: NewBodies) -> None:
    """Raises TypeError for a name that is no argument."""
    for name in bodies:
        if name not in NewBodies.__annotations__:
            raise TypeError(f"{name}: expected one of {list(NewBodies.__annotations__)}")
