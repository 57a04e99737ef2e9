"""Steps that follow one another as replays of a graph, made launch by launch where the graph does not suffice."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections import deque
from typing import Any, Generic, TypeVar

import torch

from pgccd.runtime.memory import is_out_of_memory
from pgccd.runtime.transaction import C, Replay, TransactionGraph

# A graph is worth capturing if so many steps follow.
_FEWEST_REPLAYS = 4

#: Capacity of a graph over what the last step needed: a larger graph takes as long to capture as several steps.
GRAPH_SLACK = 2.0

#: A step made launch by launch.
M = TypeVar("M")
G = TypeVar("G", bound=TransactionGraph[Any])


class ReplayedSteps(ABC, Generic[M, C, G]):
    """Makes steps that follow one another. The first is made launch by launch, and a graph of what it needed captured;
    the next ones are replays of that, of which two at most are enqueued at a time. A step that the graph could not make
    is made launch by launch, and a larger graph captured. On many ranks all come to the same decisions, since these
    follow from what all have been told.

    Args:
        wants_graph: whether steps are replayed.
    """

    def __init__(self, wants_graph: bool) -> None:
        self._wants_graph = wants_graph
        self._graph: G | None = None
        self._under_way: deque[Replay[C]] = deque()
        # Whether the next step is one that a graph is not made for.
        self._must_launch = False

    @abstractmethod
    def _launch(self, index: int) -> M:
        """Makes a step launch by launch, and goes on from the state it ends in."""

    @abstractmethod
    def _capture(self, index: int) -> G:
        """A graph of the next step, in the capacities that the last one needed and somewhat more."""

    @abstractmethod
    def _load(self, graph: G, index: int) -> bool:
        """Lets the graph go on from the state. False: it does not fit."""

    @abstractmethod
    def _take(self, graph: G) -> None:
        """Goes on from the graph's state."""

    def _read(self, replay: Replay[C], index: int) -> C | None:
        """Waits for a step; None: it was not committed."""
        return replay.read(index)

    def _note(self, step: M | C) -> None:
        """Takes note of what a step needed."""
        return  # nothing, unless a subclass does

    def _is_oversized(self, graph: G) -> bool:
        """Whether the graph does more than any recent step needed."""
        return False

    def _needs_launch(self, step: C) -> bool:
        """Whether the step after this one must be made launch by launch."""
        return False

    def _is_captured(self, captured: bool) -> bool:
        """Whether all ranks could capture a graph, given whether this one could."""
        return captured

    @property
    def is_ahead(self) -> bool:
        """Whether a GPU has been given the next step already."""
        return bool(self._under_way)

    def _advance(self, index: int, more: int) -> M | C:
        """Makes a step.

        Args:
            index: one more than that of the step before.
            more: how many follow before the state is asked for, or the whole outcome of a step. The last of them is not
                replayed.
        """
        if not self._under_way:
            renew = self._graph is None or self._is_oversized(self._graph)
            if renew or not more or self._must_launch:
                return self._launch_and_load(index, more, renew and more > 0)
            assert self._graph is not None
            self._under_way.append(self._graph.replay())
        assert self._graph is not None
        if more > 1 and len(self._under_way) < 2 and not (self._must_launch or self._is_oversized(self._graph)):
            self._under_way.append(self._graph.replay())
        committed = self._read(self._under_way.popleft(), index)
        if committed is None:
            self._under_way.clear()  # they have changed nothing
            return self._launch_and_load(index, more, renew=True)
        self._note(committed)
        self._must_launch = self._needs_launch(committed)
        return committed

    def _launch_and_load(self, index: int, more: int, renew: bool) -> M:
        """A step launch by launch. After it the graph goes on; or there is a new one, if enough steps follow."""
        if self._graph is not None:
            self._take(self._graph)
        made = self._launch(index)
        self._note(made)
        self._must_launch = False
        if self._graph is not None and (renew or not self._load(self._graph, index + 1)):
            self._graph = None
        if self._graph is None and self._wants_graph and more >= _FEWEST_REPLAYS:
            self._graph = self._try_to_capture(index + 1)
        return made

    def _try_to_capture(self, index: int) -> G | None:
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()  # a graph has memory of its own
        graph, why = None, "another rank could not capture it"
        try:
            graph = self._capture(index)
        except RuntimeError as error:
            why = "too little memory" if is_out_of_memory(error) else str(error)
        if self._is_captured(graph is not None):
            return graph
        warnings.warn(f"steps are launched kernel by kernel: no CUDA graph of them: {why}", stacklevel=2)
        self._wants_graph = False
        return None
