"""Data of the pictures: a world at the end of a step, and one collision of that step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pgccd.detection.narrow import Kind
from pgccd.geometry.mesh import Mesh
from pgccd.sim import Model, RobotState, Step
from pgccd.sim.response import respond
from pgccd.viz.raster import rotation_matrices


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
    pair = contacts.pairs[row]
    toi = float(step.toi[row])
    columns = {name: column[pair] for name, column in step.before.columns.items()}
    whole = torch.ones_like(step.toi[row])
    moments = [respond(RobotState(**columns), part.repeat(2)) for part in (0.0 * whole, step.toi[row], whole)]
    ids = (int(columns["id"][0]), int(columns["id"][1]))
    kinds = (ids[0] % len(model.meshes), ids[1] % len(model.meshes))
    meshes = [model.meshes.meshes[kind] for kind in kinds]
    kind = Kind(int(_row(contacts.kind, row)))
    features = _row(contacts.features, row).tolist()
    normal = _row(contacts.normal, row).cpu().numpy()
    coordinates = _row(contacts.coordinates, row).tolist()
    times = np.linspace(0.0, 1.0, 401)
    feature_points = _feature_points(meshes, kind, features, coordinates)
    paths = [_path(columns, body, feature_points[body], times) for body in range(2)]
    names = {
        Kind.VF_AB: f"vertex {features[0]} of {ids[0]} on face {features[1]} of {ids[1]}",
        Kind.VF_BA: f"face {features[0]} of {ids[0]} on vertex {features[1]} of {ids[1]}",
        Kind.EE: f"edge {features[0]} of {ids[0]} on edge {features[1]} of {ids[1]}",
    }
    return Impact(
        ids,
        kinds,
        toi,
        names[kind],
        _row(contacts.point, row).cpu().numpy(),
        normal,
        torch.stack([at.position for at in moments]).cpu().numpy(),
        torch.stack([at.orientation for at in moments]).cpu().numpy(),
        times,
        (paths[1] - paths[0]) @ normal,
    )


def _row(column: Tensor | None, row: int) -> Tensor:
    if column is None:
        raise AssertionError("detect(report='first') gives all columns")
    return column[row]


def _feature_points(meshes: list[Mesh], kind: Kind, features: list[int], at: list[float]) -> list[np.ndarray]:
    """The points of the two features that touch, in their body frames."""

    def on_face(mesh: Mesh, face: int) -> np.ndarray:
        a, b, c = mesh.vertices[mesh.faces[face].long()].numpy()
        return a + at[0] * (b - a) + at[1] * (c - a)

    def on_edge(mesh: Mesh, edge: int, parameter: float) -> np.ndarray:
        a, b = mesh.vertices[mesh.edges[edge].long()].numpy()
        return a + parameter * (b - a)

    if kind == Kind.VF_AB:
        return [meshes[0].vertices[features[0]].numpy(), on_face(meshes[1], features[1])]
    if kind == Kind.VF_BA:
        return [on_face(meshes[0], features[0]), meshes[1].vertices[features[1]].numpy()]
    return [on_edge(meshes[body], features[body], at[body]) for body in range(2)]


def _path(columns: dict[str, Tensor], body: int, local: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n, 3) world positions of a point of a body during the step (Rodrigues' formula)."""
    position, velocity, spin = (
        columns[name][body].cpu().numpy() for name in ("position", "velocity", "angular_velocity")
    )
    offset = rotation_matrices(columns["orientation"][body : body + 1].cpu().numpy())[0] @ local
    rate = np.linalg.norm(spin)
    axis = spin / rate if rate > 0.0 else np.array([0.0, 0.0, 1.0])
    angle = rate * times[:, None]
    turned = (
        offset * np.cos(angle) + np.cross(axis, offset) * np.sin(angle) + axis * (axis @ offset) * (1.0 - np.cos(angle))
    )
    return position + times[:, None] * velocity + turned
