"""Detection along a trajectory: all segments in one call."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from pgccd.contacts.by_body import By
from pgccd.contacts.contacts import COLUMNS, CollidingPairs, Contacts, earliest_row
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.differentiable import with_gradient_of
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import narrow
from pgccd.search.bodies import check_scene
from pgccd.search.checks import check_pairs
from pgccd.search.query import Query

_MOST_ROWS = 2**31


@dataclass(eq=False, kw_only=True, repr=False)
class TrajectoryContacts(Contacts):
    """Contacts along a trajectory.

    With report="all", sorted by segment, pair, kind and features. With "first" one row per pair: the one with the
    smallest segment, toi, kind and features. With "any" a trajectory gives `CollidingPairs`: the pairs that collide in
    any segment.

    Attributes:
        segment: (K,) int64: from waypoint `segment` to the next.
        toi: (K,) float64 in [0, 1], within the segment.
        time: (K,) float64 in [0, 1] along the whole trajectory: (segment + toi) / (T - 1), rounded down.
        pairs, kind, features, coordinates, point, normal, status, stats, payload, scene: as of `Contacts`.
    """

    segment: Tensor
    time: Tensor

    _names: ClassVar[tuple[str, ...]] = (*COLUMNS, "segment", "time")

    @property
    def _order(self) -> tuple[Tensor, ...]:
        return self.segment, self.toi

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first `time` along the whole trajectory: in [0, 1], float64, inf without a contact.

        Args:
            by: "scene" (), "world" (W,) or "body" (N,): see `Contacts.first_toi`.

        Raises:
            ValueError: `by` is unknown or needs a scene; or these are the contacts of one of several ranks.
        """
        self._require_all_ranks()
        return self._first_time(self.time, by)


class DetectStep(Protocol):
    """Finds the contacts of one step."""

    def __call__(
        self, scene: Scene, motion: RigidMotion | VertexMotion, report: narrow.Report, *, pairs: Tensor | None
    ) -> Contacts | CollidingPairs:
        """As `pgccd.detect`."""


def check_trajectory(scene: Scene, trajectory: Trajectory) -> None:
    """Raises ValueError if a trajectory is on another device, or is that of another number of bodies."""
    if scene.device != trajectory.device:
        raise ValueError(f"motion: is on {trajectory.device}, the scene on {scene.device}")
    rows, expected, what = trajectory.position.shape[1], scene.body_count, "bodies"
    if trajectory.orientation is None:
        expected, what = scene.layout.vertex_count, "vertices"
    if rows != expected:
        raise ValueError(f"motion: has {rows} {what}, the scene {expected}")


def detect_segments(
    scene: Scene,
    trajectory: Trajectory,
    report: narrow.Report,
    detect_step: DetectStep,
    pairs: Tensor | None = None,
) -> tuple[Contacts | CollidingPairs, Tensor, Tensor]:
    """What `detect_step` finds in each segment of a trajectory: rows whose pairs are of the copies below, sorted by
    segment; and for each row its segment (K,) and the pair (K, 2) of the scene.

    All segments run as one step of a scene with one copy of each body per segment; the copies of different segments are
    in different worlds, so no broad phase pairs them.
    """
    if pairs is not None:
        pairs = check_pairs(pairs, scene, trajectory.orientation is None, ascending=True)
    copies, steps, of_copies = segments_as_step(scene, trajectory, pairs)
    found = detect_step(copies, steps, report, pairs=of_copies)
    return found, *in_scene(found.pairs, scene.body_count)


def segments_as_step(
    scene: Scene, trajectory: Trajectory, pairs: Tensor | None
) -> tuple[Scene, RigidMotion | VertexMotion, Tensor | None]:
    """All segments of a trajectory as one step of a scene with one copy of each body per segment, and the checked pairs
    (P, 2) of the scene in each of them, (S P, 2).
    """
    steps = trajectory.steps()
    segments, count = trajectory.segment_count, scene.body_count
    check_scene(scene._detached())
    check_trajectory(scene, trajectory)
    copies = repeated(scene, segments)
    copies.margin = trajectory._margins(copies.margin, count)
    if pairs is None:
        return copies, steps, None
    first_body = torch.arange(segments, device=scene.device)[:, None, None] * count
    return copies, steps, (pairs + first_body).reshape(-1, 2)


def in_scene(pairs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Of pairs (K, 2) of the copies of `count` bodies the segment (K,) and the pair (K, 2) of the scene."""
    segment = torch.div(pairs[:, 0], max(1, count), rounding_mode="floor")
    return segment, pairs - segment[:, None] * count


def detect_trajectory(
    scene: Scene, trajectory: Trajectory, query: Query, detect_step: DetectStep, pairs: Tensor | None = None
) -> TrajectoryContacts | CollidingPairs:
    """`pgccd.detect` for a trajectory."""
    # "earliest" selects from the first contacts of all segments.
    report: narrow.Report = "first" if query.report == "earliest" else query.report
    found, _, bodies = detect_segments(scene, trajectory, report, detect_step, pairs)
    if isinstance(found, CollidingPairs):
        bodies = torch.unique(bodies, dim=0) if len(bodies) else bodies
        stats = replace(found.stats, bodies=scene.body_count, needed=None, contacts=len(bodies))
        return CollidingPairs(pairs=bodies, stats=stats, scene=scene)
    return of_trajectory(found, scene, trajectory.segment_count, query.report)


def of_trajectory(found: Contacts, scene: Scene, segments: int, report: narrow.Report) -> TrajectoryContacts:
    """Contacts along a trajectory, from those of all its segments."""
    count = scene.body_count
    segment, pairs = in_scene(found.pairs, count)
    chosen: Tensor | slice = slice(None)
    if report == "first":
        chosen = _first_of_pairs(pairs, count)
    elif report == "earliest" and len(pairs):
        first = segment[0]  # rows are sorted by segment
        chosen = earliest_row(torch.where(segment == first, found.toi, torch.inf))
    columns: dict[str, Any] = {name: column[chosen] for name, column in (found.columns | {"pairs": pairs}).items()}
    segment = segment[chosen]
    time = time_along(segment, columns["toi"].detach(), segments)
    if columns["toi"].requires_grad:
        time = with_gradient_of(time, columns["toi"] / segments, "time")
    stats = replace(found.stats, bodies=count, needed=None, contacts=len(segment))
    return TrajectoryContacts(
        **columns,
        stats=stats,
        segment=segment,
        time=time,
        scene=scene,
        _is_earliest=report == "earliest",
        _differentiable=None if found._differentiable is None else found._differentiable[chosen],
        _found_with=None if found._found_with is None else found._found_with | {"report": report},
    )


def time_along(segment: Tensor, toi: Tensor, segments: int) -> Tensor:
    """(K,) float64: times in [0, 1] along a trajectory of so many segments, from times within a segment: never later
    than the exact ones, so both operations are corrected where they have rounded up.

    The divisor is a tensor, because torch divides by a Python number on CUDA by multiplying with its reciprocal, which
    rounds differently.
    """
    count = torch.full((), segments, dtype=torch.float64, device=toi.device)
    begin, zero = segment.to(torch.float64), torch.zeros((), dtype=torch.float64, device=toi.device)
    total = begin + toi
    # Exact, since `begin` is 0 or not less than `toi` (Dekker 1971): negative where the sum is too large.
    total = torch.where(toi - (total - begin) < 0.0, torch.nextafter(total, zero), total)
    time = total / count
    # The remainder is exact: products of 26 bits, by Veltkamp's splitting, and numbers of up to 27 bits.
    large = time * 134217729.0  # 2^27 + 1
    high = large - (large - time)
    remainder = (total - high * count) - (time - high) * count
    return torch.where(remainder < 0.0, torch.nextafter(time, zero), time)


def repeated(scene: Scene, times: int) -> Scene:
    """A scene with `times` copies of each body, each copy in worlds of its own."""
    if scene.body_count * times >= _MOST_ROWS or scene.world_count * times >= _MOST_ROWS:
        raise ValueError(
            f"motion: {times} segments of {scene.body_count} bodies in {scene.world_count} worlds are too many for one "
            "call: more than 2^31 - 1"
        )
    columns = {name: getattr(scene, name) for name in OPTIONAL_COLUMNS}
    columns = {name: column.repeat(times) for name, column in columns.items() if column is not None}
    world = (
        torch.zeros(scene.body_count, dtype=torch.int32, device=scene.device) if scene.world is None else scene.world
    )
    first = torch.arange(times, dtype=torch.int32, device=scene.device) * max(1, scene.world_count)
    columns["world"] = (first[:, None] + world).reshape(-1)
    own = None if scene.self_collision is None else scene.self_collision.repeat(times)
    radius = scene._current_radius().repeat(times)
    many = Scene._of_checked(scene.meshes, scene.mesh_index.repeat(times), own, radius, **columns)
    many._capacity_estimates = scene._capacity_estimates
    many.exclude, many._exclude_period = scene.exclude, scene.body_count
    return many


def _first_of_pairs(pairs: Tensor, count: int) -> Tensor:
    """The first row of each pair of `pairs` (K, 2), in the order of the pairs."""
    keys, pair_of_row = torch.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    rows = torch.arange(len(pairs), device=pairs.device)
    return torch.full_like(keys, len(pairs)).scatter_reduce_(0, pair_of_row, rows, "amin")
