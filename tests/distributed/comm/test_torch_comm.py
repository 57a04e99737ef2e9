"""How a rank leaves a job: regularly, with an error of its own, and after another rank has failed."""

from __future__ import annotations

import time
from typing import Any
from unittest import mock

import pytest
import torch
from support.launch import PEER_MEMORY, SUPPORT, over_nccl, start_ranks
from support.ranks import RankPool

from pgccd.distributed import RankFailureError
from pgccd.distributed.comm import torch_comm
from pgccd.distributed.comm.peer_memory import PeerMemory, size_of_memory
from pgccd.distributed.guard import guard, of_all_ranks
from pgccd.runtime.events import gpu_finishes_within


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
def test_a_gpu_that_does_not_finish() -> None:
    assert gpu_finishes_within(60.0)
    memory = [torch.zeros(size_of_memory(2, 64), dtype=torch.uint8, device="cuda") for _ in range(2)]
    peer = PeerMemory(memory[0], [each.data_ptr() for each in memory], 0)
    peer.gather(torch.arange(8, device="cuda"))
    assert not gpu_finishes_within(0.2)
    peer.stop()
    assert gpu_finishes_within(60.0)


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
