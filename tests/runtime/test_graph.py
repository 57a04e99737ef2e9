"""Capture of CUDA graphs."""

from __future__ import annotations

import gc
from types import SimpleNamespace

import pytest
import torch

from pgccd.runtime import graph
from pgccd.runtime.graph import capture, conditional
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
    captured, found = capture(work, device)
    assert gc.isenabled()
    captured.replay()
    gc.collect()
    _ = [torch.empty(8, dtype=torch.int64, pin_memory=True) for _ in range(64)]  # reads the events of freed memory
    assert torch.equal(found, values + 1)


@pytest.mark.cuda
def test_parts_of_a_graph_run_only_if_wanted() -> None:
    device = torch.device("cuda")
    wanted = torch.tensor([1, 1], device=device)
    x, y = torch.arange(1000.0, device=device), torch.zeros(1000, device=device)
    runs = torch.zeros(3, dtype=torch.int64, device=device)

    def work() -> torch.Tensor:
        before = x + 1.0
        with conditional(wanted[:1]):
            y.copy_(torch.cumsum(before, 0))  # memory of the part
            runs[0] += 1
            with conditional(wanted[1:]):
                y.mul_(2.0 * torch.ones(1000, device=device))
                runs[1] += 1
        runs[2] += 1
        return y + before

    captured, found = capture(work, device)
    assert runs.tolist() == [1, 1, 1]  # before the capture, whatever is wanted
    expected = torch.zeros(1000, device=device)
    for outer, inner in ((1, 1), (0, 1), (1, 0), (0, 0), (1, 7)):
        wanted.copy_(torch.tensor([outer, inner]))
        former = y.clone()
        _ = [torch.full((1000,), torch.nan, device=device) for _ in range(8)]  # takes memory that is free
        captured.replay()
        sums = torch.cumsum(x + 1.0, 0)
        expected = (2.0 * sums if inner else sums) if outer else former
        assert torch.equal(y, expected) and torch.equal(found, expected + x + 1.0)
    assert runs.tolist() == [4, 3, 6]


@pytest.mark.cuda
def test_a_part_that_fails_during_capture_leaves_no_stream_captured() -> None:
    device = torch.device("cuda")
    wanted = torch.ones(1, dtype=torch.int64, device=device)
    calls = 0

    def work() -> None:
        nonlocal calls
        calls += 1
        with conditional(wanted):
            wanted.add_(1)
            if calls == 2:
                raise RuntimeError("in the part")

    with pytest.raises(RuntimeError, match="in the part"):
        capture(work, device)
    assert wanted.tolist() == [2]
    captured, _ = capture(lambda: wanted.add_(1), device)
    captured.replay()
    assert wanted.tolist() == [4]


def test_parts_beyond_the_limit_always_run() -> None:
    full = SimpleNamespace(parts=[None] * graph._MOST_PARTS)
    token = graph._being_captured.set(full)  # type: ignore[arg-type]
    ran = False
    with conditional(torch.zeros(1, dtype=torch.int64)):  # needs no stream of a GPU
        ran = True
    graph._being_captured.reset(token)
    assert ran and len(full.parts) == graph._MOST_PARTS
