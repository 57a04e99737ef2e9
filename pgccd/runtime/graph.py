"""Capture of CUDA graphs."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


def capture(work: Callable[[], T], device: torch.device) -> tuple[torch.cuda.CUDAGraph, T]:
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
        with torch.cuda.stream(side):
            work()
        current.wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        # Other threads (of a checkpoint or guard) may continue to use the device.
        with _no_garbage_collection(), torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
            found = work()
        current.wait_stream(side)
    return graph, found


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
