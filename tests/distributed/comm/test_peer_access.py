"""Whether and how GPUs get access to each other's memory, agreed by all ranks."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from support.launch import PEER_MEMORY
from support.ranks import RankPool
from torch import Tensor

from distributed.comm import test_peer_memory
from pgccd.distributed import TorchComm
from pgccd.distributed.comm import peer_access, torch_comm
from pgccd.distributed.comm.peer_access import Place, are_peers, map_peer_memory
from pgccd.distributed.comm.peer_memory import PeerMemory, size_of, size_of_memory
from pgccd.runtime.events import gpu_finishes_within


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
    peer, gather = test_peer_memory.alone(64), PeerMemory.gather
    assert peer_access._try_messages(peer, 0, 1) is peer
    for wrong in range(3):
        answers = itertools.count()
        monkeypatch.setattr(PeerMemory, "gather", lambda *given: gather(*given) + (next(answers) == wrong))  # noqa: B023
        with pytest.raises(RuntimeError, match="other values arrive than were sent"):
            peer_access._try_messages(peer, 0, 1)


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
