"""Capture of CUDA graphs."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TypeVar

import torch
from torch import Tensor

from pgccd import ops

T = TypeVar("T")


class Graph:
    """A CUDA graph, and the memory that its conditional parts use."""

    def __init__(self) -> None:
        self.graph = torch.cuda.CUDAGraph()
        self.parts: list[tuple[torch.cuda.Stream, torch.cuda.MemPool]] = []

    def replay(self) -> None:
        """Enqueues the work on the current stream."""
        self.graph.replay()

    def reset(self) -> None:
        """Frees the graph, which cannot be replayed afterwards."""
        self.graph.reset()
        self.parts.clear()


# Each part takes one of torch's 32 streams during capture, and nested ones at the same time.
_MOST_PARTS = 8

_being_captured: ContextVar[Graph | None] = ContextVar("being_captured", default=None)
_capturing: ContextVar[bool] = ContextVar("capturing", default=False)


def is_capturing() -> bool:
    """Whether `capture` runs the work, for the first or the second time."""
    return _capturing.get()


def capture(work: Callable[[], T], device: torch.device) -> tuple[Graph, T]:
    """Captures `work` as a graph. It is run once before, since kernels cannot be loaded during capture.

    Args:
        work: enqueues the same work each time on the current stream, without synchronising.
        device: a CUDA device.

    Returns:
        The graph, and the result of `work` during capture: each replay writes to these tensors.

    Raises:
        ValueError: there are no graphs on this device.
    """
    if device.type != "cuda":
        raise ValueError(f"graph: steps on a {device.type} device cannot be replayed")
    with torch.cuda.device(device):
        current, side = torch.cuda.current_stream(), torch.cuda.Stream()
        side.wait_stream(current)
        graph = Graph()
        with _set(_capturing, True):
            with torch.cuda.stream(side):
                work()
            current.wait_stream(side)
            # Other threads (of a checkpoint or guard) may continue to use the device.
            with (
                _set(_being_captured, graph),
                _no_garbage_collection(),
                torch.cuda.graph(graph.graph, stream=side, capture_error_mode="thread_local"),
            ):
                found = work()
        current.wait_stream(side)
    return graph, found


@contextmanager
def _set(variable: ContextVar[T], value: T) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@contextmanager
def conditional(value: Tensor) -> Iterator[None]:
    """A part of a graph that each replay runs only if `value` (1,) int64 is nonzero when the replay reaches it. May be
    nested. If the part runs, what it writes to outside tensors is kept; if it does not, they keep their values. The
    part always runs outside of `capture`, where the driver does not support conditional parts, and after the first
    eight parts of a graph.

    Example:
        >>> change, count = torch.ones(1, dtype=torch.int64), torch.zeros(1)
        >>> with pgccd.runtime.graph.conditional(change):
        ...     count[0] = 7.0
        >>> int(count)
        7
    """
    graph = _being_captured.get()
    if graph is None or len(graph.parts) >= _MOST_PARTS or not ops.has_conditional_nodes(value):
        yield
        return
    # Torch does not recognise the stream of the part as one of this capture: without a pool of its own, kept with the
    # graph, the part would use memory that is handed out again between replays.
    stream, pool = _uncaptured_stream(), torch.cuda.MemPool()
    graph.parts.append((stream, pool))
    ops.begin_conditional(value, stream.cuda_stream)
    try:
        with torch.cuda.stream(stream), torch.cuda.use_mem_pool(pool):
            yield
    except BaseException:
        with suppress(RuntimeError):  # after an error the capture may be invalid
            ops.end_conditional(value, stream.cuda_stream)
        raise
    ops.end_conditional(value, stream.cuda_stream)


def _uncaptured_stream() -> torch.cuda.Stream:
    """A stream that is not being captured; torch hands out 32 in turn."""
    while True:
        stream = torch.cuda.Stream()
        with torch.cuda.stream(stream):
            if not torch.cuda.is_current_stream_capturing():
                return stream


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """A context without garbage collection. Pinned memory freed during capture records an event on each stream that
    used it; if that stream is captured, the event is invalid, and a later allocation of pinned memory, which reads it,
    fails.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
