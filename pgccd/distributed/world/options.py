"""Keyword arguments of `World.create` and `World.load`, for type checkers."""

from typing import Literal, TypedDict

from torch import Tensor

from pgccd.detection.broad import BroadPhase
from pgccd.detection.checks import Initial
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.interface import Triple
from pgccd.motion.paths import PathKind


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


class NewWorld(WorldOptions, total=False):
    """Of `World.create`."""

    id: Tensor | None
    mesh_index: Tensor | None
    group: Tensor | None
    mask: Tensor | None
    world: Tensor | None
    static: Tensor | None
    margin: Tensor | float | None
    self_collision: Tensor | bool
    payload: dict[str, Tensor] | None
    vertex_payload: dict[str, Tensor] | None
    partition: Literal["auto", "cells", "bisection"]
    axes: int
    cells: int | Triple
