"""Data of the pictures: a world at the end of a step, and one collision of that step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pgccd.detection.narrow import Kind
from pgccd.geometry.mesh import Mesh
from pgccd.motion.paths import RigidMotion
from pgccd.sim import Model, RobotState, Step
from pgccd.viz.raster import placed

# The features of two touching bodies.
_SHAPES = {Kind.VF_AB: ("vertex", "face"), Kind.VF_BA: ("face", "vertex"), Kind.EE: ("edge", "edge")}


@dataclass
class Impact:
    """One contact of two bodies, i and j, at its toi."""

    ids: tuple[int, int]
    kinds: tuple[int, int]  #: their meshes
    toi: float
    feature: str  #: description of the touching features
    point: np.ndarray  #: (3,) world
    normal: np.ndarray  #: (3,) unit, from i towards j
    position: np.ndarray  #: (3, 2, 3) at t0, at toi, and at t1 if it had not stopped
    orientation: np.ndarray  #: (3, 2, 4)
    times: np.ndarray  #: (n,) in [0, 1]
    gap: np.ndarray  #: (n,) between the two touching features along the normal, at those times


@dataclass
class Motion:
    """The motion of the step that led to a snapshot, for playback."""

    position: np.ndarray  #: (N, 3) at t0
    orientation: np.ndarray  #: (N, 4) at t0
    velocity: np.ndarray  #: (N, 3) displacement of the whole step
    angular_velocity: np.ndarray  #: (N, 3) rotation vector of the whole step
    fraction: np.ndarray  #: (N,) part of the step that each body moved
    contact_ids: np.ndarray  #: (K, 2) of all contacts
    contact_toi: np.ndarray  #: (K,)
    contact_point: np.ndarray  #: (K, 3)


@dataclass
class Snapshot:
    """A world at one moment, as numpy arrays.

    Example:
        >>> pgccd.viz.world_picture("model.png", pgccd.viz.Snapshot.of_step(model, step, ["After step 7"]))
    """

    meshes: list[Mesh]
    kind: np.ndarray  #: (N,) mesh of each body
    position: np.ndarray  #: (N, 3)
    orientation: np.ndarray  #: (N, 4)
    colliding: np.ndarray  #: (N,) bool
    half_extent: np.ndarray  #: (3,) of the box, centred on the origin
    caption: list[str] = field(default_factory=list)  #: a title, then statistics
    motion: Motion | None = None
    impact: Impact | None = None

    @classmethod
    def of_state(cls, model: Model, state: RobotState, caption: Sequence[str] = ()) -> Snapshot:
        """The robots between two steps, without collisions."""
        return cls(
            model.meshes.meshes,
            (state.id % len(model.meshes)).cpu().numpy(),
            state.position.cpu().numpy(),
            state.orientation.cpu().numpy(),
            np.zeros(len(state), dtype=bool),
            np.array(model.half_extent),
            list(caption),
        )

    @classmethod
    def of_step(cls, model: Model, step: Step, caption: Sequence[str] = ()) -> Snapshot:
        """A world after a step, with the robots that collided in it."""
        snapshot = cls.of_state(model, step.after, caption)
        snapshot.colliding = step.resolution.stopped.cpu().numpy()
        before, contacts = step.before, step.contacts
        point = torch.zeros((0, 3)) if contacts.point is None else contacts.point
        columns = [before.position, before.orientation, before.velocity, before.angular_velocity]
        columns += [step.resolution.fraction, before.id[contacts.pairs], step.toi, point]
        snapshot.motion = Motion(*(column.cpu().numpy() for column in columns))
        snapshot.impact = _impact(model, step)
        return snapshot


def _impact(model: Model, step: Step) -> Impact | None:
    """The contact whose toi is nearest to the middle of the step, with motion before and after it."""
    contacts = step.contacts
    if len(contacts) == 0:
        return None
    row = int(torch.argmin((step.toi - 0.5).abs()))
    toi, pair = float(step.toi[row]), contacts.pairs[row]
    names = ("kind", "features", "coordinates", "point", "normal")  # report="first" gives all columns
    kind, features, coordinates, point, normal = (getattr(contacts, name)[row].cpu().numpy() for name in names)
    shapes = _SHAPES[int(kind)]
    first, second = step.before.id[pair].tolist()
    kinds = first % len(model.meshes), second % len(model.meshes)
    motion = model.motion(step.before)[pair]
    times = np.linspace(0.0, 1.0, 401)
    position, orientation = _poses(motion, times)
    paths = []
    for body in range(2):
        at = coordinates[body:] if shapes[body] == "edge" else coordinates
        local = _point_on(model.meshes.meshes[kinds[body]], shapes[body], int(features[body]), at)
        paths.append(placed(local[None], position[:, body], orientation[:, body])[:, 0])
    return Impact(
        (first, second),
        kinds,
        toi,
        f"{shapes[0]} {features[0]} of {first} on {shapes[1]} {features[1]} of {second}",
        point,
        normal,
        *_poses(motion, np.array([0.0, toi, 1.0])),
        times,
        (paths[1] - paths[0]) @ normal,
    )


def _poses(motion: RigidMotion, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, N, 3) and orientations (n, N, 4) of all bodies at these times (n,)."""
    position, orientation = motion.at(torch.from_numpy(times)[:, None])
    return position.cpu().numpy(), orientation.cpu().numpy()


def _point_on(mesh: Mesh, shape: str, index: int, at: np.ndarray) -> np.ndarray:
    """(3,): the point of a vertex, edge or face with these coordinates, in the body frame."""
    rows = {"edge": mesh.edges, "face": mesh.faces}.get(shape, torch.arange(len(mesh.vertices))[:, None])[index]
    corners = mesh.vertices[rows.long()].numpy()
    return corners[0] + at[: len(corners) - 1] @ (corners[1:] - corners[0])
