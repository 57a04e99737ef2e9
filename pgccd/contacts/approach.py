"""How fast the gaps of contacts close at their toi."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import Contacts
from pgccd.contacts.gradients import corner_points
from pgccd.contacts.kinds import Kind
from pgccd.contacts.operands import operands
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import with_gradient_of
from pgccd.motion.of_scene import check_step, segments_as_step
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory

# Places that differ by less than this part of the sizes involved are the same.
_SAME_PLACE = 1e-10


def approach_rates(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: Contacts) -> Tensor:
    """The rate at which the gap between the nearest points of contacts closes at toi, along `normal`, in the scene's
    length units per step (for a trajectory, per segment). Divided by the duration of the step, it is the normal
    approach velocity. Negative: the points recede. 0: they rest or slide. Has gradients if toi has.

    Where features touch exactly, their normal may point to the wrong side on bodies that are not convex, unless
    `detect` was given normals="surface". If toi > 0 the rate is positive nevertheless, since the features were apart
    before. At t = 0 it has the sign that the normal gives; `pgccd.approaching` does not depend on that sign. A body
    inside of a solid, of kind `INSIDE`, has no normal, and the rate is NaN.

    Args:
        scene, motion: those that `detect` found the contacts with, unchanged.
        hits: K contacts, on the scene's device.

    Returns:
        (K,) float64. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if the contacts are of one of several ranks.

    Example:
        >>> speed = pgccd.approach_rates(scene, motion, hits).clamp(min=0.0) / dt
    """
    copies, steps, bodies = moving_bodies(scene, motion, hits)
    rate, is_reversed = checked_rates(copies, steps, bodies, hits)
    if hits._differentiable is None:
        return rate
    _, velocity = corner_points(copies, steps, bodies, hits.kind, hits.features, hits.toi)
    speed = _weighted(hits, velocity)
    normal = torch.where(hits.differentiable[:, None], hits.normal, 0.0)
    expression = -(normal * (speed[:, 1] - speed[:, 0])).sum(1)  # its bits depend on the device
    expression = torch.where(is_reversed, -expression, expression)
    return with_gradient_of(rate, expression, "approach")


def moving_bodies(
    scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: Contacts
) -> tuple[Scene, RigidMotion | VertexMotion, Tensor]:
    """The scene and the motion of contacts (for a trajectory, with copies of all bodies for each segment), and the rows
    of their bodies (K, 2).

    Raises:
        TypeError, ValueError: naming the argument that is not of these contacts.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
    if not isinstance(hits, Contacts):
        raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
    if hits._is_of_rank:
        raise ValueError("hits: are the contacts of one of several ranks, which does not have all paths")
    if hits.toi.device != scene.device:
        raise ValueError(f"hits: are on {hits.toi.device}, the scene on {scene.device}")
    if len(hits) and int(hits.pairs.amax()) >= scene.body_count:
        raise ValueError(f"hits: have body {int(hits.pairs.amax())}, the scene {scene.body_count} bodies")
    if isinstance(motion, Trajectory) != isinstance(hits, TrajectoryContacts):
        expected = "the trajectory" if isinstance(hits, TrajectoryContacts) else "the motion of the step"
        raise TypeError(f"motion: expected {expected} of the contacts, got {arguments.describe(motion)}")
    if isinstance(motion, Trajectory) and isinstance(hits, TrajectoryContacts):
        copies, steps, _ = segments_as_step(scene, motion, None)
        if len(hits) and int(hits.segment.amax()) >= motion.segment_count:
            expected = f"{int(hits.segment.amax()) + 1} segments or more, as the contacts have"
            raise ValueError(f"motion: expected {expected}, got {motion.segment_count}")
        return copies, steps, hits.pairs + hits.segment[:, None] * scene.body_count
    if not isinstance(motion, (RigidMotion, VertexMotion)):
        kinds = "a pgccd.RigidMotion, VertexMotion or Trajectory"
        raise TypeError(f"motion: expected {kinds}, got {arguments.describe(motion)}")
    check_step(scene._detached(), motion._detached())
    return scene, motion, hits.pairs


def checked_rates(
    scene: Scene, motion: RigidMotion | VertexMotion, bodies: Tensor, contacts: Contacts
) -> tuple[Tensor, Tensor]:
    """`approach_rates` (K,) of contacts of bodies (K, 2), and whether the normal pointed to the wrong side (K,).
    Synchronises with a GPU.

    Raises:
        ValueError: the features of a contact are elsewhere at toi: scene or motion are not those of these contacts.
    """
    rate, is_reversed, away, size = ops.closing_rates(*operands(scene, motion, bodies, contacts))
    # A body inside of a solid has no rate, and always stays in.
    is_wrong = ~(away <= _SAME_PLACE * size) & (contacts.kind != Kind.INSIDE)
    if bool(is_wrong.any()):
        row = int(is_wrong.long().argmax())
        raise ValueError(
            f"motion: contact {row} is {float(away[row]):.3g} from where its features are at toi: give the scene and "
            "the motion with which the contacts were found, unchanged"
        )
    return rate, is_reversed.bool()


def _weighted(contacts: Contacts, velocity: Tensor) -> Tensor:
    """(K, 2, 3): velocities of the nearest points of both features; of vertices with faces and of edges.

    Args:
        velocity: (K, 2, 3, 3), of corners, see `Corners`.
    """
    u, v = contacts.coordinates.unbind(1)
    zero = torch.zeros_like(u)
    weights = torch.stack([1.0 - u - v, u, v], 1)[:, None].expand(-1, 2, -1)
    on_edges = torch.stack([torch.stack([1.0 - u, u, zero], 1), torch.stack([1.0 - v, zero, v], 1)], 1)
    weights = torch.where((contacts.kind == Kind.EE)[:, None, None], on_edges, weights)
    return (weights[:, :, :, None] * velocity).sum(2)
