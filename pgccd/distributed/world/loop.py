"""Steps of a `World` as replays of one CUDA graph per rank, with motion and response as functions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns, first_row
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import collective
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.launch.agreement import agree_on_step, require_agreement
from pgccd.distributed.launch.code import code_of
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.steps.rank import can_replay
from pgccd.distributed.steps.replayed import RankSteps
from pgccd.distributed.world.functions import (
    Bodies,
    Motion,
    Movable,
    Response,
    Tally,
    bodies_of,
    fixed_of,
    motion_of,
    tallied,
    with_position,
)
from pgccd.distributed.world.input_checks import motion_facts
from pgccd.distributed.world.world import World
from pgccd.distributed.world.world_graphs import Committed, ResolvingGraph, WorldGraph, WorldStep
from pgccd.motion.paths import RigidMotion
from pgccd.resolution.round_plan import RecentRounds
from pgccd.runtime.sizes import COUNT_ROWS


class CapturedWorld(RankSteps[WorldStep, Committed, "WorldGraph"]):
    """A loop of steps of a `World`: motion, detection, response.

    On GPUs (over NCCL, if there are several) a step is a replay of one CUDA graph per rank, with messages and both
    functions, and the host waits only for the record of the previous step. A step that exceeds a capacity changes
    nothing and is repeated eagerly. The last step of `run`, and steps in which bodies migrate, run eagerly too.
    Otherwise all steps run eagerly. The results are equal, bit by bit. In a step that will be repeated, or for which an
    error will be raised, contacts may be missing on any rank: `response` then gets a first toi of 0 for every body of
    every rank.

    Args:
        world: with report="first".
        motion: called with the rank's `Bodies`. On a GPU it may only enqueue work, see `torch.cuda.graph`. It may
            return (motion, payload), with new values (N, ...) by name: `response` and `tally` find them in the bodies.
            They are committed with the step, unless the response returns other values for the same name.
        response: called with the `Bodies`, the motion, and the first toi of each (N,) float64; returns new values by
            name: "position" (N, 3) and any payload. It may only enqueue work, too. All ranks call it in each step, so
            it may reduce values over the ranks.
        graph: whether steps are replayed, the same on all ranks. Default: if possible.
        resolve: resolves each step, see `World.step`. `response` then gets the shortened motion and, instead of the
            first toi, the fraction (N,) float64 of its path that each body moves; 1 where nothing stopped it. The
            shortened motion is not tested again, because the lists of that test would not be read. Steps run eagerly if
            the world's path is "linear", and after a step in which four times as many pairs may meet at any two times
            as at equal times.
        movable: with `resolve`, called with the `Bodies`; returns (N,) bool, the bodies that may be stopped. Default:
            all.
        tally: called after `response` with the `Bodies` after the step, the motion and the answer that the response was
            passed, and the contacts of the whole step that this rank found: pairs (K, 2) int64 of ids, -1 for padding,
            and toi (K,). Returns numbers (k,) int64, with the same k in each step; `WorldStep.tally` has their sums
            over the ranks. In a graph it may only enqueue work; rows with negative ids are padding.

    Attributes:
        comm: between the ranks.

    Raises:
        TypeError, ValueError: naming the argument; `graph` is True with `resolve` and path="linear".

    Example:
        >>> def motion(bodies):
        ...     return pgccd.RigidMotion.from_velocity(
        ...         bodies.position, bodies.payload["q"], bodies.payload["v"], bodies.payload["w"], dt=0.1
        ...     )
        >>> def response(bodies, motion, first_toi):  # all bodies stop short of the first contact of the scene
        ...     fraction = comm.min(torch.cat([0.9 * first_toi, first_toi.new_ones(1)]).amin()[None])
        ...     position, orientation = motion.at(fraction)
        ...     sign = torch.where(first_toi < 2.0 * fraction, -1.0, 1.0)[:, None]
        ...     at = bodies.payload
        ...     return {"position": position, "q": orientation, "v": sign * at["v"], "w": sign * at["w"]}
        >>> steps = pgccd.distributed.CapturedWorld(world, motion, response).run(100)
    """

    def __init__(
        self,
        world: World,
        motion: Motion,
        response: Response,
        graph: bool | None = None,
        *,
        resolve: bool = False,
        movable: Movable | None = None,
        tally: Tally | None = None,
    ) -> None:
        if not isinstance(world, World):
            raise TypeError(f"world: expected a pgccd.distributed.World, got {arguments.describe(world)}")
        if world.options.report != "first":
            raise ValueError(f'world: expected one with report="first", got {world.options.report!r}')
        for name, function in (("motion", motion), ("response", response)):
            if not callable(function):
                raise TypeError(f"{name}: expected a function, got {arguments.describe(function)}")
        if world.vertex_payload:
            raise ValueError("world: expected one without vertex_payload, since its motion is rigid")
        if not arguments.flag(resolve, "resolve") and movable is not None:
            raise ValueError("movable: can only be given with resolve=True")
        for name, choice in (("movable", movable), ("tally", tally)):
            if choice is not None and not callable(choice):
                raise TypeError(f"{name}: expected a function, got {arguments.describe(choice)}")
        may_replay = not resolve or world.options.path == "rigid"
        if graph and not may_replay:
            raise ValueError("graph: resolved steps on linear paths cannot be replayed; leave it out")
        graph = may_replay and can_replay(world.comm, world.id.device) if graph is None else graph
        super().__init__(world._rank, graph)
        self.comm = world.comm
        self._world, self._motion, self._response = world, motion, response
        self._resolve, self._movable, self._tally = resolve, movable, tally
        self._tally_width = 0  # of the last step
        self._recent = RecentRounds()

    @collective
    def run(self, steps: int) -> list[WorldStep]:
        """Runs steps. Afterwards `world` is in the final state, and each body is on its owner.

        Args:
            steps: their number, the same on all ranks.

        Raises:
            TypeError, ValueError: as `World.step` and `World.move` raise for the results of the functions; or ranks
                have different `steps`, `graph`, or code of a function.
        """
        steps = arguments.integer(steps, "steps", 0, "a number of steps >= 0")
        world, found = self._world, []
        functions = {"motion": code_of(self._motion), "response": code_of(self._response)}
        for name, function in (("movable", self._movable), ("tally", self._tally)):
            if function is not None:
                functions[name] = code_of(function)
        choices = {"steps": steps, "graph": self._wants_graph, "resolve": self._resolve}
        require_agreement(world.comm, choices | functions)
        if self._graph is not None and not self._load(self._graph, world.steps_made):
            self._graph = None
        for more in reversed(range(steps)):
            made = self._advance(world.steps_made, more)
            if isinstance(made, Committed):
                world.steps_made, made = world.steps_made + 1, made.found
            found.append(made)
        return found

    @property
    def is_graph(self) -> bool:
        """Whether there is a graph of the next step."""
        return self._graph is not None

    def _run_eagerly(self, index: int) -> WorldStep:
        world = self._world
        bodies = bodies_of(world.columns, torch.full((1,), index, device=world.id.device))
        motion, bodies, planned = motion_of(self._motion, bodies)
        rounds = 0
        if self._resolve:
            motion, answer, rounds = self._resolve_eagerly(bodies, motion)
        else:
            answer = world.first_toi(world.step(motion))
        assert world.found is not None
        new = planned | with_position(self._response(bodies, motion, answer))
        counts = torch.tensor([len(world.found.pairs), len(world.found.contacts)])
        if self._tally is not None:
            contacts = world.found.contacts
            assert isinstance(contacts, Contacts)
            pairs = world.found.held.id[contacts.pairs]
            values = tallied(self._tally, bodies, new, motion, answer, pairs, contacts.toi)
            self._tally_width, counts = len(values), torch.cat([counts, values.cpu()])
        pcs, count, *tally = world.comm.sum(counts).tolist()
        world.move(**new)
        return WorldStep(pcs, count, False, rounds, tuple(tally))

    def _resolve_eagerly(self, bodies: Bodies, motion: RigidMotion) -> tuple[RigidMotion, Tensor, int]:
        """The shortened motion, the fraction (N,) that each body moves, and the number of rounds."""
        world, fixed = self._world, None

        def settings() -> dict[str, Any]:
            nonlocal fixed
            fixed = fixed_of(self._movable, bodies)
            return motion_facts(motion, world.options.path, world.meshes, world.mesh_index)

        agree_on_step(world.comm, settings)
        found = world._fractions(motion, fixed, self._wants_graph)
        return motion.shortened(found.fraction), found.fraction, found.rounds

    def _fits(self, graph: WorldGraph) -> bool:
        # Added bodies may have brought new columns, which all ranks then have.
        has_same_columns = graph.columns.keys() == self._columns.keys()
        return has_same_columns and graph.options is self._world._search_options and super()._fits(graph)

    def _try_to_capture(self, index: int) -> WorldGraph | None:
        world = self._world
        if self._resolve:
            assert world.found is not None
            if not (world._resolution_plan.lists and world.found.options.at_any_times):
                return None
        # Without bodies there are no columns for padding.
        return super()._try_to_capture(index) if world.id_checksum.count else None

    def _graph_of(self, index: int, decomposition: Decomposition, sizes: HaloSizes, rows: int) -> WorldGraph:
        world = self._world
        padding = _any_body(world.comm, world.columns)
        padding["id"].fill_(-1)
        given = world, self._motion, self._response, self._tally, decomposition, sizes, index, padding, rows
        if not self._resolve:
            return WorldGraph(*given)
        return ResolvingGraph(*given, self._movable, self._recent)

    def _largest_message(self, sizes: HaloSizes) -> int:
        changes, common = (1 + self._recent.to_capture, sizes.common) if self._resolve else (0, [])
        record = 4 + changes + self._tally_width + 2 * len(COUNT_ROWS)
        return 1 + max(record, *sizes.sent, *sizes.received, *common)

    def _note(self, step: WorldStep | Committed) -> None:
        self._recent.note((step.found if isinstance(step, Committed) else step).rounds)

    def _is_oversized(self, graph: WorldGraph) -> bool:
        return self._resolve and self._recent.need_fewer_than(graph.rounds)

    @property
    def _columns(self) -> Columns:
        return self._world.columns

    @_columns.setter
    def _columns(self, columns: Columns) -> None:
        self._world.columns = columns


def _any_body(comm: Comm, columns: Columns) -> Columns:
    """One row of each column: a body of the first rank that has one."""
    some = {name: column[:1] for name, column in columns.items()}
    return first_row(comm, torch.full_like(some["id"], comm.rank)[:, None], some)
