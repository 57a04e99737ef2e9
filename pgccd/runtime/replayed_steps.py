"""Consecutive steps as replays of a graph, run eagerly (without a graph) where the graph does not suffice."""

import warnings
from abc import ABC, abstractmethod
from collections import deque
from typing import Any, Generic, TypeVar

from torch import Tensor

from pgccd.runtime.memory import cached_bytes, has_room, is_out_of_memory, release_cache
from pgccd.runtime.transaction import C, Replay, TransactionGraph

# A graph is captured only if at least this many steps follow.
_FEWEST_REPLAYS = 4

#: Capacity of a graph relative to what the last step needed: capturing a larger graph takes as long as several steps.
GRAPH_SLACK = 1.5

#: A step run eagerly.
M = TypeVar("M")
G = TypeVar("G", bound=TransactionGraph[Any])


class ReplayedSteps(ABC, Generic[M, C, G]):
    """Runs consecutive steps. The first one runs eagerly, and a graph is captured with the capacities that it
    needed; later steps are replays of this graph, at most two of them enqueued at a time. A step that the graph could
    not commit is repeated eagerly, and a larger graph is captured. All ranks make the same decisions, since
    these depend only on gathered values.

    Args:
        wants_graph: whether steps are replayed.
    """

    def __init__(self, wants_graph: bool) -> None:
        self._wants_graph = wants_graph
        self._graph: G | None = None
        self._under_way: deque[Replay[C]] = deque()
        # Whether the next step must run eagerly.
        self._must_run_eagerly = False

    @abstractmethod
    def _run_eagerly(self, index: int) -> M:
        """Runs a step eagerly, from the current state."""

    @abstractmethod
    def _make_graph(self, index: int) -> G:
        """The graph of the next step, to be captured, with capacities somewhat larger than the last step needed."""

    @property
    @abstractmethod
    def _columns(self) -> dict[str, Tensor]:
        """The current state (N, ...), by name; of the same number of rows while steps are replayed."""

    @_columns.setter
    @abstractmethod
    def _columns(self, columns: dict[str, Tensor]) -> None: ...

    def _begin(self, graph: G, index: int) -> None:
        """Loads the state into a graph just captured. Sends no messages: other ranks may have failed to capture it."""
        graph.load(self._columns, index)

    def _fits(self, graph: G) -> bool:
        """Whether the state fits into the graph."""
        return all(len(column) <= graph.rows for column in self._columns.values())

    def _load(self, graph: G, index: int) -> bool:
        """Loads the state into the graph. False: it does not fit."""
        fits = self._fits(graph)
        if fits:
            graph.load(self._columns, index)
        return fits

    def _take(self, graph: G) -> None:
        """Copies the graph's state to the current state."""
        count = len(next(iter(self._columns.values())))
        self._columns = {name: column[:count].clone() for name, column in graph.columns.items()}

    def _read(self, replay: Replay[C], index: int) -> C | None:
        """Waits for a step; None if it was not committed."""
        return replay.read(index)

    def _note(self, step: M | C) -> None:
        """Records what a step needed."""
        return  # overridden by subclasses

    def _is_oversized(self, graph: G) -> bool:
        """Whether the graph is larger than recent steps needed."""
        return False

    def _needs_eager_step(self, step: C, enqueued: int) -> bool:
        """Whether a later step must run eagerly: the first after `step` and the next `enqueued` ones, which
        have been enqueued already.
        """
        return False

    def _is_captured(self, captured: bool) -> bool:
        """Whether all ranks captured a graph, given whether this one did."""
        return captured

    def _are_others_waiting(self, graph: G | None) -> bool:
        """Whether other ranks wait for messages that this one did not send, after it failed to capture this graph."""
        return False

    @property
    def is_ahead(self) -> bool:
        """Whether the next step has already been enqueued."""
        return bool(self._under_way)

    def _advance(self, index: int, more: int) -> M | C:
        """Runs a step.

        Args:
            index: one more than in the previous step.
            more: number of steps that follow before the state or the details of a step are read. The last of these is
                not replayed.
        """
        if not self._under_way:
            renew = self._graph is None or self._is_oversized(self._graph)
            if renew or not more or self._must_run_eagerly:
                return self._run_eagerly_and_load(index, more, renew and more > 0)
            assert self._graph is not None
            self._under_way.append(self._graph.replay())
        assert self._graph is not None
        if more > 1 and len(self._under_way) < 2 and not (self._must_run_eagerly or self._is_oversized(self._graph)):
            self._under_way.append(self._graph.replay())
        committed = self._read(self._under_way.popleft(), index)
        if committed is None:
            self._under_way.clear()  # they changed nothing
            return self._run_eagerly_and_load(index, more, renew=True)
        self._note(committed)
        self._must_run_eagerly = self._needs_eager_step(committed, len(self._under_way))
        return committed

    def _run_eagerly_and_load(self, index: int, more: int, renew: bool) -> M:
        """Runs a step eagerly, and loads the graph with the result; or captures a new one, if enough steps
        follow.
        """
        if self._graph is not None:
            self._take(self._graph)
            if renew:
                self._graph = None
                release_cache()  # the step may need the memory
        made = self._run_eagerly(index)
        self._note(made)
        self._must_run_eagerly = False
        if self._graph is not None and not self._load(self._graph, index + 1):
            self._graph = None
        if self._graph is None and self._wants_graph and more >= _FEWEST_REPLAYS:
            self._graph = self._try_to_capture(index + 1)
        return made

    def _try_to_capture(self, index: int) -> G | None:
        needed = cached_bytes()  # by a step run eagerly: later ones run beside the graph
        release_cache()
        graph, captured, why = None, False, "another rank could not capture it"
        try:
            graph = self._make_graph(index)
            graph.capture()
            captured = has_room(needed)
            if captured:
                self._begin(graph, index)
            else:
                why = "too little memory"
        except RuntimeError as error:
            if self._are_others_waiting(graph):
                raise
            why = "too little memory" if is_out_of_memory(error) else str(error)
        if self._is_captured(captured):
            return graph
        warnings.warn(f"steps run without a CUDA graph: {why}", stacklevel=2)
        self._wants_graph = False
        return None
