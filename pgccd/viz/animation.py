"""What a page shows, as numpy arrays: bodies, their paths, and contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import ContactColumns, PairColumns
from pgccd.contacts.kinds import Status
from pgccd.contacts.padded import PaddedContacts
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import require_meshes
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.times import fractions_of
from pgccd.motion.trajectory import Trajectory
from pgccd.viz.shapes import Shape, drawn

_StepMotion: TypeAlias = RigidMotion | VertexMotion
#: The motion of a scene.
AnyMotion: TypeAlias = _StepMotion | Trajectory
#: The motion of the bodies of a page; or the motions of consecutive steps.
Motions: TypeAlias = AnyMotion | Sequence[_StepMotion]
#: Contacts of that motion; of consecutive steps those of each step.
AnyHits: TypeAlias = PairColumns | Sequence[PairColumns | None] | None
#: Part of its path that each body moves; of consecutive steps those of each step.
AnyFraction: TypeAlias = Tensor | float | Sequence[Tensor | float] | None

INCOMPLETE = (
    "The result is incomplete (a capacity was exceeded, or a pose is invalid): there may be other contacts, and every "
    "body counts as colliding at the start."
)
WITHOUT_TIMES = "The result of collide has pairs of bodies, but no times and points of contacts."


@dataclass
class RigidPaths:
    """Paths of N rigid bodies in S segments. World frame, length units.

    Attributes:
        start, end: (S, N, 3) positions of the origins at the ends of each segment.
        orientation: (S, N, 4) at the start of each segment.
        rotation: (S, N, 3) rotation vector of each segment, radians.
        is_linear: whether vertices move straight between the two poses.
    """

    start: np.ndarray
    end: np.ndarray
    orientation: np.ndarray
    rotation: np.ndarray
    is_linear: bool = False


@dataclass
class VertexPaths:
    """Straight paths of the X vertices of N deforming bodies in S segments. World frame, length units.

    Attributes:
        position: (W, X, 3) at W moments, of all vertices that are drawn.
        ends: (S, 2) moments at the start and end of each segment.
        begin: (N,) first vertex of each body.
    """

    position: np.ndarray
    ends: np.ndarray
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

    @classmethod
    def joined(cls, parts: Sequence[Marks]) -> Marks:
        """The contacts of all parts, in their order."""
        columns = [vars(part).values() for part in (cls.none(), *parts)]
        return cls(*map(np.concatenate, zip(*columns, strict=True)))


@dataclass
class Animation:
    """N bodies on their paths in S segments, and contacts.

    Attributes:
        shapes: what is drawn of each mesh. For deforming bodies only the faces are used.
        shape_index: (N,) shape of each body.
        paths: of the bodies.
        hit: (S, N) bool: whether a body collides in a segment.
        static: (N,) bool.
        ids: (N,) numbers of the bodies.
        marks: contacts on the whole paths.
        world: (N,) int, or None.
        margin: (N,) length units, beyond what is drawn; or None.
        fraction: (S, N): body i moves on x_i(fraction_i t) in each segment; or None.
        first_step: number of the first segment, if segments are steps; None: segments lie between waypoints.
        names: of bodies, by number; or None.
        box: (2, 3) lower and upper corner of a box that is drawn, or None.
        title: of the page.
        notes: sentences below it.
    """

    shapes: list[Shape]
    shape_index: np.ndarray
    paths: RigidPaths | VertexPaths
    hit: np.ndarray
    static: np.ndarray
    ids: np.ndarray
    marks: Marks = field(default_factory=Marks.none)
    world: np.ndarray | None = None
    margin: np.ndarray | None = None
    fraction: np.ndarray | None = None
    first_step: int | None = None
    names: list[str] | None = None
    box: np.ndarray | None = None
    title: str = "pgccd"
    notes: list[str] = field(default_factory=list)

    @property
    def segment_count(self) -> int:
        """Number of segments of the paths."""
        return len(self.hit)

    @property
    def colliding(self) -> np.ndarray:
        """(N,) bool: whether a body collides in any segment."""
        return np.asarray(self.hit.any(axis=0))


def animation_of(
    scene: Scene,
    motion: Motions,
    hits: AnyHits = None,
    fraction: AnyFraction = None,
    world: int | None = None,
    names: Sequence[str] | None = None,
) -> Animation:
    """The animation of a scene and its motion, with the contacts found for them. Synchronises with a GPU.

    Args:
        scene, motion, hits, fraction, world, names: as for `pgccd.show`.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    arguments.instance(scene, "scene", Scene)
    steps = _steps(motion)
    if fraction is not None and isinstance(motion, Trajectory):
        raise ValueError("fraction: expected a motion of one step, or a list of steps, got a Trajectory")
    scene._refuse()
    require_meshes(scene.mesh_index, len(scene.meshes))
    count, of_worlds = scene.body_count, _worlds(scene, world)
    is_list = not isinstance(motion, (RigidMotion, VertexMotion, Trajectory))
    paths = _paths(scene, steps, is_list)
    segments = len(paths.orientation if isinstance(paths, RigidPaths) else paths.ends)
    notes: list[str] = []
    hit, marks = np.zeros((segments, count), dtype=bool), []
    for index, found in enumerate(_of_steps(hits, len(steps), "hits") if is_list else [hits]):
        if found is not None:
            name = f"hits[{index}]" if is_list else "hits"
            rows, of_step = _found(found, scene, steps[index], notes, name)
            of_step.segment += index
            hit[index : index + len(rows)] = rows
            marks.append(of_step)
    fractions = None
    if fraction is not None:
        each: list[Any] = _of_steps(fraction, len(steps), "fraction") if is_list else [fraction]
        fractions = np.stack([_array(fractions_of(part, count, scene.device)) for part in each])
    static = None if scene.static is None else _array(scene.static)
    shapes = [drawn(mesh) for mesh in scene.meshes.meshes]
    shape_index = _array(scene.mesh_index).astype(np.int64)
    margin = _margins(scene, shapes, shape_index)
    animation = Animation(
        shapes=shapes,
        shape_index=shape_index,
        paths=paths if isinstance(paths, RigidPaths) else _of_all_drawn(paths, shapes, shape_index),
        hit=hit,
        static=np.zeros(count, dtype=bool) if static is None else static.astype(bool),
        ids=np.arange(count),
        marks=Marks.joined(marks),
        world=of_worlds if of_worlds is not None and of_worlds.any() else None,
        margin=margin if margin is not None and margin.any() else None,
        fraction=fractions,
        first_step=0 if is_list else None,
        names=None if names is None else arguments.body_names(names, count),
        notes=list(dict.fromkeys(notes)),
    )
    if world is None or of_worlds is None:
        return animation
    return replace(_chosen(animation, np.flatnonzero(of_worlds == world)), world=None)


def _array(column: Tensor) -> np.ndarray:
    return column.detach().cpu().numpy()


def _steps(motion: Any) -> list[AnyMotion]:
    """The steps of a list; for another motion, a list of that motion alone."""
    if isinstance(motion, (RigidMotion, VertexMotion, Trajectory)):
        return [motion]
    if not isinstance(motion, Sequence) or isinstance(motion, str):
        expected = "a RigidMotion, VertexMotion or Trajectory, or a list of steps"
        raise TypeError(f"motion: expected {expected}, got {arguments.describe(motion)}")
    if not motion:
        raise ValueError("motion: expected at least one step, got an empty list")
    for index, step in enumerate(motion):
        if not isinstance(step, (RigidMotion, VertexMotion)):
            expected = "a RigidMotion or VertexMotion"
            raise TypeError(f"motion[{index}]: expected {expected}, got {arguments.describe(step)}")
        kinds = [
            f"{type(each).__name__}, path {each.path!r}" if isinstance(each, RigidMotion) else type(each).__name__
            for each in (motion[0], step)
        ]
        if kinds[0] != kinds[1]:
            raise ValueError(f"motion[{index}]: expected a motion like the first ({kinds[0]}), got {kinds[1]}")
    return list(motion)


def _of_steps(values: Any, steps: int, name: str) -> list[Any]:
    """One value for each step of a list."""
    if values is None or (name == "fraction" and isinstance(values, (int, float))):
        return [values] * steps
    is_tensor = name == "fraction" and isinstance(values, Tensor) and values.dim() == 2
    if not is_tensor and (not isinstance(values, Sequence) or isinstance(values, str)):
        raise TypeError(f"{name}: expected a list with one entry a step, got {arguments.describe(values)}")
    if len(values) != steps:
        raise ValueError(f"{name}: expected one entry for each of the {steps} steps, got {len(values)}")
    return list(values)


def _worlds(scene: Scene, world: int | None) -> np.ndarray | None:
    """The worlds of the bodies (N,), if any."""
    if world is None:
        return None if scene.world is None else _array(scene.world)
    if isinstance(world, bool) or not isinstance(world, int):
        raise TypeError(f"world: expected an integer, got {arguments.describe(world)}")
    if scene.world is None:
        raise ValueError(f"world: the scene has no worlds (`Scene.world`), got {world}")
    of_bodies = _array(scene.world)
    if not (of_bodies == world).any():
        raise ValueError(f"world: no body of the scene is in world {world}")
    return of_bodies


def _chosen(animation: Animation, rows: np.ndarray) -> Animation:
    """The animation of some of the bodies, by ascending row."""
    place = np.full(len(animation.shape_index), -1)
    place[rows] = np.arange(len(rows))
    marks = animation.marks[(place[animation.marks.bodies] >= 0).all(axis=1)]
    marks.bodies = place[marks.bodies]
    paths = animation.paths
    if isinstance(paths, RigidPaths):
        columns = {name: getattr(paths, name)[:, rows] for name in ("start", "end", "orientation", "rotation")}
        paths = replace(paths, **columns)
    else:
        shapes = [animation.shapes[shape] for shape in animation.shape_index[rows]]
        counts = np.array([len(shape.vertices) for shape in shapes], dtype=np.int64)
        begin = np.cumsum([0, *counts])
        vertices = np.arange(begin[-1]) + np.repeat(paths.begin[rows] - begin[:-1], counts)
        paths = VertexPaths(paths.position[:, vertices], paths.ends, begin[:-1])
    of_bodies = {name: getattr(animation, name) for name in ("shape_index", "static", "ids", "world", "margin")}
    changed: dict[str, Any] = {n: None if column is None else column[rows] for n, column in of_bodies.items()}
    fraction = None if animation.fraction is None else animation.fraction[:, rows]
    return replace(animation, paths=paths, marks=marks, hit=animation.hit[:, rows], fraction=fraction, **changed)


def _paths(scene: Scene, steps: list[AnyMotion], is_list: bool) -> RigidPaths | VertexPaths:
    is_rigid, found = True, []
    for index, motion in enumerate(steps):
        if isinstance(motion, Trajectory):
            step, segments = motion.steps(), motion.segment_count
        else:
            motion.check()
            step, segments = motion, 1
        is_rigid = isinstance(step, RigidMotion)
        names = ("position_t0", "position_t1", "orientation_t0", "rotation") if is_rigid else ("x_t0", "x_t1")
        all_columns = step.columns()
        columns = [_array(all_columns[name]) for name in names]
        columns = [column.reshape(segments, -1, column.shape[1]) for column in columns]
        expected = scene.body_count if is_rigid else scene.layout.vertex_count
        if columns[0].shape[1] != expected:
            what, name = "bodies" if is_rigid else "vertices", f"motion[{index}]" if is_list else "motion"
            raise ValueError(f"{name}: has {columns[0].shape[1]} {what}, the scene {expected}")
        found.append(columns)
    joined = [np.concatenate(column) for column in zip(*found, strict=True)]
    first = steps[0]
    if is_rigid:
        is_linear = not isinstance(first, VertexMotion) and first.path == "linear"
        start, end, orientation, rotation = joined
        return RigidPaths(start, end, orientation, rotation, is_linear)
    start, end = joined
    # If a segment begins at the end of the one before, as in trajectories, these vertices are stored once.
    moments, ends = [start[:1]], []
    for segment in range(len(start)):
        if segment and not np.array_equal(start[segment], moments[-1][0]):
            moments.append(start[segment : segment + 1])
        ends.append((len(moments) - 1, len(moments)))
        moments.append(end[segment : segment + 1])
    return VertexPaths(np.concatenate(moments), np.array(ends), _array(scene.layout.vertex_begin))


def _of_all_drawn(paths: VertexPaths, shapes: list[Shape], index: np.ndarray) -> VertexPaths:
    """The paths of all that is drawn, from those of the meshes' vertices."""
    if all(shape.vertex_count == len(shape.vertices) for shape in shapes):
        return paths
    pieces = []
    for body, begin in zip(index.tolist(), paths.begin.tolist(), strict=True):
        pieces.append(shapes[body].moved(paths.position[:, begin : begin + shapes[body].vertex_count]))
    begins = np.cumsum([0, *(piece.shape[1] for piece in pieces)])[:-1]
    return VertexPaths(np.concatenate([paths.position[:, :0], *pieces], axis=1), paths.ends, begins)


def _margins(scene: Scene, shapes: list[Shape], index: np.ndarray) -> np.ndarray | None:
    """(N,): margins, plus the thickness of meshes as far as it is not drawn. Triangles are drawn without a thickness,
    so a mesh that has triangles counts its whole thickness.
    """
    if scene._thickness is None:
        return None
    is_drawn = np.array([not shape.triangle_count and shape.thickness > 0.0 for shape in shapes], dtype=bool)
    if not is_drawn.any():
        return _array(scene._thickness)
    thickness = np.where(is_drawn, [mesh.thickness for mesh in scene.meshes.meshes], 0.0)
    return np.maximum(_array(scene._thickness) - thickness[index], 0.0)


def _found(hits: Any, scene: Scene, motion: AnyMotion, notes: list[str], name: str) -> tuple[np.ndarray, Marks]:
    """Which bodies collide in each segment of a motion (S, N), and the contacts."""
    if not isinstance(hits, PairColumns):
        raise TypeError(f"{name}: expected the result of `pgccd.detect`, got {arguments.describe(hits)}")
    count, segments = scene.body_count, motion.segment_count if isinstance(motion, Trajectory) else 1
    is_row = _array(hits.pairs)[:, 0] >= 0  # padding is -1
    pairs = _array(hits.pairs)[is_row]
    if len(pairs) and pairs.max() >= count:
        raise ValueError(f"{name}: has a contact of body {pairs.max()}, but the scene has {count} bodies")
    hit = np.zeros((segments, count), dtype=bool)
    if hits._incomplete is not None and bool(hits._incomplete):
        notes.append(INCOMPLETE)
    if not isinstance(hits, ContactColumns):
        notes.append(WITHOUT_TIMES)
        hit[:, pairs.ravel()] = True
        return hit, Marks.none()
    if isinstance(hits, TrajectoryContacts) != isinstance(motion, Trajectory):
        given = "of a trajectory" if isinstance(hits, TrajectoryContacts) else "of one step"
        raise ValueError(
            f"{name}: are {given}, the motion is a {type(motion).__name__}: expected contacts of this motion"
        )
    toi = hits.toi
    if isinstance(hits, PaddedContacts) and hits._found_toi is not None:
        toi = hits._found_toi  # `toi` is 0 in an incomplete result
    segment = np.zeros(len(pairs), dtype=np.int64)
    if isinstance(hits, TrajectoryContacts):
        segment = _array(hits.segment)[is_row].copy()
        if len(segment) and segment.max() >= segments:
            raise ValueError(f"{name}: has a contact in segment {segment.max()}, but the motion has {segments}")
    hit[segment[:, None], pairs] = True
    names = ("point", "normal", "kind", "features", "status")
    point, normal, kind, features, status = (_array(getattr(hits, name))[is_row] for name in names)
    normal = np.where(np.isnan(normal), 0.0, normal)  # of bodies inside of solids: no arrow
    return hit, Marks(
        pairs, segment, _array(toi)[is_row], point, normal, kind.astype(np.int64), features, status == Status.UNRESOLVED
    )


def thinned_paths(paths: RigidPaths | VertexPaths, waypoints: np.ndarray) -> RigidPaths | VertexPaths:
    """The paths between some of the waypoints, 0 to S (first and last included). Segments between neighbouring
    waypoints do not change. On other segments, none of which is the last, bodies move straight to where the next
    segment begins, and turn the shorter way.
    """
    begin, end = waypoints[:-1], waypoints[1:]
    merged = np.flatnonzero(end > begin + 1)
    if isinstance(paths, VertexPaths):
        ends = paths.ends[begin]
        ends[merged, 1] = paths.ends[end[merged], 0]
        used, compact = np.unique(ends, return_inverse=True)
        return replace(paths, position=paths.position[used], ends=compact.reshape(ends.shape))
    goal, rotation = paths.end[begin].copy(), paths.rotation[begin].copy()
    for row in merged:
        goal[row] = paths.start[end[row]]
        turned = (torch.from_numpy(np.ascontiguousarray(paths.orientation[k])) for k in (begin[row], end[row]))
        rotation[row] = ops.rotations_between(*turned).numpy()
    return RigidPaths(paths.start[begin], goal, paths.orientation[begin], rotation, paths.is_linear)
