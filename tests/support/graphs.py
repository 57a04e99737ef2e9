"""Replacements for CUDA graphs and events where there is no GPU: a replay repeats the work."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from pgccd.runtime import transaction


class Recorded:
    """A graph; its replay repeats the work."""

    def __init__(self, work: Callable[[], Tensor]) -> None:
        self._work, self._found = work, work()

    def replay(self) -> None:
        self._found.copy_(self._work())

    def reset(self) -> None:
        del self._work


class Now:
    """An event that has always completed."""

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, _: Now) -> float:
        return 1.0


def record(work: Callable[[], Tensor], device: torch.device) -> tuple[Any, Tensor]:
    """Replaces `pgccd.runtime.graph.capture`."""
    work()
    graph = Recorded(work)
    return graph, graph._found


def graphs_on(device: torch.device | str) -> ExitStack:
    """A context in which steps can be captured on this device; "none": without graphs."""
    stack = ExitStack()
    if device != "none" and torch.device(device).type == "cpu":
        stack.enter_context(mock.patch.object(transaction, "capture", record))
        stack.enter_context(mock.patch.object(transaction, "record_event", lambda timed, sleep=False: Now()))
    return stack
