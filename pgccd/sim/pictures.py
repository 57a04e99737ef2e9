"""Pictures of the nanorobot model: a world between two steps, or after one, and the pictures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pgccd.detection.narrow import Kind, Status
from pgccd.geometry.mesh import Mesh
from pgccd.motion.paths import RigidMotion
from pgccd.sim.model import Model, RobotState
from pgccd.sim.runner import Run
from pgccd.sim.step import Step
from pgccd.viz import Impact, Marks, Motion, Page, Snapshot, world_picture
from pgccd.viz.raster import placed

# The features of two touching bodies.
_SHAPES = {Kind.VF_AB: ("vertex", "face"), Kind.VF_BA: ("face", "vertex"), Kind.EE: ("edge", "edge")}


def snapshot_of_state(model: Model, state: RobotState, caption: Sequence[str] = ()) -> Snapshot:
    """The robots between two steps, without collisions.

    Args:
        model: the rules.
        state: of all robots, on any device.
        caption: a title, then statistics.

    Example:
        >>> snapshot = pgccd.sim.snapshot_of_state(model, model.start())
    """
    return Snapshot(
        model.meshes.meshes,
        (state.id % len(model.meshes)).cpu().numpy(),
        state.id.cpu().numpy(),
        state.position.cpu().numpy(),
        state.orientation.cpu().numpy(),
        np.zeros(len(state), dtype=bool),
        np.array(model.half_extent),
        list(caption),
    )


def snapshot_of_step(model: Model, step: Step, caption: Sequence[str] = ()) -> Snapshot:
    """A world after a step, with the robots that collided in it.

    Args:
        caption: a title, then statistics.

    Example:
        >>> page = pgccd.viz.Page.of_snapshot(pgccd.sim.snapshot_of_step(model, step))
    """
    snapshot = snapshot_of_state(model, step.after, caption)
    snapshot.colliding = step.resolution.stopped.cpu().numpy()
    before, contacts = step.before, step.contacts
    columns = [before.position, before.orientation, before.velocity, before.angular_velocity]
    columns.append(step.resolution.fraction)
    segment = torch.zeros_like(contacts.pairs[:, 0])
    marks = [contacts.pairs, segment, step.toi, contacts.point, contacts.normal, contacts.kind, contacts.features]
    marks.append(contacts.status == Status.UNRESOLVED)
    position, orientation, velocity, spin, fraction = (column.cpu().numpy() for column in columns)
    found = Marks(*(column.cpu().numpy() for column in marks))
    snapshot.motion = Motion(position, orientation, velocity, spin, fraction, found)
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


def write_pictures(run: Run, folder: Path) -> dict[str, Path]:
    """Writes `world.html` and `world.png` of a run's last step.

    Returns:
        Their paths, by "page" and "picture".

    Raises:
        ImportError: matplotlib is not installed; the page is written anyway.
    """
    kinds = ", ".join(f"{len(mesh.faces):,}" for mesh in run.model.meshes.meshes)
    world = f"{run.model.config.robots:,} robots of {kinds} triangles, {run.model.config.pattern} model"
    caption = [f"{world}, after step {run.steps_made}"]
    if run.one_in > 1:
        caption.append(f"one in {run.one_in} robots is shown, and those that collide with them")
    if run.last_step is None:
        snapshot = snapshot_of_state(run.model, run.state, caption)
    else:
        record = run.last_step.record
        caption.append(f"{record['pcs']:,} potentially colliding pairs")
        caption.append(f"{record['contacts']:,} contacts, each with its time of impact")
        caption.append(f"{record['stopped']:,} robots stopped")
        caption.append(f"{1e3 * record['seconds']:,.1f} ms for the step on {run.model.device.type}")
        snapshot = snapshot_of_step(run.model, run.last_step, caption)
    page, picture = folder / "world.html", folder / "world.png"
    for path in (page, picture):
        path.unlink(missing_ok=True)  # links are not followed
    return {"page": Page.of_snapshot(snapshot).save(page), "picture": world_picture(picture, snapshot)}
