"""Detection by many ranks: every pair of bodies is tested by exactly one of them.

Own bodies meet own bodies while the ghosts are still under way; then ghosts meet whoever is near them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from pgccd import broad, narrow
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts, Stats
from pgccd.detect import detect
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns, take_rows
from pgccd.distributed.halo import Boxes, Halo, Held
from pgccd.distributed.partition import Partition
from pgccd.motion import RigidMotion
from pgccd.scene import Scene
from pgccd.stages import StageClock

#: From columns of bodies to their scene and motion: the same bits on every rank that holds a body.
Build = Callable[[Columns], tuple[Scene, RigidMotion]]


@dataclass(frozen=True)
class Options:
    """What `pgccd.detect` is asked for, see there; and how."""

    report: narrow.Report = "first"
    min_separation: float = 0.0
    tolerance: float | None = None
    nonzero_toi: bool = False
    broad_phase: broad.BroadPhase = "auto"
    #: Whether own bodies are tested while ghosts are under way. The result does not depend on it.
    overlap: bool = True


@dataclass(frozen=True)
class Detection:
    """What one rank found in one step."""

    held: Held
    scene: Scene  #: of all bodies held
    pairs: Tensor  #: (P, 2) int64: the potentially colliding pairs this rank tests, rows of bodies held, sorted
    cell: Tensor  #: (P,) int64: the cell of each one's reference point
    contacts: Contacts  #: of these pairs


def detect_distributed(
    comm: Comm,
    partition: Partition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
) -> Detection:
    """Finds the contacts of this rank's share of pairs; the shares of all ranks together are all pairs, once each.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        own: columns of the bodies this rank owns, "id" ascending.
        build: their scene and motion.
        options: what to find.
        clock: stages are timed here.
    """
    with clock.stage("halo"):
        scene, motion = build(own)
        boxes = Boxes.of(partition, motion, scene.radius, options.min_separation)
        halo = Halo(comm, partition, own, boxes)
    share = _Share(comm.rank, partition, options, clock)
    inner = None
    if options.overlap:
        inner_pairs = share.pairs(scene, motion, boxes)
        inner = share.contacts(scene, motion, inner_pairs)
    with clock.stage("halo wait"):
        held = halo.wait()
    with clock.stage("halo"):
        scene, motion = build(held.columns)
        boxes = Boxes.of(partition, motion, scene.radius, options.min_separation)
        border = share.border(held, boxes) if inner is not None else None
    if inner is None:
        pairs = share.pairs(scene, motion, boxes)
        found = share.contacts(scene, motion, pairs)
    else:
        found = replace(inner, pairs=held.own[inner.pairs])
        pairs = held.own[inner_pairs]
        if border is not None:
            crossing = share.pairs(*build(take_rows(held.columns, border)), _rows_of(boxes, border))
            crossing = border[crossing]
            is_ghost = held.owner != comm.rank
            crossing = crossing[is_ghost[crossing].any(dim=1)]
            found = merge_contacts([found, share.contacts(scene, motion, crossing)], len(held))
            pairs = torch.cat([pairs, crossing])
            pairs = pairs[_order(pairs, len(held))]
    return Detection(held, scene, pairs, boxes.reference_cell(partition, pairs), found)


class _Share:
    """What one rank tests."""

    def __init__(self, rank: int, partition: Partition, options: Options, clock: StageClock) -> None:
        self._rank, self._partition, self._options, self._clock = rank, partition, options, clock

    def pairs(self, scene: Scene, motion: RigidMotion, boxes: Boxes) -> Tensor:
        """Potentially colliding pairs whose reference point lies in a cell of this rank."""
        with self._clock.stage("broad"):
            bodies = MovingBodies(scene, motion)
            pairs = broad.find_pairs(bodies, self._options.min_separation, self._options.broad_phase)
            return pairs[self._partition.owner[boxes.reference_cell(self._partition, pairs)] == self._rank]

    def contacts(self, scene: Scene, motion: RigidMotion, pairs: Tensor) -> Contacts:
        found = detect(
            scene,
            motion,
            self._options.report,
            self._options.min_separation,
            tolerance=self._options.tolerance,
            nonzero_toi=self._options.nonzero_toi,
            pairs=pairs,
        )
        self._clock.add(found.stats.seconds)
        return found

    def border(self, held: Held, boxes: Boxes) -> Tensor | None:
        """(B,) rows of ghosts and of all bodies near them; None without ghosts.

        A ghost and an own body that meet in a cell of this rank both reach it, and there the body's box overlaps the
        box around all ghosts.
        """
        if len(held.ghosts) == 0:
            return None
        partition = self._partition
        ghost_boxes = _rows_of(boxes, held.ghosts)
        shape = (partition.cell_count, 3)
        lower, upper = (boxes.lower.new_full(shape, sign * torch.inf) for sign in (1.0, -1.0))
        for row, cell in partition.reached(ghost_boxes.first, ghost_boxes.last):
            here = partition.owner[cell] == self._rank
            row, cell = row[here], cell[here, None].expand(-1, 3)
            lower.scatter_reduce_(0, cell, ghost_boxes.lower[row], "amin")
            upper.scatter_reduce_(0, cell, ghost_boxes.upper[row], "amax")
        near = torch.zeros(len(held), dtype=torch.bool, device=lower.device)
        near[held.ghosts] = True
        own_boxes = _rows_of(boxes, held.own)
        for row, cell in partition.reached(own_boxes.first, own_boxes.last):
            meets = (own_boxes.lower[row] <= upper[cell]) & (own_boxes.upper[row] >= lower[cell])
            near[held.own[row[meets.all(dim=1)]]] = True
        return torch.nonzero(near)[:, 0]


def _rows_of(boxes: Boxes, rows: Tensor) -> Boxes:
    return Boxes(*(getattr(boxes, field.name)[rows] for field in fields(boxes)))


def _order(pairs: Tensor, body_count: int) -> Tensor:
    """Stable: a pair's rows keep their order."""
    return torch.argsort(pairs[:, 0] * body_count + pairs[:, 1], stable=True)


def merge_contacts(parts: list[Contacts], body_count: int) -> Contacts:
    """Contacts of disjoint sets of pairs as one, in canonical order.

    Args:
        parts: of bodies numbered alike.
        body_count: their number.
    """
    order = _order(torch.cat([part.pairs for part in parts]), body_count)
    columns: dict[str, Any] = {}
    for field in fields(Contacts):
        values = [getattr(part, field.name) for part in parts]
        if field.name != "stats":
            columns[field.name] = None if values[0] is None else torch.cat(values)[order]
    stats = Stats(bodies=body_count, broad_phase=parts[0].stats.broad_phase)
    for part in parts:
        for name in ("pcs", "node_tests", "candidates", "contacts", "unresolved", "chunks"):
            setattr(stats, name, getattr(stats, name) + getattr(part.stats, name))
        for stage, spent in part.stats.seconds.items():
            stats.seconds[stage] = stats.seconds.get(stage, 0.0) + spent
    return Contacts(**columns, stats=stats)
