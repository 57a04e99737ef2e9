"""Small messages that GPUs write to each other's memory: the values that arrive, whether they are used, and when NCCL
replaces them.
"""

from __future__ import annotations

import itertools
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from support.launch import PEER_MEMORY, SUPPORT, finish, over_nccl, start_ranks, torchrun
from support.peer_messages import OverConnection
from support.ranks import RankPool
from torch import Tensor

from distributed import test_captured_world, test_distributed_simulation
from pgccd import ops
from pgccd.distributed import Comm, RankFailureError, TorchComm
from pgccd.distributed.comm import peer_access, peer_memory, torch_comm
from pgccd.distributed.comm.peer_access import Place, are_peers, map_peer_memory
from pgccd.distributed.comm.peer_memory import PeerMemory, PeerMessages, RowsOfRanks, size_of, size_of_memory
from pgccd.distributed.guard import guard, of_all_ranks
from pgccd.runtime.events import gpu_finishes_within

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


@pytest.mark.cuda
@pytest.mark.parametrize(("seconds", "is_sent"), [(2.0, True), (300.0, False)])
def test_an_interrupted_rank_ends_although_its_gpu_waits(seconds: float, is_sent: bool) -> None:
    program = over_nccl(2, str(SUPPORT / "interrupted_rank.py"))
    started = start_ranks(2, [*program, str(seconds)], **PEER_MEMORY)
    begin = time.monotonic()
    interrupted, _ = started[1].communicate(timeout=180)
    assert time.monotonic() - begin < 120 and started[1].returncode not in (0, None), interrupted
    assert "KeyboardInterrupt" in interrupted
    output, _ = started[0].communicate(timeout=180)
    assert started[0].returncode not in (0, None) and "rank 1" in output and "KeyboardInterrupt" in output, output
    assert ("the second message has arrived" in output) == is_sent and "the third" not in output, output


@pytest.mark.cuda
def test_a_trial_ends_if_messages_do_not_arrive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_access, "_TRIAL_SECONDS", 0.5)
    memory = [torch.zeros(size_of_memory(2, 64), dtype=torch.uint8, device="cuda") for _ in range(2)]
    with pytest.raises(RuntimeError, match="messages do not arrive"):
        peer_access._try_messages(PeerMemory(memory[0], [each.data_ptr() for each in memory], 0), 0, 2)
    torch.cuda.synchronize()


@pytest.mark.cuda
def test_a_trial_that_fails_does_not_leave_a_kernel_waiting() -> None:
    memory = [torch.zeros(size_of_memory(2, 64), dtype=torch.uint8, device="cuda") for _ in range(2)]
    peer = PeerMemory(memory[0], [each.data_ptr() for each in memory], 0)
    gather, calls = peer.gather, itertools.count()

    def fail(values: Tensor) -> Tensor:
        if next(calls) == 1:
            raise torch.OutOfMemoryError
        return gather(values)

    with mock.patch.object(peer, "gather", fail), pytest.raises(torch.OutOfMemoryError):
        peer_access._try_messages(peer, 0, 2)
    assert gpu_finishes_within(60.0)


@pytest.mark.cuda
def test_a_trial_compares_values(monkeypatch: pytest.MonkeyPatch) -> None:
    peer, gather = alone(64), PeerMemory.gather
    assert peer_access._try_messages(peer, 0, 1) is peer
    for wrong in range(3):
        answers = itertools.count()
        monkeypatch.setattr(PeerMemory, "gather", lambda *given: gather(*given) + (next(answers) == wrong))  # noqa: B023
        with pytest.raises(RuntimeError, match="other values arrive than were sent"):
            peer_access._try_messages(peer, 0, 1)


@pytest.mark.cuda
def test_a_gpu_that_does_not_finish() -> None:
    assert gpu_finishes_within(60.0)
    memory = [torch.zeros(size_of_memory(2, 64), dtype=torch.uint8, device="cuda") for _ in range(2)]
    peer = PeerMemory(memory[0], [each.data_ptr() for each in memory], 0)
    peer.gather(torch.arange(8, device="cuda"))
    assert not gpu_finishes_within(0.2)
    peer.stop()
    assert gpu_finishes_within(60.0)


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
    here = [Place("here", str(gpu), False) for gpu in range(17)]
    assert are_peers(here[:2]) and are_peers(here[:16])
    assert not are_peers(here)
    assert not are_peers([here[0], here[1]._replace(host="there")])
    assert not are_peers([here[0], None])
    assert not are_peers([here[0], here[0]])  # they share a GPU
    sharing = here[0]._replace(may_share=True)
    assert are_peers([sharing, sharing]) and not are_peers([sharing, here[0]])


@pytest.mark.cuda
def test_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PGCCD_PEER_MEMORY", "0")
    assert peer_access.place_of_gpu() is None
    monkeypatch.setenv("PGCCD_PEER_MEMORY", "1")
    sharing = peer_access.place_of_gpu()
    monkeypatch.delenv("PGCCD_PEER_MEMORY")
    place = peer_access.place_of_gpu()
    assert place is not None and sharing == place._replace(may_share=True) and not place.may_share
    for name, value, is_forbidden in (("DISABLE", "1", True), ("LEVEL", "LOC", True), ("LEVEL", "NVL", False)):
        with monkeypatch.context() as context:
            context.setenv(f"NCCL_P2P_{name}", value)
            assert peer_access.place_of_gpu() == (None if is_forbidden else place)
            context.setenv("PGCCD_PEER_MEMORY", "1")
            assert peer_access.place_of_gpu() == sharing
    monkeypatch.setattr(peer_access, "_BOOT_ID", Path("/no file"))
    assert peer_access.place_of_gpu() is None


def error_with(comm: Any, setting: str) -> str:
    with mock.patch.dict("os.environ", {"PGCCD_PEER_MEMORY": setting}):
        try:
            TorchComm(comm._group)
        except ValueError as error:
            return str(error)
    return ""


def test_an_unknown_setting_is_an_error_at_the_start(ranks: RankPool) -> None:
    for setting in ("", "0", "1"):
        assert ranks.run(2, error_with, setting) == ["", ""]
    assert ranks.run(2, error_with, "yes") == ["PGCCD_PEER_MEMORY: expected 0 or 1, got 'yes'"] * 2


def test_sizes() -> None:
    assert [size_of(bytes) for bytes in (1, 1 << 16, (1 << 16) + 1, 1 << 20)] == [1 << 16, 1 << 16, 1 << 17, 1 << 20]


class Mapped:
    """Stands for memory of this size."""

    def __init__(self, bytes: int) -> None:
        self.bytes, self.is_stopped = bytes, False

    def stop(self) -> None:
        self.is_stopped = True


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
    comm.stop_messages()
    assert all(each.is_stopped for each in made)
    return [each.bytes for each in made]


class Reserved:
    """Stands for memory of a rank's GPU; its handle is its rank."""

    def __init__(self, rank: int, size: int) -> None:
        self.address, self.memory = 100 + rank, torch.zeros(size, dtype=torch.uint8)
        self.handle = torch.full((8,), rank)


def map_or_fail(comm: Any, failing: str | None) -> list[int] | None:
    """The addresses that a rank gets; None if NCCL sends the messages. The last rank may fail to reserve memory or to
    receive messages, or every rank to open the memory of the last one.
    """
    last = comm.size - 1

    def reserve(size: int) -> Reserved:
        if failing == "reserve" and comm.rank == last:
            raise RuntimeError("no memory")
        return Reserved(comm.rank, size)

    def open_other(handle: Tensor) -> int:
        assert handle.tolist() == [int(handle[0])] * 8 and int(handle[0]) != comm.rank
        if failing == "open" and int(handle[0]) == last:
            raise RuntimeError("no access")
        return 200 + int(handle[0])

    def try_messages(memory: PeerMemory, *_numbers: int) -> PeerMemory:
        if failing == "trial" and comm.rank == last:
            raise ValueError("messages do not arrive")
        return memory

    with mock.patch.multiple(peer_access, _Reserved=reserve, _open=open_other, _try_messages=try_messages):
        if failing is None:
            mapped = map_peer_memory(comm, 64)
            assert mapped is not None and mapped.bytes == 64
            return mapped._where[1].tolist()
        own = (comm.rank == last) == (failing != "open")
        whys = {"reserve": "no memory", "open": "no access", "trial": "messages do not arrive"}
        why = whys[failing] if own else "another rank could not"
        comm._has_peers = True
        warned = pytest.warns(UserWarning, match=f"NCCL sends small messages: .*: {why}")
        with mock.patch.dict("os.environ", PEER_MEMORY), warned:
            comm.reserve_peer_messages(1000)
        assert comm.peer_messages is None
        comm.reserve_peer_messages(1000)  # not tried again
        return None


@pytest.mark.parametrize("failing", [None, "reserve", "open", "trial"])
def test_all_ranks_agree_whether_memory_can_be_reached(ranks: RankPool, failing: str | None) -> None:
    known = [[200, 201, 202] for _ in range(3)]
    for rank in range(3):
        known[rank][rank] = 100 + rank
    assert ranks.run(3, map_or_fail, failing) == (known if failing is None else [None] * 3)


def test_all_ranks_reserve_the_same_size(ranks: RankPool) -> None:
    assert ranks.run(3, reserve) == [[1 << 16, 1 << 17, 1 << 20]] * 3


def leave(comm: Any, error: BaseException, *finishes: bool | BaseException) -> tuple[list[float], list[str]]:
    """How long a rank over NCCL has waited for its GPU, and how it has left, given what the waiting returned."""
    waits, done = mock.Mock(side_effect=finishes), mock.Mock()
    replaced = {"transport": "nccl", "_on_close": done.disconnect, "stop_messages": done.stop_messages}
    kept = {name: getattr(comm, name) for name in replaced}
    vars(comm).update(replaced)
    with (
        mock.patch.object(torch_comm, "gpu_finishes_within", waits),
        mock.patch.object(torch_comm.TorchComm, "_gpu", 0),
        mock.patch.object(comm.guard, "end_hard", done.end_hard),
        mock.patch.object(comm.guard, "report", done.report),
    ):
        with pytest.raises((type(error), *[type(each) for each in finishes if isinstance(each, BaseException)])), comm:
            raise error
        comm.close()  # does nothing more
    vars(comm).update(kept, _is_closed=False)
    return [call.args[0] for call in waits.call_args_list], [name for name, _, _ in done.method_calls]


def test_a_rank_with_an_error_lets_others_catch_up_before_it_stops(ranks: RankPool) -> None:
    whole, error = torch_comm._LAST_MESSAGES_SECONDS, MemoryError()
    assert ranks.run(2, leave, error, True) == [([whole], ["report", "stop_messages", "disconnect"])] * 2
    stopped = [whole, torch_comm._STOP_SECONDS]
    done = ["report", "stop_messages", "stop_messages", "disconnect"]
    assert ranks.run(2, leave, error, False, True) == [(stopped, done)] * 2
    done = ["report", "stop_messages", "end_hard"]
    assert ranks.run(2, leave, error, False, False) == [(stopped, done)] * 2
    assert sum(stopped) < guard._GRACE_SECONDS
    # Ctrl-C a second time.
    assert ranks.run(2, leave, KeyboardInterrupt(), KeyboardInterrupt()) == [([whole], ["report", "end_hard"])] * 2


def test_after_the_failure_of_another_rank_messages_stop(ranks: RankPool) -> None:
    assert ranks.run(2, leave, RankFailureError("rank 1 has died")) == [([], ["report", "stop_messages"])] * 2


def close_after_a_fault(comm: Any, in_work: BaseException | None) -> tuple[str, list[str]]:
    """The error that a rank raises and what it has done, if its GPU reports an error while the connection is closed."""
    fault, done = RuntimeError("device-side assert"), mock.Mock()
    replaced = {"transport": "nccl", "_on_close": done.disconnect}
    kept = {name: getattr(comm, name) for name in replaced}
    vars(comm).update(replaced)
    with (
        mock.patch.object(torch.cuda, "synchronize", mock.Mock(side_effect=fault)),
        mock.patch.object(torch_comm, "gpu_finishes_within", lambda *_: True),
        mock.patch.object(torch_comm.TorchComm, "_gpu", 0),
        mock.patch.object(comm.guard, "report", done.report),
        pytest.raises((RuntimeError, ValueError)) as caught,
        comm,
    ):
        if in_work is not None:
            raise of_all_ranks(in_work)
    assert all(call.args == (fault,) for call in done.report.call_args_list)
    vars(comm).update(kept, _is_closed=False)
    return str(caught.value), [name for name, _, _ in done.method_calls]


def test_an_error_while_a_connection_is_closed_is_reported(ranks: RankPool) -> None:
    done = ["report", "disconnect"]
    assert ranks.run(2, close_after_a_fault, None) == [("device-side assert", done)] * 2
    assert ranks.run(2, close_after_a_fault, ValueError("--seed")) == [("--seed", done)] * 2


def wish_for_peers(comm: Any, is_peer: bool) -> bool:
    place = Place("here", str(comm.rank), False) if is_peer or comm.rank == 0 else None
    with mock.patch.object(torch_comm, "place_of_gpu", lambda: place), mock.patch.dict("os.environ", PEER_MEMORY):
        comm.transport = "nccl"
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            has_peers = comm._has_peers
        comm.transport = "gloo"
    expected = [] if has_peers else ["NCCL sends small messages"]
    assert [str(each.message)[:25] for each in warned] == expected
    return has_peers


def test_a_wish_for_peer_memory_that_is_not_met_warns(ranks: RankPool) -> None:
    assert ranks.run(2, wish_for_peers, True) == [True, True]
    assert ranks.run(2, wish_for_peers, False) == [False, False]
