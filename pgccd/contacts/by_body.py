"""First times and collisions of the scene, of each world, or of each body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.scene import Derived, Scene
from pgccd.geometry.scene_columns import require_worlds

#: What results are given for.
By = Literal["scene", "world", "body"]
_BY = get_args(By)


@dataclass(frozen=True, eq=False)
class SceneBodies:
    """What results keep of a scene: no meshes and no paths.

    Attributes:
        count: number of bodies.
        world: (N,) int32: the column of the scene itself, which may be written; None without worlds.
    """

    count: int
    world: Tensor | None = None
    _world_count: Derived | None = None

    @classmethod
    def of(cls, scene: Scene) -> SceneBodies:
        """The bodies of a scene. Does not synchronise."""
        return cls(scene.body_count, scene.world, scene._world_count)

    @classmethod
    def of_state(cls, state: dict[str, Any]) -> SceneBodies | None:
        """From the entries "body_count" and "world" of a `state_dict`.

        Raises:
            TypeError, ValueError: naming the entry.
        """
        count, world = state["body_count"], state["world"]
        if count is not None:
            arguments.integer(count, "body_count", 0, "a number of bodies >= 0")
        if world is not None:
            if count is None:
                raise ValueError("world: expected None where there is no body_count")
            if not isinstance(world, Tensor) or world.dtype != torch.int32:
                raise TypeError(f"world: expected torch.int32, got {arguments.describe(world)}")
            arguments.shape(world, "world", (count,), state["pairs"].device)
            require_worlds(world)
        return None if count is None else cls(count, world)

    @property
    def world_count(self) -> int:
        """One more than the largest `world`; 1 without worlds. Synchronises if worlds have been written."""
        if self.world is None:
            return 1
        if self._world_count is not None and self._world_count.is_of(self.world):
            return self._world_count.value
        require_worlds(self.world)
        return 1 + int(self.world.max()) if self.count else 0

    def map(self, change: Callable[[Tensor], Tensor]) -> SceneBodies:
        """Copies, with another world column."""
        if self.world is None:
            return self
        world = change(self.world)
        return SceneBodies(self.count, world, Derived(world, self.world_count))


def first_time(
    pairs: Tensor, time: Tensor, bodies: SceneBodies | None, by: By, incomplete: Tensor | None = None
) -> Tensor:
    """The smallest `time` (K,) of rows of `pairs` (K, 2), which may be padded with -1; see `Contacts.first_toi`. 0 if
    `incomplete` (1,) bool.
    """
    arguments.choice(by, "by", _BY)
    if by == "scene":
        found = torch.cat([time, time.new_full((1,), torch.inf)]).min()
    else:
        owner, count = owners(pairs, bodies, by)
        first = time.new_full((count + 1,), torch.inf)
        found = first.scatter_reduce(0, owner, time.repeat_interleave(2), "amin")[:count]
    return found if incomplete is None else found.masked_fill(incomplete.reshape(()), 0.0)


def any_contact(pairs: Tensor, bodies: SceneBodies | None, by: By) -> Tensor:
    """Whether there are rows of `pairs` (K, 2), which may be padded with -1; see `Contacts.may_collide`."""
    arguments.choice(by, "by", _BY)
    if by == "scene":
        return (pairs[:, 0] >= 0).any()
    owner, count = owners(pairs, bodies, by)
    return pairs.new_zeros((count + 1,), dtype=torch.bool).index_fill(0, owner, True)[:count]


def owners(pairs: Tensor, bodies: SceneBodies | None, by: By) -> tuple[Tensor, int]:
    """For both bodies of each row of `pairs` (K, 2) the body or its world, (2 K,), and the number of bodies or worlds,
    which stands for padding.
    """
    if bodies is None:
        raise ValueError(f"by: {by!r} needs the result of `pgccd.detect`; on many ranks see `World.first_toi`")
    count = bodies.count
    owner = torch.where(pairs < 0, count, pairs).reshape(-1)
    if by == "world":
        count = bodies.world_count
        if bodies.world is None:
            owner = (owner == bodies.count).long()
        else:
            owner = torch.cat([bodies.world.long(), bodies.world.new_full((1,), count, dtype=torch.int64)])[owner]
    return owner, count
