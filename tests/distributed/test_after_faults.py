"""After each fault the run continues on another number of ranks, to the same result."""

from __future__ import annotations

import itertools
import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.cases import mostly_slow
from support.faulty_run import CONFIG, EVERY, FAULTS, STEP, STEPS, TIMEOUT, job, undisturbed_job
from support.forked_job import ForkedJob

import pgccd
from pgccd import sim
from pgccd.distributed import Comm
from pgccd.sim import resume

RANKS = 3
DIED = r"pgccd: rank \d \(process \d+ on \S+\) has died"
#: What is said of each fault; nothing of those that do not end the run.
SAID = {
    "a rank is killed": DIED,
    "rank 0 is killed": r"RankFailureError: rank 0 \(process \d+ on \S+\) has died",
    "a rank is killed while it writes": DIED,
    "rank 0 is killed before it publishes": r"rank 0 \(process \d+ on \S+\) has died",
    "a rank writes elsewhere": r"rank-00001.safetensors, which rank 1 has written, is not seen by rank 0",
    "the disk of a rank is full": r"rank-00001.safetensors cannot be written: .*File too large",
    "a rank fails": rf"pgccd: rank 2 \(.*\) failed in step {STEP - 1}: MemoryError: tried to allocate",
    "a rank hangs": rf"pgccd: rank 1 \(.*\) hangs in step {STEP - 1}",
    "a rank is stopped": r"pgccd: rank 2 \(.*\) does not answer: stopped, or busy",
    "rank 0 is stopped": r"rank 0 \(.*\) does not answer: stopped, or busy",
    "a rank loses its launcher": r"pgccd: rank 2 \(.*\) has lost the process that launched it",
}
GO_ON = {"the hub fails": "pgccd: the hub of the guard, on rank 0, has failed", "all are suspended": "^$"}
GO_ON |= {"clocks jump": "^$", "a rank is interrupted": "^$"}


#: Faults of every run, and the number of ranks that continues.
QUICK = [("a rank is killed while it writes", 2), ("a rank fails", 4), ("clocks jump", 2)]


def hashes(folder: Path) -> list[tuple[str, str]]:
    return [(step["contacts_hash"], step["state_hash"]) for step in sim.read_log(folder)]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """Of a run that nothing disturbs."""
    folder = tmp_path_factory.mktemp("undisturbed")
    sim.run(CONFIG, STEPS, folder)
    return hashes(folder)


def go_on(comm: Comm, folder: str) -> int:
    return resume(folder, comm=comm).steps_made


@pytest.mark.parametrize(("fault", "size"), mostly_slow(itertools.product(FAULTS, (2, 4)), QUICK))
def test_another_number_of_ranks_continues(
    fault: str, size: int, ranks: Any, tmp_path: Path, expected: list[Any]
) -> None:
    folder = tmp_path / "run"
    with ForkedJob(RANKS, tmp_path / "said", job, fault, str(folder)) as started:
        if fault == "all are suspended":
            continue_all(started)
        if "stopped" in fault:
            kill_the_stopped(started, SAID[fault])
        codes, said = started.finish(60.0), started.said
    assert re.search((SAID | GO_ON)[fault], said), said
    assert None not in codes and (codes == [0] * RANKS) == (fault in GO_ON), (codes, said)
    made = sim.load_checkpoint(folder).steps_made
    # The last checkpoint before the fault may not have been complete.
    assert STEP < made <= STEPS if fault in GO_ON else made in (EVERY, 2 * EVERY)
    assert ranks.run(size, go_on, str(folder)) == [STEPS] * size
    assert hashes(folder) == expected


@pytest.mark.slow
def test_64_ranks(tmp_path: Path, expected: list[Any]) -> None:
    with ForkedJob(64, tmp_path / "said", undisturbed_job, str(tmp_path / "run"), 9) as started:
        assert started.finish(240.0) == [0] * 64, started.said
    assert hashes(tmp_path / "run") == expected[:9] and started.said == ""


def test_nothing_depends_on_the_wall_clock() -> None:
    """Which jumps when it is set: only the name of a lock's holder tells it."""
    of_clock = re.compile(r"time\.time\(|datetime\.now|utcnow|time_ns\(|localtime|gmtime|strftime|CLOCK_REALTIME")
    package = Path(pgccd.__file__).parent
    users = [path.relative_to(package) for path in package.rglob("*.py") if of_clock.search(path.read_text())]
    assert users == [Path("checkpoint", "lock.py")]


def states(job: ForkedJob) -> list[str]:
    """Of the processes, as Linux calls them: T is stopped; empty for those that have ended."""
    found = []
    for process in job.processes:
        try:
            found.append(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0])
        except OSError:
            found.append("")
    return found


def wait_for(is_so: Callable[[], object], job: ForkedJob) -> None:
    deadline = time.monotonic() + 60.0
    while not is_so():
        assert time.monotonic() < deadline, (states(job), job.said)
        time.sleep(0.05)


def continue_all(job: ForkedJob) -> None:
    """All ranks have stopped themselves: for longer than the time-out."""
    wait_for(lambda: states(job) == ["T"] * RANKS, job)
    time.sleep(TIMEOUT + 1.5)
    for process in job.processes:
        os.kill(process.pid or 0, signal.SIGCONT)


def kill_the_stopped(job: ForkedJob, said: str) -> None:
    """Once the others have named it."""
    wait_for(lambda: re.search(said, job.said), job)
    os.kill(job.processes[states(job).index("T")].pid or 0, signal.SIGKILL)
