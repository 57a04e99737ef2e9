"""A run of the simulation on ranks of which one meets a fault in a step: by name, the rank and what happens to it."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pgccd import sim
from pgccd.checkpoint import files
from pgccd.distributed import connect
from pgccd.distributed.guard import guard, hub
from pgccd.sim import Simulation, run

CONFIG = sim.ModelConfig(robots=60, pattern="skewed", speed=0.25, seed=4)
STEPS, EVERY, STEP = 16, 3, 7
TIMEOUT = 2.0


def _die(*_: Any, **__: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _stop() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def _hang() -> None:
    threading.Event().wait()


def _interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def _fail() -> None:
    raise MemoryError("tried to allocate more than there is")


def _die_in_writing() -> None:
    files.write_tables = _die  # type: ignore[assignment]


def _die_before_publishing() -> None:
    files.os.replace = _die  # type: ignore[assignment]


def _write_elsewhere() -> None:
    write = files.write_tables

    def elsewhere(folder: Path, rank: int, tables: Any) -> files.FileEntry:
        entry = write(folder, rank, tables)
        (folder / entry.name).unlink()
        return entry

    files.write_tables = elsewhere  # type: ignore[assignment]


def _fill_disk() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))


def _lose_launcher() -> None:
    guard.os.getppid = lambda: 1  # type: ignore[assignment]
    time.sleep(20.0)


def _break_hub() -> None:
    hub.Hub._drop_strangers = _fail_always  # type: ignore[method-assign]


def _fail_always(*_: Any) -> None:
    raise MemoryError("tried to allocate more than there is")


def _jump() -> None:
    """The wall clock jumps back and forth by years: nothing may depend on it."""
    signs = itertools.cycle([1.0, -1.0])
    time.time = lambda: 1e9 * next(signs)  # type: ignore[assignment]


#: The rank, None for all, and what happens to it in step `STEP`.
FAULTS: dict[str, tuple[int | None, Callable[[], None]]] = {
    "a rank is killed": (1, _die),
    "rank 0 is killed": (0, _die),
    "a rank is killed while it writes": (1, _die_in_writing),
    "rank 0 is killed before it publishes": (0, _die_before_publishing),
    "a rank writes elsewhere": (1, _write_elsewhere),
    "the disk of a rank is full": (1, _fill_disk),
    "a rank fails": (2, _fail),
    "a rank hangs": (1, _hang),
    "a rank is stopped": (2, _stop),
    "rank 0 is stopped": (0, _stop),
    "a rank is interrupted": (1, _interrupt),
    "a rank loses its launcher": (2, _lose_launcher),
    "the hub fails": (0, _break_hub),
    "all are suspended": (None, _stop),
    "clocks jump": (None, _jump),
}


def job(fault: str, folder: str) -> None:
    """The run on this rank."""
    guard._GRACE_SECONDS, guard._VERDICT_SECONDS = 1.0, 4.0  # type: ignore[attr-defined]
    hub._ANSWER_SECONDS, hub._SECOND_LOOK_SECONDS = 1.0, 0.2
    files._SEEN_WITHIN = 0.5
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    which, happens = FAULTS[fault]
    if fault == "a rank loses its launcher":
        os.environ["TORCHELASTIC_RUN_ID"] = "run"
    step = Simulation.step

    def faulty(self: Simulation, index: int, *rest: Any) -> Any:
        if index == STEP and which in (None, self.comm.rank):
            happens()
        return step(self, index, *rest)

    Simulation.step = faulty  # type: ignore[method-assign]
    with connect("cpu", "gloo", timeout=TIMEOUT) as comm:
        run(CONFIG, STEPS, folder, checkpoint_every=EVERY, comm=comm)


def undisturbed_job(folder: str, steps: int) -> None:
    """The run on this rank, without a fault."""
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    with connect("cpu", "gloo", timeout=120.0) as comm:
        run(CONFIG, steps, folder, comm=comm)
