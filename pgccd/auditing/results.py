"""What an audit finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from pgccd.contacts.contacts import COLUMNS, Contacts
from pgccd.contacts.rows import Form, Rows
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.motion.paths import RigidMotion, VertexMotion


@dataclass(eq=False, kw_only=True, repr=False)
class Passages(TrajectoryContacts):
    """Passages between frames: the first contact of each, sorted by segment and pair.

    Attributes:
        segment: (K,) int64: from frame `segment` to the next.
        approach: (K,) float64 >= 0, length units per segment: the rate at which the gap closes along the normal at toi.
        measure: (K,) float64 length: (1 - toi) approach, how deep the bodies would be in each other at the next frame
            if they kept this rate.
        pairs, toi, time, kind, features, coordinates, point, normal, status, stats, payload: as of
            `TrajectoryContacts`.

    Example:
        >>> passages = pgccd.audit(scene, [(x0, q0), (x0 + 2.0 * v, q1)]).passages
        >>> deep = passages[passages.measure > 0.01]
    """

    approach: Tensor
    measure: Tensor

    _names: ClassVar[tuple[str, ...]] = (*TrajectoryContacts._names, "approach", "measure")


@dataclass(frozen=True, eq=False, repr=False)
class Touching(Rows):
    """Pairs that touch at frames: R runs of consecutive frames, sorted by pair and frame.

    Attributes:
        pairs: (R, 2) int64 body indices, i < j.
        first, last: (R,) int64, the first and the last frame of the run.

    Example:
        >>> touching = pgccd.audit(scene, [(x0, q0), (x1, q1)]).touching
        >>> touching.pairs, touching.first, touching.last
        (tensor([[0, 1]]), tensor([1]), tensor([1]))
    """

    pairs: Tensor
    first: Tensor
    last: Tensor

    _names: ClassVar[tuple[str, ...]] = ("pairs", "first", "last")
    _forms: ClassVar[Mapping[str, Form]] = {
        "pairs": (torch.int64, (2,)),
        "first": (torch.int64, ()),
        "last": (torch.int64, ()),
    }

    def __repr__(self) -> str:
        return f"Touching(count={len(self)})"


@dataclass(frozen=True, eq=False)
class Audit:
    """What `pgccd.audit` finds between and at the frames of a rollout.

    Attributes:
        passages: `Passages`: contacts between frames, which no frame shows.
        touching: `Touching`: pairs that touch at frames.
        enclosed: `Passages` of pairs that touch at neither frame, but of which one body is wholly inside the other one
            at a frame: they pass the surface of a solid, into it or out of it.
        frames: number of frames.

    Example:
        >>> pgccd.audit(scene, [(x0, q0), (x1, q1)])
        Audit(frames=2, passages=0, touching=1, enclosed=0)
    """

    passages: Passages
    touching: Touching
    enclosed: Passages
    frames: int
    # Segments with the largest measures, and the motion of all bodies in them.
    _kept: list[tuple[int, RigidMotion | VertexMotion]] = field(default_factory=list)

    def steps(self) -> tuple[list[RigidMotion | VertexMotion], list[Contacts]]:
        """Up to `keep` segments with the deepest passages, in the order of time: their motions, and the passages in
        each. For `pgccd.show`.

        Example:
            >>> found = pgccd.audit(scene, [(x0, q0), (x0 + 2.0 * v, q1)])
            >>> page = pgccd.show(scene, *found.steps(), path="passages.html")
        """
        contacts = []
        for segment, _ in self._kept:
            rows = self.passages[self.passages.segment == segment]
            columns = {name: getattr(rows, name) for name in COLUMNS}
            contacts.append(Contacts(**columns, stats=rows.stats, _bodies=rows._bodies))
        return [motion for _, motion in self._kept], contacts

    def __repr__(self) -> str:
        counts = {name: len(getattr(self, name)) for name in ("passages", "touching", "enclosed")}
        return f"Audit(frames={self.frames}, {', '.join(f'{name}={count}' for name, count in counts.items())})"
