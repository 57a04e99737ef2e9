"""One step of continuous collision detection, from poses to contacts or to the pairs that collide."""

import time
from functools import partial
from typing import TypedDict, Unpack, overload

from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.by_body import SceneBodies
from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.contacts.gradients import add_gradients
from pgccd.contacts.kinds import NORMALS, Normals
from pgccd.contacts.operands import operands
from pgccd.contacts.padded import PaddedCollidingPairs, PaddedContacts
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import any_differentiated
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.runtime.attempts import TooSmall, until_it_fits
from pgccd.runtime.graph import is_capturing
from pgccd.runtime.sizes import EXACTLY, BufferSizes, Capacity, sizes_of
from pgccd.search import broad, narrow
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import Initial, check_pairs, separation_value, warn_of_only_body, warn_of_rounded_positions
from pgccd.search.memory import CapacityEstimate, estimate_of, memory_limit, pairs_a_chunk
from pgccd.search.padded import PaddedSearch, search_padded, search_rigid
from pgccd.search.query import Query
from pgccd.search.streaming import stream
from pgccd.search.trajectories import contacts_along, pairs_along

# A step that overflows is repeated with a larger capacity, at most once per stage that may overflow.
_ATTEMPTS = 6


class CollideOptions(TypedDict, total=False):
    """Options of `collide`."""

    tolerance: float | None
    initial: Initial
    broad_phase: broad.BroadPhase
    memory_budget: int | None


class DetectOptions(CollideOptions, total=False):
    """Options of `detect`."""

    nonzero_toi: bool
    normals: Normals


@overload
def detect(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    report: narrow.Report = "first",
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    capacity: None = None,
    **options: Unpack[DetectOptions],
) -> Contacts: ...
@overload
def detect(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    report: narrow.Report = "first",
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    capacity: Capacity,
    **options: Unpack[DetectOptions],
) -> PaddedContacts: ...
@overload
def detect(
    scene: Scene,
    motion: Trajectory,
    report: narrow.Report = "first",
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    **options: Unpack[DetectOptions],
) -> TrajectoryContacts: ...
def detect(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    report: narrow.Report = "first",
    min_separation: float | Tensor = 0.0,
    *,
    tolerance: float | None = None,
    nonzero_toi: bool = False,
    initial: Initial = "report",
    normals: Normals = "features",
    broad_phase: broad.BroadPhase = "auto",
    pairs: Tensor | None = None,
    memory_budget: int | None = None,
    capacity: Capacity | None = None,
) -> Contacts | PaddedContacts:
    """Finds the collisions that happen during one step, or during all steps of a trajectory.

    Nothing is missed: if the surfaces of two bodies come within min_separation at some t in [0, 1] on the paths the
    motion defines, a contact is reported, and its toi is not later than that t. A surface is the union of its closed
    triangles. Surfaces that are disjoint at t = 0 first meet where a vertex meets a face or two edges meet; surfaces
    that intersect at t = 0 are reported with toi 0 (kinds `EF_AB` and `EF_BA` where an edge passes through a face). The
    same holds within a body that deforms (`VertexMotion`) and has `self_collision` set in the scene, for features that
    share no vertex; such contacts have the pair (i, i). If a connected piece of a body is inside of a solid
    (`Mesh(solid=True)`) at t = 0, the body touches the solid, with kind `INSIDE` and toi 0. A body inside of a body
    that is no solid touches nothing: see `pgccd.enclosed`.

    If columns of the motion, margins or min_separation (then a tensor ()) require grad, so do the times, points,
    coordinates and normals of the contacts: see docs/how-to/gradients.md. Gradients do not change the bits of the
    result.

    Args:
        scene: the bodies.
        motion: their paths. All segments of a `Trajectory` are tested in one call: "first" then finds the first contact
            of each pair over all segments, "earliest" the first contact of the scene, and "all" the contacts of every
            segment. `capacity` may not be given then.
        report: "first": the earliest contact of each pair (of equal toi the smallest kind and features). "all": every
            touching feature pair. "earliest": the first contact of the scene; its toi is the largest collision-free
            fraction of the step. `pgccd.collide` finds only which pairs collide, in less time.
        min_separation: length >= 0. Margins of bodies add to it, see `Scene`.
        tolerance: a reported contact comes within min_separation + tolerance (length). Default: 1e-6 of the smaller SBV
            radius of each pair; for a point, such as a sphere, its thickness and margin count as its SBV radius.
        nonzero_toi: never report toi = 0 for a pair that starts further apart than min_separation (beyond rounding).
        initial: "report": surfaces that intersect and bodies inside of solids at t = 0 are reported. "assume_free": the
            caller guarantees that there are none, for example because the previous step ended before its first contact.
            The tests for them are skipped.
        normals: "features": `Contacts.normal` is the direction between the nearest points of the two features. Where a
            body slides over an edge between coplanar faces, that may be any direction. "surface" replaces it by the
            nearest direction that the faces around these points admit. At a flat or concave edge, that is the normal of
            a face; at a convex edge, any direction between the normals of its two faces, so nothing changes there.
            Other columns do not change. Costs time and memory proportional to the number of contacts. Not available
            with a capacity, or if an input requires grad. See docs/how-to/solver.md.
        broad_phase: how the PCS is found: "sweep", "grid", "lbvh", or "auto", which chooses by number and sizes of the
            bodies (see `stats`). The result does not depend on it.
        pairs: (P, 2) int64, i < j (or i, i for a body tested against itself), sorted and unique: test only these body
            pairs, without a broad phase; for a trajectory, in each of its segments. The scene's filters and `exclude`
            are not applied to them.
        memory_budget: bytes of scratch memory to aim at; the PCS is streamed in chunks to respect it. Default 1 GiB,
            or a quarter of what is free on a GPU if that is more. The result does not depend on it.
        capacity: of the result and of all intermediate lists. With it, sizes are fixed and the call does not
            synchronise, so it can be captured by `torch.cuda.graph` and compiled by `torch.compile(fullgraph=True)`. If
            a capacity was exceeded or a pose is invalid, the result reads as contact at the start of the step, until
            `trim` raises: see `PaddedContacts`. (For deforming bodies, call it once before capturing.)

    Returns:
        Contacts, on the scene's device; PaddedContacts if `capacity` is given, TrajectoryContacts for a trajectory. On
        a GPU the host synchronises once, to read the counts; again only if a step exceeds the capacity estimated from
        the last one.

    Raises:
        ValueError, TypeError: naming the argument; also if an input requires grad and a capacity is given. A
            UserWarning says that the scene has one body, if that body is not tested against itself.

    Example:
        >>> hits = pgccd.detect(scene, pgccd.RigidMotion(x0, q0, x1, q1), report="earliest")
        >>> safe = float(hits.toi[0]) if len(hits) else 1.0
        >>> x = x0 + safe * (x1 - x0)
    """
    if not isinstance(report, str) or report not in narrow.CONTACT_REPORTS:
        narrow.check_report(report)
    separation = separation_value(min_separation) if isinstance(min_separation, Tensor) else min_separation
    query = Query(report, separation, tolerance, nonzero_toi, initial)
    arguments.choice(normals, "normals", NORMALS)
    if normals != "features" and capacity is not None:
        raise ValueError(f'normals: contacts in a given capacity have those of the "features", got {normals!r}')
    sizes = _check(scene, motion, broad_phase, memory_budget, capacity)
    if isinstance(motion, Trajectory):
        if scene.body_count == 1:
            warn_of_only_body(scene, motion)
        options: DetectOptions = {"tolerance": tolerance, "nonzero_toi": nonzero_toi, "initial": initial}
        options |= {"normals": normals, "broad_phase": broad_phase, "memory_budget": memory_budget}
        of_step: narrow.Report = "first" if report == "earliest" else report
        find = partial(detect, report=of_step, min_separation=min_separation, **options)
        along = contacts_along(scene, motion, report, find, pairs)
        warn_of_rounded_positions(scene, motion)
        return along
    given = scene, motion
    differentiated = any_differentiated(*motion._values(), scene.margin, min_separation)
    if differentiated:
        if capacity is not None:
            raise ValueError(
                "capacity: contacts in a given capacity have no gradients, but an input requires grad: leave the "
                "capacity out, or call it under torch.no_grad()"
            )
        if normals != "features":
            raise ValueError(
                f'normals: {normals!r} have no gradients, but an input requires grad: use "features", or call it under '
                "torch.no_grad()"
            )
        scene, motion = scene._detached(), motion._detached()
    found = _search(scene, motion, query, broad_phase, pairs, memory_budget, sizes)
    if scene.body_count == 1:
        warn_of_only_body(scene, motion)
    if isinstance(found, PaddedContacts):  # a captured step cannot wait for an answer
        return found
    if motion._is_of_float32:
        warn_of_rounded_positions(scene, motion)
    assert isinstance(found, Contacts)
    if differentiated:
        add_gradients(found, *given, min_separation)
    elif normals == "surface":
        found.normal = ops.surface_normals(*operands(scene, motion, found.pairs, found))
    found._found_with = {
        "report": report,
        "min_separation": min_separation,
        "tolerance": tolerance,
        "nonzero_toi": nonzero_toi,
        "initial": initial,
        "normals": normals,
    }
    return found


@overload
def collide(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    capacity: None = None,
    **options: Unpack[CollideOptions],
) -> CollidingPairs: ...
@overload
def collide(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    capacity: Capacity,
    **options: Unpack[CollideOptions],
) -> PaddedCollidingPairs: ...
def collide(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    min_separation: float | Tensor = 0.0,
    *,
    pairs: Tensor | None = None,
    capacity: Capacity | None = None,
    tolerance: float | None = None,
    initial: Initial = "report",
    broad_phase: broad.BroadPhase = "auto",
    memory_budget: int | None = None,
) -> CollidingPairs | PaddedCollidingPairs:
    """Finds the pairs of bodies that collide during one step, or in any step of a trajectory (Alg. 2 of Du, Liu &
    Suzumura 2017), without the times and places of their contacts.

    These are the pairs that have contacts in `pgccd.detect`, with the same guarantee. The search of a pair ends when
    some pair of features certainly touches at some time; it does not look for the first time.

    Args:
        scene: the bodies.
        motion: their paths. All segments of a `Trajectory` are tested in one call; `capacity` may not be given then.
        min_separation, pairs, capacity, tolerance, initial, broad_phase, memory_budget: as for `pgccd.detect`.

    Returns:
        CollidingPairs, on the scene's device; PaddedCollidingPairs if `capacity` is given. The pairs have no gradients.
        Synchronises with a GPU as `pgccd.detect` does.

    Raises:
        ValueError, TypeError: naming the argument. A UserWarning says that the scene has one body, if that body is not
            tested against itself.

    Example:
        >>> colliding = pgccd.collide(scene, motion)
        >>> colliding.pairs, colliding.may_collide("body")
        (tensor([[0, 1]]), tensor([True, True]))
    """
    query = Query("any", separation_value(min_separation), tolerance, False, initial)
    sizes = _check(scene, motion, broad_phase, memory_budget, capacity)
    if isinstance(motion, Trajectory):
        if scene.body_count == 1:
            warn_of_only_body(scene, motion)
        options: CollideOptions = {"tolerance": tolerance, "initial": initial, "broad_phase": broad_phase}
        options |= {"memory_budget": memory_budget}
        along = pairs_along(scene, motion, partial(collide, min_separation=min_separation, **options), pairs)
        warn_of_rounded_positions(scene, motion)
        return along
    found = _search(scene._detached(), motion._detached(), query, broad_phase, pairs, memory_budget, sizes)
    if scene.body_count == 1:
        warn_of_only_body(scene, motion)
    if capacity is None:
        warn_of_rounded_positions(scene, motion)
    assert isinstance(found, (CollidingPairs, PaddedCollidingPairs))
    return found


def _check(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    broad_phase: broad.BroadPhase,
    memory_budget: int | None,
    capacity: Capacity | None,
) -> BufferSizes | None:
    """Raises TypeError or ValueError, naming the argument, if one is invalid; returns the sizes of the capacity."""
    if memory_budget is not None:
        arguments.integer(memory_budget, "memory_budget", 1, "a number of bytes > 0")
    arguments.choice(broad_phase, "broad_phase", broad.BROAD_PHASES)
    sizes = None if capacity is None else sizes_of(capacity)
    arguments.instance(scene, "scene", Scene)
    arguments.instance(motion, "motion", RigidMotion, VertexMotion, Trajectory)
    if isinstance(motion, Trajectory) and capacity is not None:
        raise ValueError("capacity: cannot be given with a Trajectory, whose segments are found in one call")
    return sizes


def _search(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    query: Query,
    broad_phase: broad.BroadPhase,
    pairs: Tensor | None,
    memory_budget: int | None,
    sizes: BufferSizes | None,
) -> Contacts | CollidingPairs | PaddedContacts | PaddedCollidingPairs:
    """One step of a user's scene and motion, without gradients; in a capacity of these sizes, if they are given."""
    on_cpu = scene.device.type == "cpu"
    memory_budget = None if memory_budget is None else int(memory_budget)
    start = time.perf_counter() if sizes is None else 0.0  # time is not available in compiled graphs
    # An operator for the whole step also checks the poses.
    is_one_operator = pairs is None and isinstance(motion, RigidMotion)
    bodies = MovingBodies.of(scene, motion, wait=on_cpu and sizes is None and not is_one_operator)
    seconds = time.perf_counter() - start if sizes is None else 0.0
    if pairs is not None:
        pairs = check_pairs(pairs, scene, bodies.deforming, ascending=True)
    if sizes is not None:
        return search_padded(bodies, query, sizes, broad_phase, pairs, marks_invalid=True).padded()
    found = detect_moving(bodies, query, broad_phase, pairs, memory_budget)
    found.stats.seconds = {"bounds": seconds} | found.stats.seconds
    found._bodies = SceneBodies.of(scene)
    return found


def detect_moving(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase = "auto",
    pairs: Tensor | None = None,
    memory_budget: int | None = None,
) -> Contacts | CollidingPairs:
    """`detect` without its checks, for bodies in motion.

    Args:
        bodies: on a CPU already validated.
        query, broad_phase, memory_budget: as for `detect`.
        pairs: (P, 2) int64, or None. Where bodies have ids in another order than rows, the first body of a pair is i.
    """
    on_cpu = bodies.device.type == "cpu"
    in_one_pass = _detect_exactly if on_cpu else _detect_in_capacity
    found = in_one_pass(bodies, query, broad_phase, pairs, memory_budget)
    if found is not None:
        return found

    def solve(chunk: Tensor, budget: int | None) -> Contacts | CollidingPairs | None:
        if not on_cpu:
            return _detect_in_capacity(bodies, query, "auto", chunk, budget)
        search = search_padded(bodies, query, EXACTLY, "auto", chunk)
        return search.contacts(search.read())

    return stream(bodies, query, broad_phase, pairs, memory_budget, solve)


def start_search(
    bodies: MovingBodies,
    query: Query,
    pairs: Tensor,
    pair_counts: Tensor | None = None,
    capacity: BufferSizes | None = None,
    estimate: CapacityEstimate | None = None,
) -> PaddedSearch:
    """Starts `detect_moving` without synchronising; `PaddedSearch.contacts` completes it.

    Args:
        bodies, query, pairs: as for `detect_moving`.
        pair_counts: (7,) int64 on the device: the first of `Counts`, if some of the pairs are padding.
        capacity: of the search. Default: `expected_capacity`; if that is None, a capacity of zero, which overflows.
        estimate: see `expected_capacity`.
    """
    if bodies.device.type != "cpu":
        ops.take_scratch_peak()  # discards the peak of earlier steps
    if capacity is None:
        capacity = expected_capacity(bodies, pairs, estimate or CapacityEstimate()) or BufferSizes(0, 0)
    return search_padded(bodies, query, capacity, "auto", pairs, pair_counts)


def expected_capacity(
    bodies: MovingBodies, pairs: Tensor | None, estimate: CapacityEstimate, **slack: float
) -> BufferSizes | None:
    """The estimated capacity; None if it needs too much memory. A graph cannot be captured without one: there, too
    little memory is an error.
    """
    if bodies.device.type == "cpu":
        return EXACTLY
    capacity = estimate.capacity(bodies.scene, pairs, **slack)
    if is_capturing():
        return capacity
    return None if capacity.bytes > memory_limit(None, capacity.bytes, bodies.device) else capacity


def _detect_exactly(
    bodies: MovingBodies, query: Query, broad_phase: broad.BroadPhase, pairs: Tensor | None, memory_budget: int | None
) -> Contacts | CollidingPairs | None:
    """Runs all stages by one operator, on a CPU; None for deforming bodies, given or excluded pairs, or if the pairs
    exceed the memory budget.
    """
    if pairs is not None or bodies.deforming or bodies.scene.exclude is not None:
        return None
    search = search_rigid(bodies, query, EXACTLY, broad_phase, [pairs_a_chunk(bodies.scene, None, memory_budget), 0, 0])
    counts = search.read()
    return None if counts.pairs_overflow else search.contacts(counts)


def _detect_in_capacity(
    bodies: MovingBodies, query: Query, broad_phase: broad.BroadPhase, pairs: Tensor | None, memory_budget: int | None
) -> Contacts | CollidingPairs | None:
    """Runs all stages in the estimated capacity, and again in larger ones on overflow; None if that needs too much
    memory.
    """
    estimate, attempts = estimate_of(bodies.scene, query, pairs), 0
    ops.take_scratch_peak()  # discards the peak of earlier steps

    def attempt(capacity: BufferSizes) -> Contacts | CollidingPairs | TooSmall[BufferSizes] | None:
        nonlocal attempts
        attempts += 1
        if attempts > _ATTEMPTS or capacity.bytes > memory_limit(memory_budget, capacity.bytes, bodies.device):
            return None
        search = search_padded(bodies, query, capacity, broad_phase, pairs)
        counts = search.read()
        needed = counts.needed(capacity)
        estimate.learn(bodies.scene.body_count if pairs is None else len(pairs), needed)
        if counts.overflow:
            return TooSmall(capacity.grown(needed))
        contacts = search.contacts(counts)
        contacts.stats.waits = attempts
        contacts.stats.scratch_bytes = ops.take_scratch_peak()
        return contacts

    return until_it_fits(attempt, estimate.capacity(bodies.scene, pairs))
