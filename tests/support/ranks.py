"""A pool of rank processes: starting Python with torch takes seconds, a job a fraction of one."""

from __future__ import annotations

import multiprocessing.connection
import multiprocessing.process
import os
import traceback
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.distributed as dist

from pgccd.distributed import Alone, Comm, TorchComm
from support.forked_job import forkserver

World = Callable[..., list[Any]]
SLOW = pytest.mark.slow
# Four ranks have the most kinds of neighbours, three an odd number of parts.
ON_FOUR = [1, pytest.param(2, marks=SLOW), pytest.param(3, marks=SLOW), 4]
ON_THREE = [1, pytest.param(2, marks=SLOW), 3, pytest.param(4, marks=SLOW)]
on_three = pytest.mark.parametrize("world", ON_THREE, indirect=True)
#: Where another test runs one rank in this process.
on_several = pytest.mark.parametrize("world", ON_FOUR[1:], indirect=True)
MOST_RANKS = 4
# A job that takes longer hangs.
_SECONDS = 120


class RankPool:
    """Up to four processes. `run` uses the requested number of them as the ranks of one world, over Gloo."""

    def __init__(self) -> None:
        self._pipes: list[multiprocessing.connection.Connection] = []
        self._processes: list[multiprocessing.process.BaseProcess] = []
        self._start()

    def _start(self) -> None:
        context = forkserver()
        for rank in range(MOST_RANKS):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(rank, theirs), daemon=True)
            process.start()
            self._pipes.append(ours)
            self._processes.append(process)

    def run(self, size: int, job: Callable[..., Any], *arguments: Any) -> list[Any]:
        """job(comm, *arguments) on every rank; returns their results. `job` is a module's function.

        If a rank dies or does not answer, later jobs get new processes.
        """
        try:
            return self._run(size, job, arguments)
        except (EOFError, OSError):
            self.close()
            self._start()
            raise

    def _run(self, size: int, job: Callable[..., Any], arguments: tuple) -> list[Any]:
        # One store per job, in this process, so that no port is used twice.
        store = dist.TCPStore("127.0.0.1", 0, size + 1, is_master=True, wait_for_workers=False)
        for pipe in self._pipes[:size]:
            pipe.send((store.port, size, job, arguments))
        answers = []
        for rank, pipe in enumerate(self._pipes[:size]):
            if not pipe.poll(_SECONDS):
                raise TimeoutError(f"rank {rank} of {size} did not answer: {job.__name__}")
            answers.append(pipe.recv())
        errors = [f"rank {rank}: {error}" for rank, (_, error) in enumerate(answers) if error]
        if errors:
            raise AssertionError("\n".join(errors))
        return [result for result, _ in answers]

    def close(self) -> None:
        """Kills the processes."""
        for process in self._processes:
            process.kill()
        self._pipes.clear()
        self._processes.clear()


def to_all(comm: Comm, value: Any) -> list[Any]:
    """The values of all ranks, on every rank."""
    return comm.broadcast_object(comm.gather_objects(value))


def _serve(rank: int, pipe: multiprocessing.connection.Connection) -> None:
    torch.set_num_threads(1)
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"  # avoids resolving the host's name, which can take seconds
    while True:
        pipe.send(_work(rank, *pipe.recv()))


def _work(rank: int, port: int, size: int, job: Callable[..., Any], arguments: tuple) -> tuple[Any, str]:
    result, error = None, ""
    comm: Any = Alone()
    if size > 1:
        store = dist.TCPStore("127.0.0.1", port, size + 1, is_master=False)
        dist.init_process_group("gloo", store=store, rank=rank, world_size=size)
        dist.barrier()  # else a job without messages may close its connections while another rank still opens its own
        comm = TorchComm(on_close=dist.destroy_process_group)
    try:
        result = job(comm, *arguments)
    except BaseException:
        error = traceback.format_exc()
    comm.close()
    return result, error
