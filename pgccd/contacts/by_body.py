"""First times and collisions of the scene, of each world, or of each body."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments

if TYPE_CHECKING:
    from pgccd.geometry.scene import Scene


#: What results are given for.
By = Literal["scene", "world", "body"]
_BY = get_args(By)


def first_time(pairs: Tensor, time: Tensor, scene: Scene | None, by: By, incomplete: Tensor | None = None) -> Tensor:
    """The smallest `time` (K,) of rows of `pairs` (K, 2), which may be padded with -1; see `Contacts.first_toi`. 0 if
    `incomplete` (1,) bool.
    """
    arguments.choice(by, "by", _BY)
    if by == "scene":
        found = torch.cat([time, time.new_full((1,), torch.inf)]).min()
    else:
        owner, count = owners(pairs, scene, by)
        first = time.new_full((count + 1,), torch.inf)
        found = first.scatter_reduce(0, owner, time.repeat_interleave(2), "amin")[:count]
    return found if incomplete is None else found.masked_fill(incomplete.reshape(()), 0.0)


def any_contact(pairs: Tensor, scene: Scene | None, by: By) -> Tensor:
    """Whether there are rows of `pairs` (K, 2), which may be padded with -1; see `Contacts.may_collide`."""
    arguments.choice(by, "by", _BY)
    if by == "scene":
        return (pairs[:, 0] >= 0).any()
    owner, count = owners(pairs, scene, by)
    return pairs.new_zeros((count + 1,), dtype=torch.bool).index_fill(0, owner, True)[:count]


def owners(pairs: Tensor, scene: Scene | None, by: By) -> tuple[Tensor, int]:
    """For both bodies of each row of `pairs` (K, 2) the body or its world, (2 K,), and their number, which stands for
    padding.
    """
    if scene is None:
        raise ValueError(f"by: {by!r} needs the result of `pgccd.detect`; on many ranks see `World.first_toi`")
    count = scene.body_count
    owner = torch.where(pairs < 0, count, pairs).reshape(-1)
    if by == "world":
        count = scene.world_count
        if scene.world is None:
            owner = (owner == scene.body_count).long()
        else:
            owner = torch.cat([scene.world.long(), scene.world.new_full((1,), count, dtype=torch.int64)])[owner]
    return owner, count
