"""CUDA graphs: work of a GPU that is recorded once and then launched by one call."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

T = TypeVar("T")


def capture(work: Callable[[], T], device: torch.device) -> tuple[torch.cuda.CUDAGraph, T]:
    """Records `work` as a graph. It is run once before, since kernels that have not been loaded cannot be recorded.

    Args:
        work: enqueues work on the current stream and waits for nothing; the same each time.
        device: a CUDA device.

    Returns:
        The graph, and what `work` returned when it was recorded: each replay writes to those tensors.
    """
    with torch.cuda.device(device):
        current, side = torch.cuda.current_stream(), torch.cuda.Stream()
        side.wait_stream(current)
        with torch.cuda.stream(side):
            work()
        current.wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        # Other threads (a checkpoint's, a guard's) may go on using the device.
        with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
            found = work()
        current.wait_stream(side)
    return graph, found
