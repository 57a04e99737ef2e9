"""Small messages that GPUs write to each other's memory: the values that arrive, and whether they are used."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from support.launch import PEER_MEMORY, SUPPORT, finish, over_nccl, torchrun
from support.peer_messages import OverConnection
from support.ranks import RankPool
from torch import Tensor

from distributed.steps import test_rank
from distributed.world import test_captured_resolving, test_loop
from pgccd import ops
from pgccd.distributed import Comm
from pgccd.distributed.comm import peer_memory
from pgccd.distributed.comm.peer_memory import PeerMemory, PeerMessages, RowsOfRanks, size_of_memory

BYTES = 8 * 5000


def alone(bytes: int = BYTES) -> PeerMemory:
    """Of a single rank."""
    memory = torch.zeros(size_of_memory(1, bytes), dtype=torch.uint8, device="cuda")
    return PeerMemory(memory, [memory.data_ptr()], 0)


def graph_of(work: Callable[[], Any]) -> tuple[Any, torch.cuda.CUDAGraph]:
    """The result of work that sends messages, and a graph that repeats it."""
    work()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        return work(), graph


def gather_many(comm: Comm, peers: PeerMessages) -> None:
    """Messages of any size, all ranks know the values of each, in 20 replays."""
    counts = (1, 600, 0, 5000, 7)
    given = [torch.zeros(count, dtype=torch.int64, device="cuda") for count in counts]
    found, graph = graph_of(lambda: [peers.gather(values) for values in given])
    for turn in range(20):
        for k, values in enumerate(given):
            values.copy_(torch.arange(len(values)) + 10_000_000 * turn + 1_000_000 * comm.rank + 100_000 * k)
        graph.replay()
        for gathered, values in zip(found, given, strict=True):
            mine = 1_000_000 * comm.rank
            expected = torch.stack([values - mine + 1_000_000 * rank for rank in range(comm.size)])
            assert torch.equal(gathered, expected), turn


def lower_shared(comm: Comm, peers: PeerMessages) -> None:
    """Ranks hold some of 3,000 bodies, in rows of an order of their own, and lower the values of those that others hold
    too. Then rank 0 alone sends one more value, to the last rank.
    """
    generator = torch.Generator().manual_seed(1)  # the same on all ranks
    rows = [torch.randperm(3000, generator=generator) for _ in range(comm.size)]
    holds = [torch.rand(3000, generator=generator) < 0.7 for _ in range(comm.size)]
    mine, padding = rows[comm.rank], torch.full((3,), -1)
    listed, sizes = [padding[:0]], [0] * comm.size
    for rank in range(comm.size):
        if rank != comm.rank:
            listed += [mine[holds[rank] & holds[comm.rank]], padding]
            sizes[rank] = len(listed[-2]) + len(padding)
    shared = RowsOfRanks(torch.cat(listed).cuda(), sizes)
    values, last = torch.zeros(3000, dtype=torch.float64, device="cuda"), comm.size - 1

    def first_row(to_or_of: int, if_rank: int) -> RowsOfRanks:
        counts = [int(comm.rank == if_rank and rank == to_or_of) for rank in range(comm.size)]
        return RowsOfRanks(torch.zeros(sum(counts), dtype=torch.int64, device="cuda"), counts)

    to_last, of_first = first_row(last, 0), first_row(0, last)
    found, anywhere = torch.zeros((2, 1), dtype=torch.int64, device="cuda")

    def work() -> Tensor:
        anywhere.zero_()
        peers.lower(values, shared, shared, found, anywhere)
        lowered = values.clone()
        peers.lower(values, to_last, of_first)
        return lowered

    lowered, graph = graph_of(work)
    for turn in range(10):
        finds = [turn in (rank, 5) for rank in range(comm.size)]
        found.fill_(7 * finds[comm.rank])
        drawn = torch.rand(comm.size, 3000, generator=generator, dtype=torch.float64)
        before = torch.where(drawn < 0.2, torch.inf, drawn)  # of each body, at each rank
        values[mine.cuda()] = before[comm.rank].cuda()
        graph.replay()
        assert anywhere.tolist() == [any(finds)]
        made = lowered.cpu()[mine]
        least = torch.where(torch.stack(holds), before, torch.inf).amin(dim=0)
        assert torch.equal(made[holds[comm.rank]], least[holds[comm.rank]])
        assert torch.equal(made[~holds[comm.rank]], before[comm.rank][~holds[comm.rank]])
        first = [float(each) for each in comm.all_gather(lowered[:1])]
        assert float(values[0]) == (min(first[0], first[-1]) if comm.rank == last else first[comm.rank])
        assert torch.equal(values[1:], lowered[1:])


@pytest.mark.cuda
@pytest.mark.parametrize("ranks", [2, 3])
def test_messages_between_processes(ranks: int) -> None:
    done = finish(torchrun(ranks, *over_nccl(ranks, str(SUPPORT / "peers_job.py"))), **PEER_MEMORY)
    assert done.returncode == 0, done.stdout


@pytest.mark.cuda
def test_a_stopped_rank_neither_waits_nor_sends() -> None:
    memory = [torch.zeros(size_of_memory(2, 64), dtype=torch.uint8, device="cuda") for _ in range(2)]
    peer = PeerMemory(memory[0], [each.data_ptr() for each in memory], 0)
    values, toi, row = torch.arange(8, device="cuda"), torch.full((2,), 0.5, device="cuda").double(), torch.tensor([1])
    both, kept = RowsOfRanks(row.cuda(), [0, 1]), toi.clone()
    first, second = peer.gather(values), peer.gather(values)
    peer.lower(toi, both, both)
    ended = torch.cuda.current_stream().record_event()
    time.sleep(0.5)
    assert not ended.query()  # the other rank sends nothing
    peer.stop()
    torch.cuda.synchronize()
    assert first.tolist() == second.tolist() == [list(range(8)), [1] * 8] and torch.equal(toi, kept)
    # At rank 1: the flags of even messages, then those of odd ones, of rank 0. Only the first message was sent.
    flags = memory[1].view(torch.int64)[:16].tolist()
    assert flags == [0] * 8 + [1] * 8


def test_a_forked_child_does_not_stop_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    for process, expected in ((os.getpid(), 1), (os.getpid() + 1, 0)):
        peer = PeerMemory(torch.zeros(size_of_memory(1, 64), dtype=torch.uint8), [0], 0)
        with monkeypatch.context() as context:
            context.setattr(os, "getpid", lambda process=process: process)
            peer.stop()
        assert peer_memory._words.pop().tolist() == [expected]


@pytest.mark.cuda
def test_arguments_are_checked() -> None:
    peer = alone(64)
    memory, addresses, stop, rank = peer._where
    values = torch.zeros(9, dtype=torch.int64, device="cuda")
    for wrong, message in (
        ((values, memory, addresses, stop, rank), "memory: too small for a message of 72 bytes"),
        ((values[:1], memory[:100], addresses, stop, rank), "memory: too small for the flags"),
        ((values[:1], memory, addresses, 0, rank), "stop: expected the address of a word"),
        ((values[:1], memory, addresses, stop, 1), "rank: expected a number below 1, got 1"),
        ((values[:1], memory, addresses.repeat(17), stop, 0), "addresses: expected those of at most 16 ranks"),
        ((values[:1].int(), memory, addresses, stop, 0), "values: wrong dtype"),
    ):
        with pytest.raises(RuntimeError, match=message):
            ops.peer_gather(*wrong)
    toi = values.double()
    for sent, received, message in (
        ([8], [8], "memory: too small for a message of 72 bytes"),
        ([-1], [0], "sent: expected numbers >= 0"),
        ([3], [4], "received: expected numbers that sum up to 3 rows"),
        ([1, 2], [3], "sent: expected 1 numbers, got 2"),
    ):
        with pytest.raises(RuntimeError, match=message):
            rows = values[: max(0, sum(sent))], values[:3]
            peer.lower(toi, *map(RowsOfRanks, rows, (sent, received)))


@pytest.mark.cuda
def test_opcheck() -> None:
    peer = alone()
    values = torch.arange(5, device="cuda")
    torch.library.opcheck(torch.ops.pgccd.peer_gather.default, (values, *peer._where))
    assert peer.gather(values).tolist() == [values.tolist()]
    toi, none, found, anywhere = values.double(), values[:0], values[2:3], torch.zeros_like(values[:1])
    rows = toi, none, [0], none, [0]
    torch.library.opcheck(torch.ops.pgccd.peer_minimum.default, (*rows, None, None, *peer._where))
    torch.library.opcheck(torch.ops.pgccd.peer_minimum.default, (*rows, found, anywhere, *peer._where))
    assert toi.tolist() == values.tolist()
    for number, expected in ((2, 1), (0, 0)):
        anywhere.zero_()
        peer.lower(toi, RowsOfRanks(none, [0]), RowsOfRanks(none, [0]), torch.full_like(anywhere, number), anywhere)
        assert anywhere.tolist() == [expected]
    with pytest.raises(RuntimeError, match="found, anywhere: expected both or none"):
        ops.peer_minimum(*rows, found, None, *peer._where)


def follow_simulation(comm: Comm, alone: test_rank.SingleRun, neighbours_above: int) -> int:
    comm.neighbours_above = neighbours_above
    comm.peer_messages = messages = OverConnection(comm)
    seen = test_rank.follow_replayed(comm, alone, "random", "cost", False)
    assert seen["replayed"] > 3 and seen["skipped"] > 3
    return messages.calls


def follow_world(comm: Comm, alone: test_loop.PlainLoop) -> int:
    comm.peer_messages = messages = OverConnection(comm)
    seen = test_loop.follow(comm, alone, "cost", "bisection", True, "cpu", False)
    assert seen["replayed"] > 3
    return messages.calls


def follow_resolved_world(comm: Comm, alone: test_captured_resolving.PlainLoop) -> int:
    comm.peer_messages = messages = OverConnection(comm)
    assert test_captured_resolving.follow(comm, alone, "report", True, "cpu")["replayed"] > 3
    return messages.calls


@pytest.mark.parametrize("neighbours_above", [32, 0])
def test_steps_with_messages_of_peers(ranks: RankPool, neighbours_above: int) -> None:
    assert min(ranks.run(3, follow_simulation, test_rank.single_run("random", test_rank.STEPS), neighbours_above)) > 50


def test_steps_of_a_world_with_messages_of_peers(ranks: RankPool) -> None:
    assert min(ranks.run(3, follow_world, test_loop.plain_loop(test_loop.STEPS))) > 20
    alone = test_captured_resolving.plain_loop(test_captured_resolving.STEPS, "report")
    assert min(ranks.run(3, follow_resolved_world, alone)) > 100
