"""Pictures of the nanorobot model: a world between two steps, or after one, and the pictures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pgccd.contacts.kinds import Kind
from pgccd.geometry.mesh import Mesh
from pgccd.motion.paths import RigidMotion
from pgccd.sim.model import Model, ModelConfig, RobotState
from pgccd.sim.runner import Run
from pgccd.sim.step import Step
from pgccd.viz import Impact, Page, Snapshot, world_picture
from pgccd.viz.animation import Animation, animation_of
from pgccd.viz.raster import placed

# The features of two touching bodies.
_SHAPES = {Kind.VF_AB: ("vertex", "face"), Kind.VF_BA: ("face", "vertex"), Kind.EE: ("edge", "edge")}


# A page plays this many steps, if their poses fit on it with most robots.
_MOST_SHOWN, _POSES_SHOWN = 6, 60_000


def shown_steps(config: ModelConfig) -> int:
    """Number of last steps that the page of a run plays."""
    return min(_MOST_SHOWN, max(1, _POSES_SHOWN // config.robots))


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
        >>> snapshot = pgccd.sim.snapshot_of_step(model, step)
    """
    snapshot = snapshot_of_state(model, step.after, caption)
    snapshot.colliding = step.resolution.stopped.cpu().numpy()
    snapshot.impact = _impact(model, step)
    return snapshot


def page_of_steps(model: Model, steps: Sequence[Step], caption: Sequence[str] = ()) -> Page:
    """A page that plays consecutive steps: the robots on the paths that they moved, and for each step the robots that
    stopped and the contacts.

    Args:
        model: the rules.
        steps: of the same robots.
        caption: a title, then statistics.

    Raises:
        ValueError: there is no step.

    Example:
        >>> pgccd.sim.page_of_steps(model, [step]).save("model.html")
        PosixPath('model.html')
    """
    if not steps:
        raise ValueError("steps: expected at least one step")
    motions = [model.motion(step.before) for step in steps]
    fractions = [step.resolution.fraction for step in steps]
    animation = animation_of(model.scene(steps[0].before.id), motions, [step.contacts for step in steps], fractions)
    # Later rounds also stop robots without a contact on their whole paths.
    animation.hit = np.stack([step.resolution.stopped.cpu().numpy() for step in steps])
    return _page(model, steps[0].before, animation, steps[0].index, caption)


def _page(model: Model, state: RobotState, animation: Animation, step: int | None, caption: Sequence[str]) -> Page:
    """The page of an animation of these robots, from this step on."""
    half = np.array(model.half_extent)
    animation.ids, animation.box, animation.first_step = state.id.cpu().numpy(), np.stack([-half, half]), step
    animation.title, *animation.notes = caption or ["Nanorobot world"]
    return Page(animation, playing=step is not None)


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
    """Writes `world.html` of a run's last steps, and `world.png` of the last one.

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
    if run.last_steps:
        step = run.last_steps[-1]
        record = step.record
        caption.append(f"{record['pcs']:,} potentially colliding pairs")
        caption.append(f"{record['contacts']:,} contacts, each with its time of impact")
        caption.append(f"{record['stopped']:,} robots stopped")
        caption.append(f"{1e3 * record['seconds']:,.1f} ms for the step on {run.model.device.type}")
        snapshot = snapshot_of_step(run.model, step, caption)
        plays = f"Plays step {step.index}"
        if len(run.last_steps) > 1:
            plays = f"Plays steps {run.last_steps[0].index} to {step.index}; the numbers are those of step {step.index}"
        page = page_of_steps(run.model, run.last_steps, [*caption, plays])
    else:
        snapshot = snapshot_of_state(run.model, run.state, caption)
        at_rest = RigidMotion.at_rest(run.state.position, run.state.orientation)
        page = _page(run.model, run.state, animation_of(run.model.scene(run.state.id), at_rest), None, caption)
    page_file, picture = folder / "world.html", folder / "world.png"
    for path in (page_file, picture):
        path.unlink(missing_ok=True)  # links are not followed
    return {"page": page.save(page_file), "picture": world_picture(picture, snapshot)}
