"""Failures of a job: a one-line message, an exit code, and no loss of data.

docs/reference/faults.md has the table.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.launch import ROOT, SUPPORT, children, environment, finish, mpirun, start_ranks, torchrun

from distributed.test_simulate import AGAIN, SIMULATE, WORLD, hashes, log, wait_for_checkpoint
from pgccd import sim

pytestmark = [pytest.mark.ranks, pytest.mark.slow]
LAUNCHERS = ["torchrun", "mpirun"]
STEPS = 60
RANK = {"torchrun": "$RANK", "mpirun": "${PMI_RANK:-$OMPI_COMM_WORLD_RANK}"}


def command(launcher: str, program: list[str], before: str = "") -> list[str]:
    """The command for two ranks of a program; `before`: shell commands run by each rank first."""
    if not before:
        return torchrun(2, *program) if launcher == "torchrun" else mpirun(2, *program)
    shell = f"rank={RANK[launcher]}; {before}; exec {shlex.join([sys.executable, *program])}"
    if launcher == "torchrun":
        return torchrun(2, "--no-python", "bash", "-c", shell)
    whole = mpirun(2, "-c", shell)
    whole[whole.index(sys.executable, len(whole) - 3)] = "bash"
    return whole


def start(launcher: str, folder: Path, *more: str) -> subprocess.Popen[str]:
    """Starts a job and waits for its first checkpoint."""
    program = [*SIMULATE, *WORLD, "--steps", "4000", *AGAIN, "--out", str(folder), *more]
    process = subprocess.Popen(
        command(launcher, program),
        env=environment(),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    wait_for_checkpoint(folder, [process])
    return process


def descendants(process: int) -> list[int]:
    """Ids of all processes below a process."""
    found = children(process)
    return found + [one for child in found for one in descendants(child)]


def ranks_of(process: subprocess.Popen[str]) -> list[int]:
    """The processes of the ranks, in the order in which they were started."""
    found, below = [], [process.pid]
    while below:
        below = [child for parent in below for child in children(parent)]
        for one in below:
            words = Path(f"/proc/{one}/cmdline").read_bytes().decode().split("\0")
            is_python = Path(words[0]).name.startswith("python")
            if is_python and "simulate" in words and "torch.distributed.run" not in words:
                found.append(one)
    return sorted(found)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """The hashes of the first steps."""
    folder = tmp_path_factory.mktemp("alone")
    sim.run(sim.ModelConfig(robots=150, pattern="skewed", seed=4), STEPS, folder)
    return hashes(log(folder))


def require_intact(folder: Path, expected: list[Any]) -> None:
    """The run can be resumed, and its log is correct."""
    made = sim.load_checkpoint(folder).steps_made
    assert made >= 8
    sim.resume(folder, made + 2)
    found = hashes(log(folder))
    assert len(found) == made + 2
    assert found[:STEPS] == expected[: len(found)]


def kill_rank(process: subprocess.Popen[str]) -> None:
    os.kill(ranks_of(process)[-1], signal.SIGKILL)


def terminate(process: subprocess.Popen[str]) -> None:
    process.terminate()


def interrupt(process: subprocess.Popen[str]) -> None:
    """Ctrl-C: sends SIGINT to all processes in the foreground."""
    os.killpg(process.pid, signal.SIGINT)


@pytest.mark.parametrize("launcher", LAUNCHERS)
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (kill_rank, r"pgccd: rank \d \(process \d+ on \S+\) has died"),
        (terminate, r"interrupted; to continue: pgccd simulate --resume|[Ss]ignal|death signal"),
        (interrupt, r"interrupted; to continue: pgccd simulate --resume|[Ss]ignal|Ctrl-C"),
    ],
)
def test_ends_of_a_job(
    launcher: str, fault: Callable[[subprocess.Popen[str]], None], said: str, tmp_path: Path, expected: list[Any]
) -> None:
    process = start(launcher, tmp_path)
    fault(process)
    output, _ = process.communicate(timeout=120)
    assert process.returncode != 0
    assert re.search(said, output), output
    require_intact(tmp_path, expected)


def test_without_their_agent_ranks_end(tmp_path: Path, expected: list[Any]) -> None:
    process = start("torchrun", tmp_path)
    ranks = ranks_of(process)
    assert len(ranks) == 2
    process.kill()
    output = process.stdout.read()  # type: ignore[union-attr]  # until the ranks have ended too
    process.wait()
    assert re.search(r"rank \d .*has lost the process that launched it", output), output
    require_intact(tmp_path, expected)


@pytest.mark.parametrize("launcher", LAUNCHERS)
@pytest.mark.parametrize("which", [0, -1])
def test_a_stopped_rank_is_named(launcher: str, which: int, tmp_path: Path, expected: list[Any]) -> None:
    process = start(launcher, tmp_path, "--timeout", "8")
    stopped = ranks_of(process)[which]
    os.kill(stopped, signal.SIGSTOP)
    try:
        for line in process.stdout:  # type: ignore[union-attr]
            if "does not answer: stopped, or busy" in line:
                break
        else:
            raise AssertionError("nothing was said")
        assert f"process {stopped} on" in line
    finally:
        os.kill(stopped, signal.SIGKILL)
        process.communicate(timeout=120)
    require_intact(tmp_path, expected)


@pytest.mark.parametrize(("launcher", "transport"), [("torchrun", "gloo"), ("mpirun", "gloo"), ("mpirun", "mpi4py")])
@pytest.mark.parametrize("who", ["all", "ranks", "one"])
def test_a_suspended_job_goes_on(launcher: str, transport: str, who: str, tmp_path: Path, expected: list[Any]) -> None:
    """For longer than the time-out, as by `scontrol suspend`; one rank alone, for less than it."""
    process = start(launcher, tmp_path, "--timeout", "6", "--transport", transport)
    stopped = [process.pid, *descendants(process.pid)] if who == "all" else ranks_of(process)
    stopped = stopped[-1:] if who == "one" else stopped
    for one in stopped:
        os.kill(one, signal.SIGSTOP)
    time.sleep(4.0 if who == "one" else 14.0)
    for one in stopped:
        os.kill(one, signal.SIGCONT)
        time.sleep(0.1)
    made = len(sim.read_log(tmp_path))
    deadline = time.monotonic() + 60.0
    while len(sim.read_log(tmp_path)) < made + 20:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate(timeout=60)[0]
        time.sleep(0.1)
    terminate(process)
    output, _ = process.communicate(timeout=120)
    assert "pgccd: rank" not in output, output
    require_intact(tmp_path, expected)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_two_jobs_in_a_folder(launcher: str, tmp_path: Path, expected: list[Any]) -> None:
    process = start(launcher, tmp_path)
    second = finish(command(launcher, [*SIMULATE, "--resume", str(tmp_path), "--steps", "9", "--no-pictures"]))
    assert second.returncode != 0
    assert re.search(r"pgccd simulate: error: .*another", second.stdout), second.stdout
    terminate(process)
    process.communicate(timeout=120)
    require_intact(tmp_path, expected)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_folder_that_is_not_shared(launcher: str, tmp_path: Path) -> None:
    before = f"mkdir -p {tmp_path}/$rank; cd {tmp_path}/$rank"
    program = [*SIMULATE, *WORLD, "--steps", "9", "--checkpoint-every", "4", "--out", "run"]
    done = finish(command(launcher, program, before))
    assert done.returncode != 0
    assert re.search(r"pgccd simulate: error: .*rank 1.*", done.stdout), done.stdout
    assert not list(tmp_path.rglob("checkpoints"))


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_full_disk(launcher: str, tmp_path: Path) -> None:
    """The disk of rank 1 is full. The file of rank 0 alone is no checkpoint."""
    job = [str(SUPPORT / "full_disk.py"), "simulate", *WORLD, "--checkpoint-every", "8", "--steps", "40"]
    done = finish(command(launcher, [*job, "--out", str(tmp_path)]))
    assert done.returncode != 0
    said = r"pgccd simulate: error: argument --out: .*rank-00001.safetensors cannot be written: .*File too large"
    assert len(re.findall(said, done.stdout)) == 1 and "pgccd: rank" not in done.stdout, done.stdout
    assert str(ROOT / "pgccd") not in done.stdout, done.stdout  # no traceback of pgccd
    assert not (tmp_path / "checkpoints" / "newest.json").exists()


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_folder_that_cannot_be_written(launcher: str, tmp_path: Path) -> None:
    program = [*SIMULATE, *WORLD, "--steps", "9", "--out", "/proc/run"]
    done = finish(command(launcher, program))
    assert done.returncode != 0
    assert re.search(r"pgccd simulate: error: .*/proc/run", done.stdout), done.stdout


@pytest.mark.parametrize("what", ["the folder", "its checkpoints"])
def test_a_read_only_folder(what: str, tmp_path: Path) -> None:
    """A run goes on only if it could write a checkpoint; permissions do not bind root, a read-only mount does."""
    sim.run(sim.ModelConfig(robots=30, seed=4), 3, tmp_path / "run")
    mounted = tmp_path / "run"
    if what == "its checkpoints":  # on another disk
        mounted = (tmp_path / "run" / "checkpoints").rename(tmp_path / "disk")
        (tmp_path / "run" / "checkpoints").symlink_to(mounted)
    mount = f"mount --bind {mounted} {mounted} && mount -o remount,ro,bind {mounted}"
    if subprocess.run(["unshare", "--mount", "sh", "-c", mount], capture_output=True).returncode:
        pytest.skip("no mounts")
    program = torchrun(2, *SIMULATE, "--resume", str(tmp_path / "run"), "--steps", "5", "--no-pictures")
    done = finish(["unshare", "--mount", "sh", "-c", f"{mount} && exec {shlex.join(program)}"])
    assert done.returncode != 0
    assert len(re.findall("pgccd simulate: error: .*: Read-only file system", done.stdout)) == 1, done.stdout
    assert len(sim.read_log(tmp_path / "run")) == 3


@pytest.mark.parametrize("started_by", ["torchrun", "srun"])
def test_other_machines_cannot_connect(started_by: str) -> None:
    """With all ranks on one machine. Under mpirun the MPI library itself listens on all interfaces."""
    job = str(SUPPORT / "listening_job.py")
    if started_by == "srun":
        of_srun = {"SLURM_STEP_NUM_NODES": "1", "SLURM_JOB_ID": str(os.getpid()), "SLURM_STEP_NODELIST": "nowhere"}
        ranks = [
            subprocess.Popen(
                [sys.executable, job],
                env=environment(**of_srun, SLURM_PROCID=str(rank), SLURM_STEP_NUM_TASKS="2", SLURM_LOCALID=str(rank)),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for rank in range(2)
        ]
        output = "".join(process.communicate(timeout=100)[0] for process in ranks)
    else:
        output = finish(command(started_by, [job])).stdout
    assert re.findall(r"listens: (.*)", output) == ["['0100007F']"] * 2, output


def test_a_busy_interpreter_of_a_minute() -> None:
    program = [str(SUPPORT / "faulty_rank.py"), "busy", "cpu", "120", "60"]
    started = start_ranks(3, program)
    begin = time.monotonic()
    outputs = [process.communicate(timeout=180)[0] for process in started]
    assert time.monotonic() - begin > 60.0
    assert [process.returncode for process in started] == [0, 0, 0], outputs
    assert outputs == [""] * 3
