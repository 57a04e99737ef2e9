"""A step of a loop as a CUDA graph, so that the GPU does not wait for the host.

A step is a transaction: it reads a state in fixed memory and commits the next one on the device. If it cannot be
committed, it and the steps enqueued after it change nothing, until the host has read its record.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd.runtime.events import record_event
from pgccd.runtime.graph import capture

#: A committed step, from its record.
C = TypeVar("C")


class TransactionGraph(ABC, Generic[C]):
    """One step as a CUDA graph, from a state in fixed memory to the next one. Call `capture` before `replay`.

    Args:
        columns: the state (N, ...) by name, copied; on a CUDA device.
        index: number of the next step.
        padding: one row (1, ...) of each column, for unused rows.
        rows: number of rows for the state; default N.
    """

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        index: int,
        padding: Mapping[str, Tensor] | None = None,
        rows: int | None = None,
    ) -> None:
        given = next(iter(columns.values()))
        self._device, self._padding = given.device, padding
        self.rows = len(given) if rows is None else rows
        #: The state in fixed memory, then padding.
        self.columns = {name: column.new_empty((self.rows, *column.shape[1:])) for name, column in columns.items()}
        # Number of the next step.
        self._index = torch.empty(1, dtype=torch.int64, device=self._device)
        # 1 after a step was not committed: later ones are not committed either. Initially 1, so that the capture
        # commits nothing.
        self._failed = torch.empty_like(self._index)
        self.load(columns, index)
        self._failed.fill_(1)
        #: Whether the step has been enqueued at least once, with the messages that it sends.
        self.has_run = False

    def load(self, columns: Mapping[str, Tensor], index: int) -> None:
        """Loads another state, of at most `rows` rows."""
        for name, column in columns.items():
            self.columns[name][: len(column)].copy_(column)
            if len(column) < self.rows:
                assert self._padding is not None
                self.columns[name][len(column) :] = self._padding[name]
        self._index.fill_(index)
        self._failed.zero_()

    @abstractmethod
    def _step(self) -> Tensor:
        """Enqueues the step, which is committed if `_failed` stays 0. Returns its record, int64, one row per rank; the
        first column is nonzero if it was not committed.
        """

    @abstractmethod
    def _committed(self, index: int, record: NDArray[np.int64], seconds: float) -> C:
        """The step with this index, given its record and its seconds on the device."""

    def capture(self) -> Self:
        """Captures the step."""
        self._graph, self._record = capture(self._run, self._device)
        self._failed.zero_()
        pinned = self._device.type == "cuda"
        self._hosts = [torch.empty(self._record.shape, dtype=torch.int64, pin_memory=pinned) for _ in range(2)]
        self._replays = 0
        return self

    def _run(self) -> Tensor:
        record = self._step()
        self.has_run = True
        return record

    def replay(self) -> Replay[C]:
        """Enqueues a step, which runs if all previous ones were committed. Does not synchronise."""
        host = self._hosts[self._replays % len(self._hosts)]
        self._replays += 1
        began = record_event(timed=True)
        self._graph.replay()
        host.copy_(self._record, non_blocking=True)
        # The next step is enqueued already, so a late reaction costs nothing; a thread that spins on a busy host is
        # interrupted for milliseconds.
        return Replay(self, host, began, record_event(timed=True, sleep=True))

    def close(self) -> None:
        """Frees the graph, which cannot be replayed afterwards."""
        self._graph.reset()


@dataclass(frozen=True)
class Replay(Generic[C]):
    """An enqueued step. It must be read before the second one after it is enqueued."""

    graph: TransactionGraph[C]
    host: Tensor  #: the record, once `ended`
    began: torch.cuda.Event
    ended: torch.cuda.Event

    def read(self, index: int) -> C | None:
        """Waits for the step; None if it was not committed."""
        self.ended.synchronize()
        record = self.host.numpy().copy()
        if record[:, 0].any():
            return None
        return self.graph._committed(index, record, 1e-3 * self.began.elapsed_time(self.ended))
