"""`pgccd.audit`: what happened between the frames of a rollout."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.auditing.results import Audit, Passages, Touching
from pgccd.auditing.runs import Runs
from pgccd.contacts.by_body import SceneBodies
from pgccd.contacts.contacts import Contacts
from pgccd.contacts.operands import operands
from pgccd.contacts.trajectories import time_along
from pgccd.geometry.scene import Scene
from pgccd.motion.of_scene import repeated
from pgccd.motion.paths import PATHS, PathKind, RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.windows import Frame, windows
from pgccd.search import broad
from pgccd.search.checks import warn_of_only_body
from pgccd.search.detect import CollideOptions, collide, detect
from pgccd.search.enclosed import enclosed_pairs
from pgccd.search.query import Query
from pgccd.search.trajectories import detect_segments

#: Whether bodies at rest, of several copies of a scene, do something in pairs (P, 2): (P,) bool.
_Test: TypeAlias = Callable[[Scene, RigidMotion | VertexMotion, Tensor], Tensor]


def audit(
    scene: Scene,
    trajectory: Trajectory | Iterable[Frame],
    min_separation: float = 0.0,
    *,
    path: PathKind = "rigid",
    tolerance: float | None = None,
    broad_phase: broad.BroadPhase = "auto",
    keep: int = 16,
) -> Audit:
    """Finds every passage between the frames of a rollout that the frames do not show.

    A pair of bodies *touches* at a time if its surfaces, thickened by the margins of the scene, come within
    min_separation then. A *passage* is a pair and a segment, from one frame to the next, such that

    * the pair touches at neither frame, and neither body is wholly inside the other one: a test of the bodies at the
      frames alone finds nothing; and
    * it touches in between, on the paths that `Trajectory` defines between the two frames.

    No passage is missed on these paths, and each comes within min_separation + tolerance at its toi. A pair that
    touches or is enclosed at a frame has no passage in the segments before and after that frame, whatever happens
    there. Such pairs are listed separately:

    * `Audit.touching`: pairs that touch at frames, as runs of frames: resting contacts, and bodies that intersect where
      a segment starts or ends. Decided by a detection of the bodies at rest, with the same tolerance.
    * `Audit.enclosed`: pairs that touch at neither frame but in between, of which one body is wholly inside the other
      one at a frame. A body that is not watertight has no inside. Marking bodies as solids changes nothing.

    Margins of the trajectory, `Trajectory(margin=...)`, count only between frames. With them no passage on the true
    path is missed, but a pair that comes close without touching may be reported; with toi 0, if the pair is within
    these margins at the frame.

    Frames are read a few thousand bodies at a time, so memory does not grow with the number of frames, except by what
    is found. The bits of the result do not depend on that.

    Args:
        scene: the bodies.
        trajectory: a `Trajectory`; or any iterable of frames, such as a generator that runs a simulator: pairs of
            positions (N, 3) and orientations (N, 4), as tensors or arrays, or vertices (X, 3) of deforming bodies.
            `pgccd.simulators` makes frames from simulators, and `pgccd.files.iterate_frames` reads them. Frames are
            copied.
        min_separation, tolerance, broad_phase: as for `pgccd.detect`.
        path: of the bodies between frames, "rigid" or "linear", as for `Trajectory`. A given `Trajectory` keeps its
            own.
        keep: number of segments whose poses are kept for a picture (`Audit.steps`): those with the deepest passages.

    Returns:
        `Audit`, on the scene's device. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument, and the frame.

    Example:
        >>> found = pgccd.audit(scene, [(x0, q0), (x0 + 2.0 * v, q1)])  # two frames, apart at both
        >>> found.passages.pairs, found.passages.segment
        (tensor([[0, 1]]), tensor([0]))
    """
    Query("first", min_separation, tolerance, False)  # checks them
    arguments.instance(scene, "scene", Scene)
    arguments.choice(path, "path", PATHS)
    keep = arguments.integer(keep, "keep", 0, "a number of segments >= 0")
    if scene.margin is not None:
        arguments.refuse_gradient(scene.margin, "margin")
    if scene.meshes.has_solids:  # only surfaces count: bodies inside of others have a list of their own
        scene = copy.copy(scene)
        scene.meshes = scene.meshes._surfaces
    if isinstance(trajectory, Trajectory):
        trajectory._refuse_gradient()
    options: CollideOptions = {"tolerance": tolerance, "broad_phase": broad_phase}
    find, touch = (partial(call, min_separation=min_separation, **options) for call in (detect, collide))
    auditor = _Auditor(scene, find, touch, keep)
    for part in windows(scene, trajectory, path):
        if auditor.segments == 0 and scene.body_count == 1:
            warn_of_only_body(scene, part)
        auditor.take(part)
    return auditor.conclude()


@dataclass
class _Rows:
    """Passages, window by window."""

    parts: list[Contacts] = field(default_factory=list)
    columns: list[tuple[Tensor, Tensor]] = field(default_factory=list)  # their segments and approach

    def conclude(self, segments: int) -> Passages:
        """All of them, of a rollout of so many segments."""
        joined = Contacts.cat(self.parts)
        segment, approach = (torch.cat(column) for column in zip(*self.columns, strict=True))
        columns: dict[str, Any] = joined.columns
        toi = columns["toi"]
        return Passages(
            **columns,
            stats=joined.stats,
            segment=segment,
            time=time_along(segment, toi, segments),
            approach=approach,
            measure=(1.0 - toi) * approach,
            _bodies=joined._bodies,
        )


@dataclass
class _Auditor:
    scene: Scene
    detect: Any  # pgccd.detect and pgccd.collide with their options
    collide: Any
    keep: int
    segments: int = 0  # so far
    passages: _Rows = field(default_factory=_Rows)
    enclosed: _Rows = field(default_factory=_Rows)
    touching: Runs = field(default_factory=Runs)
    kept: list[tuple[float, int, RigidMotion | VertexMotion]] = field(default_factory=list)
    last: tuple[Trajectory, Tensor] | None = None  # the last window, and the pairs that touch in its last segment

    def take(self, part: Trajectory) -> None:
        """Finds the passages of the next segments."""
        found, segment, pairs = detect_segments(self.scene, part, self.detect)
        assert isinstance(found, Contacts)
        found.pairs, found._bodies = pairs, SceneBodies.of(self.scene)
        found.stats.bodies = self.scene.body_count
        # A contact at toi 0 is a contact at the frame, unless paths have margins. For other contacts both frames are
        # tested.
        starts, ends = (found.toi == 0.0) & (part.margin is None), torch.zeros_like(segment, dtype=torch.bool)
        later = torch.nonzero(~starts).flatten()
        starts[later], ends[later] = self._at_both_ends(part, segment[later], pairs[later], self._touch)
        frame = torch.cat([segment[starts], segment[ends] + 1]) + self.segments
        self.touching.add(torch.cat([pairs[starts], pairs[ends]]), frame, self.segments)
        self.last = part, pairs[segment == part.segment_count - 1]
        free = torch.nonzero(~starts & ~ends).flatten()
        before, after = self._at_both_ends(part, segment[free], pairs[free], enclosed_pairs)
        inside = before | after
        measure = self._add(self.passages, part, found, segment, free[~inside])
        self._keep_deepest(part, segment[free[~inside]], measure)
        self._add(self.enclosed, part, found, segment, free[inside])
        self.segments += part.segment_count

    def _add(self, kind: _Rows, part: Trajectory, found: Contacts, segment: Tensor, rows: Tensor) -> Tensor:
        """Adds rows (K,) of contacts; returns their measure (K,)."""
        added, segment = found[rows], segment[rows]
        approach = self._closing_rates(part, added, segment)
        kind.parts.append(added)
        kind.columns.append((segment + self.segments, approach))
        return (1.0 - added.toi) * approach

    def _closing_rates(self, part: Trajectory, found: Contacts, segment: Tensor) -> Tensor:
        """(K,) lengths per segment, >= 0: the rate at which the gap closes along the normal at toi."""
        bodies = found.pairs + segment[:, None] * self.scene.body_count
        given = operands(repeated(self.scene, part.segment_count), part.steps(), bodies, found)
        return ops.closing_rates(*given)[0].clamp(min=0.0)

    def _at_both_ends(self, part: Trajectory, segment: Tensor, pairs: Tensor, test: _Test) -> tuple[Tensor, Tensor]:
        """(K,) bool each: whether pairs (K, 2) pass a test at the start and at the end of segments (K,)."""
        if not len(segment):
            return torch.zeros_like(segment, dtype=torch.bool), torch.zeros_like(segment, dtype=torch.bool)
        frame = torch.cat([segment, segment + 1])
        start, end = self._at_frames(part, frame, pairs.repeat(2, 1), test).chunk(2)
        return start, end

    def _at_frames(self, part: Trajectory, frame: Tensor, pairs: Tensor, test: _Test) -> Tensor:
        """(K,) bool: whether pairs (K, 2) pass a test at frames (K,) of a window."""
        frames, copy = torch.unique(frame, return_inverse=True)
        position = part.position[frames].reshape(-1, 3)
        if part.orientation is None:
            still: RigidMotion | VertexMotion = VertexMotion(position, position)
        else:
            still = RigidMotion.at_rest(position, part.orientation[frames].reshape(-1, 4))
        asked, row = torch.unique(pairs + copy[:, None] * self.scene.body_count, dim=0, return_inverse=True)
        return test(repeated(self.scene, len(frames)), still, asked)[row]

    def _touch(self, copies: Scene, still: RigidMotion | VertexMotion, pairs: Tensor) -> Tensor:
        found = self.collide(copies, still, pairs=pairs)
        keys, touching = (each[:, 0] * copies.body_count + each[:, 1] for each in (pairs, found.pairs))
        return torch.isin(keys, touching)

    def _keep_deepest(self, part: Trajectory, segment: Tensor, measure: Tensor) -> None:
        if not len(segment) or self.keep == 0:
            return
        which, row = torch.unique(segment, return_inverse=True)
        deepest = torch.zeros_like(which, dtype=torch.float64).scatter_reduce_(0, row, measure, "amax")
        order = torch.argsort(deepest, descending=True, stable=True)[: self.keep]
        threshold = self.kept[-1][0] if len(self.kept) == self.keep else -1.0
        for depth, index in zip(deepest[order].tolist(), which[order].tolist(), strict=True):
            if depth > threshold:
                self.kept.append((depth, self.segments + index, part.segment(index)))
        self.kept = sorted(self.kept, key=lambda each: (-each[0], each[1]))[: self.keep]

    def conclude(self) -> Audit:
        """The result."""
        assert self.last is not None
        part, pairs = self.last
        if len(pairs):
            end = torch.full_like(pairs[:, 0], part.segment_count)
            pairs = pairs[self._at_frames(part, end, pairs, self._touch)]
            self.touching.add(pairs, torch.full_like(pairs[:, 0], self.segments), self.segments)
        return Audit(
            self.passages.conclude(self.segments),
            Touching(*self.touching.conclude(self.scene.device)),
            self.enclosed.conclude(self.segments),
            self.segments + 1,
            sorted((segment, motion) for _, segment, motion in self.kept),
        )
