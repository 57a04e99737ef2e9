"""Trajectories: paths through many waypoints, of which all steps are tested in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments, narrow
from pgccd.contacts import By, Contacts, earliest_row, first_time
from pgccd.faults import LARGEST_COORDINATE, UNIT_TOLERANCE
from pgccd.motion import PathKind, RigidMotion, VertexMotion
from pgccd.query import Query
from pgccd.scene import OPTIONAL_COLUMNS, Scene

_MOST_ROWS = 2**31


class Trajectory:
    """Bodies on paths through T waypoints: T - 1 segments, each a step as of `RigidMotion` or `VertexMotion`.

    Args:
        position: (T, N, 3) where the meshes' origins are, world frame, scene length units; or vertices (T, X, 3) of
            bodies that deform, in the order of `VertexMotion`, if there is no `orientation`.
        orientation: (T, N, 4) unit quaternions (w, x, y, z), body to world. Between waypoints bodies turn the shorter
            way.
        path: "rigid" or "linear", as for `RigidMotion`.

    float32 input is widened to float64 exactly. Making one waits for a GPU once.

    Raises:
        TypeError, ValueError: naming the argument, and the first offending waypoint and body or vertex.

    Example:
        >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))  # (T, N, 3), (T, N, 4)
        >>> hits = pgccd.detect(scene, trajectory)
        >>> hits.segment, hits.toi, hits.time
    """

    def __init__(self, position: Tensor, orientation: Tensor | None = None, path: PathKind = "rigid") -> None:
        if path not in ("rigid", "linear"):
            raise ValueError(f'path: expected "rigid" or "linear", got {path!r}')
        self.path: PathKind = path
        row = "vertex" if orientation is None else "body"
        self.position = _waypoints(position, "position", 3, None)
        _require(
            self.position.abs() <= LARGEST_COORDINATE, "position", row, f"finite numbers up to {LARGEST_COORDINATE:g}"
        )
        #: (T, N, 4) float64, or None where bodies deform.
        self.orientation: Tensor | None = None
        if orientation is not None:
            self.orientation = _waypoints(orientation, "orientation", 4, self.position)
            is_unit = (self.orientation.norm(dim=2, keepdim=True) - 1.0).abs() <= UNIT_TOLERANCE
            _require(is_unit, "orientation", row, "a unit quaternion (w, x, y, z)")

    @property
    def device(self) -> torch.device:
        return self.position.device

    @property
    def segment_count(self) -> int:
        """T - 1."""
        return self.position.shape[0] - 1

    def segment(self, index: int) -> RigidMotion | VertexMotion:
        """One step, from waypoint `index` to the next: `detect` finds in it what it finds in the trajectory's segment,
        to the bit.

        Raises:
            IndexError: there is no such segment.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))
            >>> position, orientation = trajectory.segment(0).at(0.5)
        """
        if not 0 <= index < self.segment_count:
            raise IndexError(f"index: expected a segment in [0, {self.segment_count}), got {index}")
        return self._motion(slice(index, index + 1))

    def steps(self) -> RigidMotion | VertexMotion:
        """All segments as one step, of bodies of which the rows of segment k follow those of segment k - 1."""
        return self._motion(slice(0, self.segment_count))

    def _motion(self, segments: slice) -> RigidMotion | VertexMotion:
        ends = slice(segments.start + 1, segments.stop + 1)
        start, end = (self.position[rows].reshape(-1, 3) for rows in (segments, ends))
        if self.orientation is None:
            return VertexMotion(start, end)
        turn = (self.orientation[rows].reshape(-1, 4) for rows in (segments, ends))
        return RigidMotion(start, next(turn), end, next(turn), self.path)


@dataclass
class TrajectoryContacts(Contacts):
    """Contacts along a trajectory; `toi` is within the segment.

    With report="all", sorted by segment, pair, kind and features. With "first" one row a pair: that of the least
    segment, toi, kind and features. With "any" only `pairs` is meaningful, those that collide in any segment.
    """

    segment: Tensor | None = field(default=None, kw_only=True)  #: (K,) int64: from waypoint `segment` to the next
    time: Tensor | None = field(
        default=None, kw_only=True
    )  #: (K,) float64 in [0, 1] along the whole: (segment + toi) / (T - 1)

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first `time`, along the whole trajectory; otherwise as of `Contacts`."""
        return first_time(self.pairs, self.time, self.scene, by)


#: Finds the contacts of one step.
DetectStep = Callable[[Scene, RigidMotion | VertexMotion, narrow.Report], Contacts]


def detect_trajectory(
    scene: Scene, trajectory: Trajectory, query: Query, detect_step: DetectStep
) -> TrajectoryContacts:
    """What `pgccd.detect` finds of a trajectory.

    All segments are one step of a scene that holds each body once a segment; bodies of different segments are in
    different worlds, which all broad phases keep apart.
    """
    segments, count = trajectory.segment_count, scene.body_count
    if scene.device != trajectory.device:
        raise ValueError(f"motion: is on {trajectory.device}, the scene on {scene.device}")
    rows, expected = trajectory.position.shape[1], count
    if trajectory.orientation is None:
        expected = scene.layout.vertex_count
    if rows != expected:
        what = "vertices" if trajectory.orientation is None else "bodies"
        raise ValueError(f"motion: has {rows} {what}, the scene {expected}")
    # "earliest" is chosen from the first contacts of all segments.
    report: narrow.Report = "first" if query.report == "earliest" else query.report
    found = detect_step(repeated(scene, segments), trajectory.steps(), report)
    of_pairs = found.pairs
    segment = torch.div(of_pairs[:, 0], max(1, count), rounding_mode="floor")
    pairs = of_pairs - segment[:, None] * count
    stats = replace(found.stats, bodies=count, needed=None)
    if query.report == "any":
        pairs = torch.unique(pairs, dim=0) if len(pairs) else pairs
        stats.contacts = len(pairs)
        contacts = TrajectoryContacts(pairs, None, None, None, None, None, None, None, stats)
        contacts.scene = scene
        return contacts
    assert found.toi is not None
    chosen: Tensor | slice = slice(None)
    if query.report == "first":
        chosen = _first_of_pairs(pairs, count)
    elif query.report == "earliest" and len(pairs):
        first = segment[0]  # rows are sorted by segment
        chosen = earliest_row(torch.where(segment == first, found.toi, torch.inf))
    columns: dict[str, Any] = {
        name: getattr(found, name)[chosen]
        for name in ("toi", "kind", "features", "coordinates", "point", "normal", "status")
    }
    segment = segment[chosen]
    time = (segment + columns["toi"]) / segments
    stats.contacts = len(segment)
    contacts = TrajectoryContacts(pairs[chosen], **columns, stats=stats, segment=segment, time=time)
    contacts.scene = scene
    return contacts


def repeated(scene: Scene, times: int) -> Scene:
    """A scene that holds each body so many times, each time in worlds of its own."""
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
    many = Scene.of_checked(scene.meshes, scene.mesh_index.repeat(times), **columns)
    many.radius = scene.radius.repeat(times)
    if scene.self_collision is not None:
        many.self_collision = scene.self_collision.repeat(times)
        step = torch.arange(times, device=scene.device)[:, None] * scene.body_count
        many.self_colliding = (step + scene.self_colliding).reshape(-1)
        many.self_colliding_vertices = times * scene.self_colliding_vertices
    return many


def _first_of_pairs(pairs: Tensor, count: int) -> Tensor:
    """Of pairs (K, 2) the first row of each, in the order of the pairs."""
    if not len(pairs):
        return torch.arange(0, device=pairs.device)
    order = torch.argsort(pairs[:, 0] * count + pairs[:, 1], stable=True)
    ordered = pairs[order]
    is_first = torch.ones(len(order), dtype=torch.bool, device=pairs.device)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(dim=1)
    return order[is_first]


def _waypoints(values: Tensor, name: str, width: int, like: Tensor | None) -> Tensor:
    arguments.real_tensor(values, name)
    if values.dim() != 3 or values.shape[2] != width or values.shape[0] < 2:
        raise ValueError(f"{name}: expected shape (T, N, {width}) with T >= 2, got {tuple(values.shape)}")
    if like is not None and values.shape[:2] != like.shape[:2]:
        expected = (*like.shape[:2], width)
        raise ValueError(f"{name}: expected shape {expected}, as of position, got {tuple(values.shape)}")
    if like is not None and values.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, got {values.device}")
    return values.detach().to(torch.float64).contiguous()


def _require(valid: Tensor, name: str, row: str, expected: str) -> None:
    faulty = ~valid.all(dim=2)
    if bool(faulty.any()):
        waypoint, index = torch.nonzero(faulty)[0].tolist()
        raise ValueError(f"{name}: waypoint {waypoint}, {row} {index}: expected {expected}")
