"""`resolve`: how far each body of a scene may move such that none meets another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict, Unpack, cast, overload

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.contacts import Contacts
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import bool_column
from pgccd.motion.of_scene import check_trajectory
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.resolution.listed import ListedSearch, are_near, is_on_arcs, is_short, travels_of
from pgccd.resolution.results import M, PaddedResolution, Resolution, union_of_pairs
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Attempt, OneRank, RoundSearch, resolve_collisions
from pgccd.resolution.search import ShortenedSearch, at_rest, held_bodies, shortened, warn_of_held
from pgccd.resolution.stopped_by import StoppedBy
from pgccd.resolution.trajectories import TrajectoryResolution, resolve_segments
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes, Capacity, overflow_flags, sizes_of
from pgccd.runtime.stages import StageClock
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import Initial, warn_of_only_body, warn_of_rounded_positions
from pgccd.search.detect import detect_moving
from pgccd.search.memory import CapacityEstimate
from pgccd.search.padded import search_padded
from pgccd.search.passes import SearchPass, find_pass, pairs_of_rounds
from pgccd.search.query import Query

# All rounds are enqueued. From the fifth on, each round stops a body for good.
_MOST_ROUNDS = 1000


class ResolveOptions(TypedDict, total=False):
    """Options of `resolve`."""

    tolerance: float | None
    initial: Initial
    broad_phase: broad.BroadPhase


@overload
def resolve(
    scene: Scene,
    motion: M,
    movable: Tensor | Sequence[bool] | None = None,
    min_separation: float = 0.0,
    *,
    capacity: None = None,
    **options: Unpack[ResolveOptions],
) -> Resolution[M]: ...
@overload
def resolve(
    scene: Scene,
    motion: Trajectory,
    movable: Tensor | Sequence[bool] | None = None,
    min_separation: float = 0.0,
    *,
    capacity: None = None,
    **options: Unpack[ResolveOptions],
) -> TrajectoryResolution: ...
@overload
def resolve(
    scene: Scene,
    motion: M,
    movable: Tensor | Sequence[bool] | None = None,
    min_separation: float = 0.0,
    *,
    capacity: Capacity,
    rounds: int = 8,
    **options: Unpack[ResolveOptions],
) -> PaddedResolution[M]: ...
def resolve(
    scene: Scene,
    motion: M | Trajectory,
    movable: Tensor | Sequence[bool] | None = None,
    min_separation: float = 0.0,
    *,
    tolerance: float | None = None,
    initial: Initial = "report",
    broad_phase: broad.BroadPhase = "auto",
    capacity: Capacity | None = None,
    rounds: int | None = None,
) -> Resolution[M] | PaddedResolution[M] | TrajectoryResolution:
    """Finds the fraction f_i of its path that each body can move such that no two bodies touch, and the step that a
    loop may commit: body i on x_i(f_i t) for t in [0, 1].

    A body stops at 0.99 of its first toi. Others may then meet it where it stopped, so the step is tested again in
    rounds, until no body changes. A body that could move by less than 0.01 of its path does not move, nor does a body
    that still collides in the fourth round or later. The largest fractions are not unique, because either of two bodies
    may give way. The result is the same in every run, on every device, and bodies of one world do not depend on other
    worlds.

    Bodies that touch or intersect another at t = 0 do not move, and the pairs are listed. A body that may not be
    stopped keeps its whole path. If it meets another body even though that body was stopped, the pair is listed as
    unresolved. A body that deforms stops before it meets itself, if it has `self_collision` in the scene.

    Args:
        scene: the bodies; its filters and margins apply.
        motion: their paths over one step; or a `Trajectory`, whose segments are resolved one after the other: a body
            that is stopped in a segment stays there. With `RigidMotion(path="linear")`, vertices of a stopped body move
            straight to its pose at f_i on the arc, see `RigidMotion.shortened`.
        movable: (N,) bool: the bodies that may be stopped. Default: all.
        min_separation: length >= 0; bodies at most this far apart touch, as for `detect`.
        tolerance, broad_phase: as for `detect`. Bodies that start further apart than min_separation may move, even if
            they are within the tolerance.
        initial: "report": surfaces that intersect and bodies inside of solids at t = 0 count as touching.
            "assume_free": the caller guarantees that there are none, for example because the previous step was
            resolved. The tests for them are skipped.
        capacity: of each search and of the lists of pairs. With it, sizes are fixed, the call does not synchronise, and
            it can be captured by `torch.cuda.graph` (for deforming bodies, call it once before).
        rounds: with `capacity`, the number of rounds. Default: 8. Superfluous rounds change nothing. If the last round
            changes a body, the result is incomplete.

    Returns:
        Resolution, on the scene's device; TrajectoryResolution for a trajectory; PaddedResolution if `capacity` is
        given, which reads as fraction 0 for every body if it is incomplete. On a GPU the host synchronises twice (once
        if no body is stopped); once more in the first call for a scene, or if a step exceeds the capacities or the
        number of rounds of earlier steps.

    Raises:
        TypeError, ValueError: naming the argument; also if an input requires grad. A UserWarning says that the scene
            has one body, if that body is not tested against itself. Without `capacity`, another one names a deforming
            body that moves and gets fraction 0.

    Example:
        >>> resolved = pgccd.resolve(scene, motion)
        >>> position, orientation = resolved.motion.at(1.0)  # where the bodies are after the step
        >>> velocity = torch.where(resolved.fraction[:, None] < 1.0, -velocity, velocity)
    """
    query = Query("first", min_separation, tolerance, True, initial)
    arguments.choice(broad_phase, "broad_phase", broad.BROAD_PHASES)
    sizes = None if capacity is None else sizes_of(capacity)
    if sizes is None and rounds is not None:
        raise ValueError("rounds: can only be given with a capacity; without one there are as many as needed")
    count = arguments.integer(8 if rounds is None else rounds, "rounds", 1, "a number of rounds >= 1")
    if count > _MOST_ROUNDS:
        raise ValueError(f"rounds: expected at most {_MOST_ROUNDS}, got {count}")
    if isinstance(motion, Trajectory) and isinstance(scene, Scene):
        if sizes is not None:
            raise TypeError("motion: with a capacity, expected one step, got a Trajectory")
        check_trajectory(scene, motion)
        motion._refuse_gradient()
        warn_of_rounded_positions(scene, motion)
        options: ResolveOptions = {"tolerance": tolerance, "initial": initial, "broad_phase": broad_phase}
        return resolve_segments(
            scene, motion, lambda thick, step: resolve(thick, step, movable, min_separation, **options)
        )
    bodies = MovingBodies.of(
        scene, motion, wait=sizes is None and isinstance(scene, Scene) and scene.device.type == "cpu"
    )
    if scene.body_count == 1:
        warn_of_only_body(scene, motion)
    if sizes is None:
        warn_of_rounded_positions(scene, motion)
    fixed = None
    if movable is not None:
        fixed = bool_column(movable, "movable", scene.body_count, scene.device) == 0
    step = _Step(bodies, query, broad_phase, fixed)
    return step.resolve(motion) if sizes is None else step.resolve_padded(motion, sizes, count)


@dataclass
class _Plan:
    """What earlier calls for a scene needed on a GPU. It changes how often work is repeated, never the result."""

    pairs: CapacityEstimate
    listed_pairs: CapacityEstimate  #: of a search that lists pairs for rounds too
    rounds: RoundPlan
    #: Whether rounds search a list, which was not too long in the last step. None: there was none.
    lists: bool | None = None

    @classmethod
    def of(cls, scene: Scene) -> _Plan:
        """The plan of a scene."""
        plans = scene._capacity_estimates
        if "resolve" not in plans:
            guess = sizes_of(Capacity.of(scene.body_count, None, scene._self_colliding_vertices))
            plans["resolve"] = cls(CapacityEstimate(), CapacityEstimate(), RoundPlan.of(guess))
        return plans["resolve"]


@dataclass
class _Step:
    """The arguments of `resolve`, checked."""

    bodies: MovingBodies
    query: Query
    broad_phase: broad.BroadPhase
    fixed: Tensor | None  #: (N,) bool: bodies that may not be stopped

    def resolve(self, motion: M) -> Resolution[M]:
        bodies, scene = self.bodies, self.bodies.scene
        plan = _Plan.of(scene)
        first_invalid_rows = bodies._first_invalid_rows()
        invalid_rows = HostCopy.start(first_invalid_rows)
        search = self._search(motion, plan)
        search_pass, stopped_by = search.passes[0], StoppedBy(scene.body_count, scene.device)
        clock = StageClock()
        resolved = resolve_collisions(
            search, scene.body_count, plan.rounds, _nothing, clock, fixed=self.fixed, stopped_by=stopped_by
        )
        bodies._raise_invalid(invalid_rows.numpy().tolist())
        resolved.learn()
        if isinstance(search, ListedSearch) and bodies.device.type != "cpu":
            plan.lists = is_short(*resolved.counts.listed)
        fraction, contacts = resolved.resolution.fraction, search_pass.find()
        assert isinstance(contacts, Contacts)
        touching = contacts.pairs[contacts.toi == 0.0]
        made = cast(M, shortened(scene, motion, fraction))
        meeting = contacts.pairs
        is_any_stopped = (fraction < 1.0).any()
        if isinstance(motion, VertexMotion):
            held = held_bodies(scene, motion, fraction)
            is_stopped, is_held = torch.stack([is_any_stopped, held.any()]).tolist()
            if is_held:
                warn_of_held(int(held.int().argmax()), stacklevel=4)
        else:
            is_stopped = bool(is_any_stopped)
        if is_stopped:
            meeting = detect_moving(MovingBodies.of(scene, made), self._any, self.broad_phase).pairs
        rest = _are_both(at_rest(scene, made), meeting)
        touching = union_of_pairs(touching, meeting[rest], scene.body_count)
        touching, unresolved = touching[touching[:, 0] >= 0], meeting[~rest]
        return Resolution(made, fraction, stopped_by.id, touching, unresolved, resolved.resolution.rounds)

    def resolve_padded(self, motion: M, capacity: BufferSizes, rounds: int) -> PaddedResolution[M]:
        bodies, scene, query = self.bodies, self.bodies.scene, self.query
        invalid_rows = bodies._first_invalid_rows()
        chosen = broad.choose(bodies, self.broad_phase)
        pairs, counts = broad.find_pairs_padded(
            bodies, query.min_separation, chosen, capacity, invalid_rows[-1:], query.tolerance
        )
        search_pass = SearchPass(query, bodies, pairs, counts, capacity=capacity)
        search_pass.start()
        stopped_by = StoppedBy(scene.body_count, scene.device)
        search = self._shortened_search(motion, [search_pass], may_wait=False)
        plan = RoundPlan.of(capacity)
        attempt = Attempt(search, scene.body_count, plan, OneRank(), StageClock(), self.fixed, stopped_by)
        first_change = attempt.begin()
        more_changes, of_rounds = attempt.make_rounds(rounds)
        changes = torch.cat([first_change, more_changes])
        moving = MovingBodies.of(scene, shortened(scene, motion, attempt.fraction), wait=False)
        check = search_padded(moving, self._any, capacity, chosen, None)
        of_searches = torch.stack([search_pass.counts(), *of_rounds, check.counts[: len(COUNT_ROWS)]])
        failures = [*overflow_flags(of_searches.sum(dim=0)), invalid_rows[-1:], check.counts[-1:], changes[-1:]]
        incomplete = (torch.cat(failures) != 0).any().reshape(1)
        fraction = attempt.fraction.masked_fill(incomplete, 0.0)
        found, toi = search_pass.first_contacts()
        made, meeting = cast(M, shortened(scene, motion, fraction)), check.rows[0]
        rest = _are_both(at_rest(scene, made), meeting)
        touching = union_of_pairs(
            found.masked_fill((toi != 0.0)[:, None], -1), meeting.masked_fill(~rest[:, None], -1), scene.body_count
        )
        return PaddedResolution(
            motion=made,
            fraction=fraction,
            stopped_by=stopped_by.id.masked_fill(incomplete, -1),
            touching_at_start=touching.masked_fill(incomplete, -1),
            unresolved=meeting.masked_fill(rest[:, None] | incomplete, -1),
            rounds=(changes != 0).long().cumprod(0).sum().reshape(1),
            incomplete=incomplete,
            _counts=of_searches,
            _first_invalid_rows=invalid_rows,
            _changes=changes[-1:],
            _capacity=capacity,
            _validation=bodies._validation.weakly(),
        )

    def _search(self, motion: RigidMotion | VertexMotion, plan: _Plan) -> RoundSearch:
        if is_on_arcs(motion) and plan.lists is not False and (plan.lists or are_near(travels_of(self.bodies))):
            return self._listed_search(motion, plan)
        search_pass = find_pass(self.bodies, self.query, self.broad_phase, estimate=plan.pairs)
        return self._shortened_search(motion, [search_pass], may_wait=True)

    def _shortened_search(
        self, motion: RigidMotion | VertexMotion, passes: list[SearchPass], may_wait: bool
    ) -> ShortenedSearch:
        bodies = self.bodies
        invalid = bodies._first_invalid_rows()[-1:]
        return ShortenedSearch(passes, bodies.scene, motion, self.query, self.broad_phase, invalid, may_wait)

    def _listed_search(self, motion: RigidMotion, plan: _Plan) -> ListedSearch:
        """On a GPU the list is found with the pairs of the whole step; on a CPU in the first round, if there is one."""
        bodies, query, on_cpu = self.bodies.stoppable(), self.query, self.bodies.device.type == "cpu"
        search_pass = find_pass(
            self.bodies if on_cpu else bodies,
            query,
            self.broad_phase,
            estimate=plan.listed_pairs,
            at_any_times=not on_cpu,
        )

        def list_pairs() -> Tensor | None:
            if not on_cpu:
                return pairs_of_rounds([search_pass])
            chosen, given = broad.choose(bodies, self.broad_phase), (query.min_separation, query.tolerance)
            pairs = broad.find_pairs_of_checked(bodies, given[0], chosen, given[1], at_any_times=True)
            plan.lists = is_short(len(pairs), len(search_pass.pairs))
            return pairs if plan.lists else None

        meshes = bodies.scene.meshes
        shortened_search = self._shortened_search(motion, [search_pass], may_wait=True)
        return ListedSearch([search_pass], meshes, bodies.tensors, None, list_pairs, query, otherwise=shortened_search)

    @property
    def _any(self) -> Query:
        """Options of the test of the shortened motion."""
        return replace(self.query, report="any")


def _are_both(bodies: Tensor, pairs: Tensor) -> Tensor:
    """(P,) bool: pairs (P, 2) of two bodies marked by (N,) bool; True also for rows of -1."""
    return torch.cat([bodies, bodies.new_ones(1)])[pairs].all(dim=1)


def _nothing(fraction: Tensor) -> Tensor:
    return torch.empty(0, dtype=torch.int64, device=fraction.device)
