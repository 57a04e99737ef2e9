"""Capture of CUDA graphs."""

from __future__ import annotations

import gc

import pytest
import torch

from pgccd.runtime.graph import capture
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.side_stream import SideStream


@pytest.mark.cuda
def test_pinned_memory_in_garbage_is_not_freed_during_capture() -> None:
    device = torch.device("cuda")
    values = torch.arange(8, device=device)
    with SideStream(device):
        copy = HostCopy.start(values)
    copy.numpy()
    garbage: list[object] = [copy]
    garbage.append(garbage)
    kept, calls = [garbage], 0
    del copy, garbage

    def work() -> torch.Tensor:
        nonlocal calls
        calls += 1
        side = SideStream(device)
        with side:
            found = values + 1
        if calls == 2:  # during capture
            kept.clear()
            assert not gc.isenabled()
        _ = [[] for _ in range(100_000)]  # would start garbage collections
        side.join()
        return found

    assert gc.isenabled()
    graph, found = capture(work, device)
    assert gc.isenabled()
    graph.replay()
    gc.collect()
    _ = [torch.empty(8, dtype=torch.int64, pin_memory=True) for _ in range(64)]  # reads the events of freed memory
    assert torch.equal(found, values + 1)
