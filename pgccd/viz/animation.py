"""What a page shows, as numpy arrays: bodies, their paths, and contacts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.detection.contacts import ContactColumns, PairColumns
from pgccd.detection.padded_contacts import PaddedContacts
from pgccd.detection.trajectories import TrajectoryContacts
from pgccd.geometry.columns import require_meshes
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.times import fractions_of
from pgccd.motion.trajectory import Trajectory

#: The motion of the bodies of a page.
AnyMotion: TypeAlias = RigidMotion | VertexMotion | Trajectory

INCOMPLETE = (
    "The result is incomplete (a capacity was exceeded, or a pose is invalid): there may be other contacts, and it "
    "counts as a contact of every body at the start."
)
WITHOUT_TIMES = 'The result of report="any" has pairs of bodies, but no times and points of contacts.'


@dataclass
class RigidPaths:
    """Poses of N rigid bodies at W waypoints. World frame, length units.

    Attributes:
        position: (W, N, 3) of the origins.
        orientation: (W - 1, N, 4) at the start of each segment.
        rotation: (W - 1, N, 3) rotation vector of each segment, radians.
        is_linear: whether vertices move straight between the two poses.
    """

    position: np.ndarray
    orientation: np.ndarray
    rotation: np.ndarray
    is_linear: bool = False


@dataclass
class VertexPaths:
    """Vertices of N deforming bodies at W waypoints, with straight paths between them. World frame, length units.

    Attributes:
        position: (W, X, 3).
        begin: (N,) first vertex of each body.
    """

    position: np.ndarray
    begin: np.ndarray


@dataclass
class Marks:
    """K contacts. World frame, length units.

    Attributes:
        bodies: (K, 2) rows.
        segment: (K,) of the trajectory.
        toi: (K,) within the segment.
        point, normal: (K, 3); a normal of 0 is not drawn.
        kind: (K,) `pgccd.Kind`; -1 if unknown.
        features: (K, 2).
        unresolved: (K,) bool.
    """

    bodies: np.ndarray
    segment: np.ndarray
    toi: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    kind: np.ndarray
    features: np.ndarray
    unresolved: np.ndarray

    def __len__(self) -> int:
        return len(self.toi)

    def __getitem__(self, rows: np.ndarray) -> Marks:
        return Marks(**{name: column[rows] for name, column in vars(self).items()})

    @classmethod
    def none(cls) -> Marks:
        """No contacts."""
        pairs, points, number = np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros(0, np.int64)
        return cls(pairs, number, np.zeros(0), points, points, number, pairs, np.zeros(0, bool))


@dataclass
class Animation:
    """N bodies on their paths, and contacts.

    Attributes:
        shapes: vertices (V, 3) relative to the origin, and faces (F, 3). Of deforming bodies only the faces are used.
        shape_index: (N,) shape of each body.
        paths: of the bodies.
        colliding, static: (N,) bool.
        ids: (N,) how bodies are named.
        marks: contacts on the whole paths.
        world: (N,) int, or None.
        margin: (N,) length units, or None.
        fraction: (N,) body i moves on x_i(fraction_i t); or None.
        box: (2, 3) lower and upper corner of a box that is drawn, or None.
        title: of the page.
        notes: sentences below it.
    """

    shapes: list[tuple[np.ndarray, np.ndarray]]
    shape_index: np.ndarray
    paths: RigidPaths | VertexPaths
    colliding: np.ndarray
    static: np.ndarray
    ids: np.ndarray
    marks: Marks = field(default_factory=Marks.none)
    world: np.ndarray | None = None
    margin: np.ndarray | None = None
    fraction: np.ndarray | None = None
    box: np.ndarray | None = None
    title: str = "pgccd"
    notes: list[str] = field(default_factory=list)

    @property
    def segment_count(self) -> int:
        """Number of segments of the paths."""
        return len(self.paths.position) - 1


def animation_of(
    scene: Scene, motion: AnyMotion, hits: PairColumns | None = None, fraction: Tensor | float | None = None
) -> Animation:
    """The animation of a scene and its motion, with the contacts found for them. Synchronises with a GPU.

    Args:
        scene, motion, hits, fraction: as for `pgccd.show`.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
    if not isinstance(motion, (RigidMotion, VertexMotion, Trajectory)):
        expected = "a RigidMotion, VertexMotion or Trajectory"
        raise TypeError(f"motion: expected {expected}, got {arguments.describe(motion)}")
    if fraction is not None and isinstance(motion, Trajectory):
        raise ValueError("fraction: expected a motion of one step, got a Trajectory")
    scene._check_columns()
    require_meshes(scene.mesh_index, len(scene.meshes))
    count = scene.body_count
    paths = _paths(scene, motion)
    notes: list[str] = []
    colliding, marks = np.zeros(count, dtype=bool), Marks.none()
    if hits is not None:
        colliding, marks = _found(hits, scene, motion, notes)
    static, world, margin = (
        None if (column := getattr(scene, name)) is None else _array(column) for name in ("static", "world", "margin")
    )
    return Animation(
        shapes=[(mesh.vertices.numpy(), mesh.faces.numpy()) for mesh in scene.meshes.meshes],
        shape_index=_array(scene.mesh_index).astype(np.int64),
        paths=paths,
        colliding=colliding,
        static=np.zeros(count, dtype=bool) if static is None else static.astype(bool),
        ids=np.arange(count),
        marks=marks,
        world=world if world is not None and world.any() else None,
        margin=margin if margin is not None and margin.any() else None,
        fraction=None if fraction is None else _array(fractions_of(fraction, count, scene.device)),
        notes=notes,
    )


def _array(column: Tensor) -> np.ndarray:
    return column.detach().cpu().numpy()


def _paths(scene: Scene, motion: AnyMotion) -> RigidPaths | VertexPaths:
    if isinstance(motion, Trajectory):
        step, segments = motion.steps(), motion.segment_count
    else:
        motion.check()
        step, segments = motion, 1
    is_rigid = isinstance(step, RigidMotion)
    columns = {name: _array(column) for name, column in step.columns().items()}
    columns = {name: column.reshape(segments, -1, column.shape[1]) for name, column in columns.items()}
    start, end = (columns[name] for name in (("position_t0", "position_t1") if is_rigid else ("x_t0", "x_t1")))
    expected = scene.body_count if is_rigid else scene.layout.vertex_count
    if start.shape[1] != expected:
        what = "bodies" if is_rigid else "vertices"
        raise ValueError(f"motion: has {start.shape[1]} {what}, the scene {expected}")
    position = np.concatenate([start, end[-1:]])
    if isinstance(step, VertexMotion):
        return VertexPaths(position, _array(scene.layout.vertex_begin))
    return RigidPaths(position, columns["orientation_t0"], columns["rotation"], step.path == "linear")


def _found(hits: PairColumns, scene: Scene, motion: AnyMotion, notes: list[str]) -> tuple[np.ndarray, Marks]:
    """Which bodies collide (N,), and the contacts."""
    if not isinstance(hits, PairColumns):
        raise TypeError(f"hits: expected the result of `pgccd.detect`, got {arguments.describe(hits)}")
    count, segments = scene.body_count, motion.segment_count if isinstance(motion, Trajectory) else 1
    is_row = _array(hits.pairs)[:, 0] >= 0  # padding is -1
    pairs = _array(hits.pairs)[is_row]
    if len(pairs) and pairs.max() >= count:
        raise ValueError(f"hits: has a contact of body {pairs.max()}, but the scene has {count} bodies")
    colliding = np.zeros(count, dtype=bool)
    colliding[pairs.ravel()] = True
    if hits._incomplete is not None and bool(hits._incomplete):
        notes.append(INCOMPLETE)
    if not isinstance(hits, ContactColumns):
        notes.append(WITHOUT_TIMES)
        return colliding, Marks.none()
    if isinstance(hits, TrajectoryContacts) != isinstance(motion, Trajectory):
        given = "of a trajectory" if isinstance(hits, TrajectoryContacts) else "of one step"
        raise ValueError(f"hits: are {given}, the motion is a {type(motion).__name__}: expected those of this motion")
    toi = hits.toi
    if isinstance(hits, PaddedContacts) and hits._found_toi is not None:
        toi = hits._found_toi  # `toi` is 0 in an incomplete result
    segment = np.zeros(len(pairs), dtype=np.int64)
    if isinstance(hits, TrajectoryContacts):
        segment = _array(hits.segment)[is_row]
        if len(segment) and segment.max() >= segments:
            raise ValueError(f"hits: has a contact in segment {segment.max()}, but the motion has {segments}")
    names = ("point", "normal", "kind", "features", "status")
    point, normal, kind, features, status = (_array(getattr(hits, name))[is_row] for name in names)
    return colliding, Marks(
        pairs, segment, _array(toi)[is_row], point, normal, kind.astype(np.int64), features, status == 2
    )


def merged_paths(paths: RigidPaths, waypoints: np.ndarray) -> RigidPaths:
    """The paths through some of the waypoints (first and last included): segments between neighbours stay as they are,
    on others bodies move straight and turn the shorter way.
    """
    begin, end = waypoints[:-1], waypoints[1:]
    rotation = paths.rotation[begin].copy()
    for row in np.flatnonzero(end > begin + 1):
        start = torch.from_numpy(np.ascontiguousarray(paths.orientation[begin[row]]))
        if end[row] < len(paths.orientation):
            last = torch.from_numpy(np.ascontiguousarray(paths.orientation[end[row]]))
        else:
            last = end_orientation(paths.orientation[-1], paths.rotation[-1])
        rotation[row] = ops.rotations_between(start, last).numpy()
    return RigidPaths(paths.position[waypoints], paths.orientation[begin], rotation, paths.is_linear)


def end_orientation(orientation: np.ndarray, rotation: np.ndarray, time: float = 1.0) -> Tensor:
    """(N, 4): orientations (N, 4) turned by rotation vectors (N, 3), at a time in [0, 1]."""
    start, turn = (torch.from_numpy(np.ascontiguousarray(column)) for column in (orientation, rotation))
    nowhere = torch.zeros_like(turn)
    return ops.poses_at(nowhere, nowhere, start, turn, torch.full_like(turn[:, 0], time))[1]
