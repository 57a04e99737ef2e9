"""Small messages that GPUs write to each other's memory: the values that arrive, whether they are used, and when NCCL
replaces them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

import pytest
import torch
from support.launch import PEER_MEMORY, SUPPORT, finish, over_nccl, torchrun
from support.peer_messages import OverConnection
from support.ranks import RankPool
from torch import Tensor

from distributed import test_captured_world, test_distributed_simulation
from pgccd import ops
from pgccd.distributed import Comm
from pgccd.distributed.comm import peer_memory, torch_comm
from pgccd.distributed.comm.peer_memory import PeerMemory, PeerMessages, RowsOfRanks, are_peers, size_of

BYTES = 8 * 5000


def alone(bytes: int = BYTES) -> PeerMemory:
    """Of a single rank."""
    memory = torch.zeros(256 + 2 * bytes, dtype=torch.uint8, device="cuda")
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

    def work() -> Tensor:
        peers.lower(values, shared, shared)
        lowered = values.clone()
        peers.lower(values, to_last, of_first)
        return lowered

    lowered, graph = graph_of(work)
    for _ in range(10):
        drawn = torch.rand(comm.size, 3000, generator=generator, dtype=torch.float64)
        before = torch.where(drawn < 0.2, torch.inf, drawn)  # of each body, at each rank
        values[mine.cuda()] = before[comm.rank].cuda()
        graph.replay()
        found = lowered.cpu()[mine]
        least = torch.where(torch.stack(holds), before, torch.inf).amin(dim=0)
        assert torch.equal(found[holds[comm.rank]], least[holds[comm.rank]])
        assert torch.equal(found[~holds[comm.rank]], before[comm.rank][~holds[comm.rank]])
        first = [float(each) for each in comm.all_gather(lowered[:1])]
        assert float(values[0]) == (min(first[0], first[-1]) if comm.rank == last else first[comm.rank])
        assert torch.equal(values[1:], lowered[1:])


@pytest.mark.cuda
@pytest.mark.parametrize("ranks", [2, 3])
def test_messages_between_processes(ranks: int) -> None:
    done = finish(torchrun(ranks, *over_nccl(ranks, str(SUPPORT / "peers_job.py"))), **PEER_MEMORY)
    assert done.returncode == 0, done.stdout


@pytest.mark.cuda
def test_arguments_are_checked() -> None:
    peer = alone(64)
    memory, addresses, rank = peer._where
    values = torch.zeros(9, dtype=torch.int64, device="cuda")
    for wrong, message in (
        ((values, memory, addresses, rank), "memory: too small for a message of 72 bytes"),
        ((values[:1], memory[:100], addresses, rank), "memory: too small for the flags"),
        ((values[:1], memory, addresses, 1), "rank: expected a number below 1, got 1"),
        ((values[:1], memory, addresses.repeat(17), 0), "addresses: expected those of at most 16 ranks"),
        ((values[:1].int(), memory, addresses, 0), "values: wrong dtype"),
    ):
        with pytest.raises(RuntimeError, match=message):
            ops.peer_gather(*wrong)
    toi = values.double()
    for sent, received, message in (
        ([8], [9], "memory: too small for a message of 72 bytes"),
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
    toi, none = values.double(), values[:0]
    torch.library.opcheck(torch.ops.pgccd.peer_minimum.default, (toi, none, [0], none, [0], *peer._where))
    assert toi.tolist() == values.tolist()


def follow_simulation(comm: Comm, neighbours_above: int) -> int:
    comm.neighbours_above = neighbours_above
    comm.peer_messages = messages = OverConnection(comm)
    seen = test_distributed_simulation.follow_replayed(comm, "random", "cost", 24, False)
    assert seen["replayed"] > 3
    return messages.calls


def follow_world(comm: Comm) -> int:
    comm.peer_messages = messages = OverConnection(comm)
    seen = test_captured_world.follow(comm, "cost", "bisection", True, "cpu", False)
    assert seen["replayed"] > 3
    return messages.calls


@pytest.mark.parametrize("neighbours_above", [32, 0])
def test_steps_with_messages_of_peers(ranks: RankPool, neighbours_above: int) -> None:
    assert min(ranks.run(3, follow_simulation, neighbours_above)) > 50


def test_steps_of_a_world_with_messages_of_peers(ranks: RankPool) -> None:
    assert min(ranks.run(3, follow_world)) > 20


def test_which_ranks_are_peers() -> None:
    assert are_peers([("here", "a"), ("here", "b")])
    assert not are_peers([("here", "a"), ("there", "b")])
    assert not are_peers([("here", "a"), ("here", "a")])  # they share a GPU
    assert not are_peers([("here", "a"), None])
    assert are_peers([("here", str(gpu)) for gpu in range(16)])
    assert not are_peers([("here", str(gpu)) for gpu in range(17)])


@pytest.mark.parametrize("setting", [None, "0"])
def test_it_is_off_unless_switched_on(setting: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PGCCD_PEER_MEMORY", raising=False)
    if setting is not None:
        monkeypatch.setenv("PGCCD_PEER_MEMORY", setting)
    assert peer_memory.place_of_gpu() is None


def test_sizes() -> None:
    assert [size_of(bytes) for bytes in (1, 1 << 16, (1 << 16) + 1, 1 << 20)] == [1 << 16, 1 << 16, 1 << 17, 1 << 20]


class Mapped:
    """Stands for memory of this size."""

    def __init__(self, bytes: int) -> None:
        self.bytes = bytes


def reserve(comm: Any) -> list[int]:
    """Sizes that are reserved, given different needs of ranks."""
    made: list[Mapped] = []

    def map_memory(_group: Any, bytes: int) -> Mapped:
        made.append(Mapped(bytes))
        return made[-1]

    with mock.patch.object(torch_comm, "map_peer_memory", map_memory):
        comm.reserve_peer_messages(1000)
        assert comm.peer_messages is None  # not over Gloo
        comm._has_peers = True
        for bytes in (1000, 70_000 + 1000 * comm.rank, 10, 300_000 * comm.rank + 1):
            comm.reserve_peer_messages(bytes)
            assert comm.peer_messages is made[-1]
    return [each.bytes for each in made]


def fail_to_reserve(comm: Any) -> None:
    """The last rank cannot reach the memory of other GPUs."""

    def map_memory(_group: Any, bytes: int) -> Mapped:
        if comm.rank == comm.size - 1:
            raise RuntimeError("no access")
        return Mapped(bytes)

    comm._has_peers = True
    with mock.patch.object(torch_comm, "map_peer_memory", map_memory):
        why = "no access" if comm.rank == comm.size - 1 else "another rank could not"
        with pytest.warns(UserWarning, match=f"NCCL sends small messages: .*: {why}"):
            comm.reserve_peer_messages(1000)
        assert comm.peer_messages is None
        comm.reserve_peer_messages(1000)  # not tried again


def test_all_ranks_reserve_the_same_size(ranks: RankPool) -> None:
    assert ranks.run(3, reserve) == [[1 << 16, 1 << 17, 1 << 20]] * 3


def test_no_rank_uses_peers_that_one_cannot_reach(ranks: RankPool) -> None:
    ranks.run(2, fail_to_reserve)
