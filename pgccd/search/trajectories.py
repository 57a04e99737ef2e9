"""Detection along a trajectory: all segments in one call."""

from dataclasses import replace
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from pgccd.contacts.by_body import SceneBodies
from pgccd.contacts.contacts import CollidingPairs, Contacts, earliest_row
from pgccd.contacts.trajectories import TrajectoryContacts, time_along
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import with_gradient_of
from pgccd.motion.of_scene import in_scene, segments_as_step
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import narrow
from pgccd.search.checks import check_pairs

R_co = TypeVar("R_co", bound=Contacts | CollidingPairs, covariant=True)


class FindInStep(Protocol[R_co]):
    """Finds the contacts, or the colliding pairs, of one step."""

    def __call__(self, scene: Scene, motion: RigidMotion | VertexMotion, *, pairs: Tensor | None) -> R_co:
        """As `pgccd.detect` and `pgccd.collide`, with other arguments bound."""


def detect_segments(
    scene: Scene, trajectory: Trajectory, find: FindInStep[R_co], pairs: Tensor | None = None
) -> tuple[R_co, Tensor, Tensor]:
    """What `find` finds in each segment of a trajectory: rows with pairs of the copies described below, sorted by
    segment; and for each row its segment (K,) and its pair (K, 2) in the scene.

    All segments run as one step of a scene with one copy of each body per segment; the copies of different segments are
    in different worlds, so no broad phase pairs them.
    """
    if pairs is not None:
        pairs = check_pairs(pairs, scene, trajectory.orientation is None, ascending=True)
    copies, steps, of_copies = segments_as_step(scene, trajectory, pairs)
    found = find(copies, steps, pairs=of_copies)
    return found, *in_scene(found.pairs, scene.body_count)


def pairs_along(
    scene: Scene, trajectory: Trajectory, find: FindInStep[CollidingPairs], pairs: Tensor | None
) -> CollidingPairs:
    """`pgccd.collide` for a trajectory, given `find` for a step."""
    found, _, bodies = detect_segments(scene, trajectory, find, pairs)
    bodies = torch.unique(bodies, dim=0) if len(bodies) else bodies
    stats = replace(found.stats, bodies=scene.body_count, needed=None, contacts=len(bodies))
    return CollidingPairs(pairs=bodies, stats=stats, _bodies=SceneBodies.of(scene))


def contacts_along(
    scene: Scene,
    trajectory: Trajectory,
    report: narrow.Report,
    find: FindInStep[Contacts],
    pairs: Tensor | None,
) -> TrajectoryContacts:
    """`pgccd.detect` for a trajectory.

    Args:
        scene, trajectory, report, pairs: its arguments.
        find: `detect` for a step; by report "first" for "earliest", which selects from the first contacts of all
            segments.
    """
    found, _, _ = detect_segments(scene, trajectory, find, pairs)
    return of_trajectory(found, scene, trajectory.segment_count, report)


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
        _bodies=SceneBodies.of(scene),
        _is_earliest=report == "earliest",
        _differentiable=None if found._differentiable is None else found._differentiable[chosen],
        _found_with=None if found._found_with is None else found._found_with | {"report": report},
    )


def _first_of_pairs(pairs: Tensor, count: int) -> Tensor:
    """The first row of each pair of `pairs` (K, 2), in the order of the pairs."""
    keys, pair_of_row = torch.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    rows = torch.arange(len(pairs), device=pairs.device)
    return torch.full_like(keys, len(pairs)).scatter_reduce_(0, pair_of_row, rows, "amin")
