"""A job whose ranks are forked from a process that has imported torch: with the guard and a rendezvous, as torchrun
starts them, but in a fraction of a second.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import torch

from pgccd.cli import main
from support.launch import free_port


def forkserver() -> ForkServerContext:
    """Of a process that imports torch once, and forks others before it starts any thread."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pgccd.cli"])
    return context


class ForkedJob:
    """Starts job(*arguments) in `size` processes with torchrun's variables; `job` is a module's function, which
    connects and may return an exit code. What a rank prints goes to `folder`. At the end of the context no process is
    left.
    """

    def __init__(self, size: int, folder: Path, job: Callable[..., Any], *arguments: Any) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        context, port = forkserver(), free_port()
        self._texts = [folder / f"rank-{rank}.txt" for rank in range(size)]
        self.processes = [
            context.Process(target=_begin, args=(rank, size, port, self._texts[rank], job, arguments))
            for rank in range(size)
        ]
        for process in self.processes:
            process.start()

    def finish(self, seconds: float = 120.0) -> list[int | None]:
        """Waits until all ranks have ended. Returns their exit codes; None of those that have not in this time."""
        deadline = time.monotonic() + seconds
        for process in self.processes:
            process.join(max(0.0, deadline - time.monotonic()))
        return [process.exitcode for process in self.processes]

    def __enter__(self) -> ForkedJob:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.kill()
            process.join()

    @property
    def said(self) -> str:
        """What all ranks have printed."""
        return "".join(self.said_by(rank) for rank in range(len(self._texts)))

    def said_by(self, rank: int) -> str:
        text = self._texts[rank]
        return text.read_text() if text.exists() else ""


def _begin(rank: int, size: int, port: int, text: Path, job: Callable[..., Any], arguments: tuple) -> None:
    descriptor = os.open(text, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(size), "LOCAL_RANK": str(rank), "LOCAL_WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    try:
        code = job(*arguments)
    except Exception:
        traceback.print_exc()
        code = 1
    sys.exit(code)


def script(path: str, *arguments: str) -> None:
    """A job: a program of Python with these arguments."""
    sys.argv = [path, *arguments]
    runpy.run_path(path, run_name="__main__")


def command_line(*arguments: str) -> int:
    """A job: `pgccd` with these arguments."""
    return main(arguments)


def torchrun_of_forked(options: Sequence[str], *arguments: str) -> None:
    """A job of one process: torchrun with these options, whose ranks, `pgccd` with these arguments, are forked from it,
    since each program that it starts imports torch.
    """
    from torch.distributed.launcher.api import elastic_launch
    from torch.distributed.run import config_from_args, parse_args

    config, _, _ = config_from_args(parse_args([*options, "pgccd"]))
    config.start_method = "fork"
    elastic_launch(config, _exit_with_code)(*arguments)


def _exit_with_code(*arguments: str) -> None:
    if code := main(arguments):
        sys.exit(code)
