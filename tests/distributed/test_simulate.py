"""`pgccd simulate` on ranks: the same log, checkpoints for any number of ranks, lost ranks."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from support.forked_job import ForkedJob, command_line, script, torchrun_of_forked
from support.launch import (
    NO_PEER_MEMORY,
    PEER_MEMORY,
    ROOT,
    SUPPORT,
    children,
    environment,
    finish,
    free_port,
    mpirun,
    over_nccl,
    start_ranks,
    torchrun,
    torchrun_options,
)

from pgccd import sim
from pgccd.cli import main

pytestmark = pytest.mark.ranks

WORLD = ["--robots", "150", "--world", "skewed", "--seed", "4", "--no-pictures"]
CONFIG = sim.ModelConfig(robots=150, pattern="skewed", seed=4)
# Options of a run that continues when its ranks are restarted.
AGAIN = ["--checkpoint-every", "8", "--resume", "auto"]
SIMULATE = ["-m", "pgccd", "simulate"]
WHERE = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def log(folder: Path) -> list[dict[str, Any]]:
    left_out = ("seconds", "stage_seconds", "ranks")
    return [{k: v for k, v in record.items() if k not in left_out} for record in sim.read_log(folder)]


def hashes(steps: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Values that are equal on a GPU."""
    return [(step["contacts_hash"], step["state_hash"]) for step in steps]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The log of 64 steps by one process."""
    folder = tmp_path_factory.mktemp("single")
    sim.run(CONFIG, 64, folder)
    return log(folder)


@pytest.mark.slow
def test_torchrun_with_other_numbers_of_ranks(tmp_path: Path, expected: list[dict[str, Any]]) -> None:
    """Saved by 1 rank, resumed by 4 and then by 2."""
    sim.run(CONFIG, 6, tmp_path)
    for ranks, steps in ((4, 14), (2, 24)):
        resume = [*SIMULATE, "--resume", str(tmp_path), "--no-pictures", "--steps", str(steps)]
        done = finish(torchrun(ranks, *resume))
        assert done.returncode == 0, done.stdout
        assert log(tmp_path) == expected[:steps]


@pytest.mark.cuda
def test_nccl_does_the_same(tmp_path: Path, expected: list[dict[str, Any]]) -> None:
    arguments = [*WORLD, "--device", "cuda", "--transport", "nccl", "--checkpoint-every", "7", "--out", str(tmp_path)]
    done = finish(torchrun(4, *over_nccl(4, *SIMULATE, *arguments, "--steps", "20")))
    assert done.returncode == 0, done.stdout
    assert hashes(log(tmp_path)) == hashes(expected[:20])


@pytest.mark.parametrize("where", ["forked", pytest.param("cpu", marks=pytest.mark.slow), WHERE[1]])
def test_a_scene_of_one_s_own_under_torchrun(where: str, tmp_path: Path) -> None:
    job = [str(SUPPORT / "world_job.py"), "cpu" if where == "forked" else where]
    job += ["on corners of many cells", "faster than cells", "a terrain under all"]
    if where == "forked":
        with ForkedJob(2, tmp_path, script, *job) as started:
            assert started.finish() == [0, 0], started.said
    else:
        done = finish(torchrun(2, *job))
        assert done.returncode == 0, done.stdout


@pytest.mark.cuda
@pytest.mark.parametrize("what", ["scenes", "robots"])
@pytest.mark.parametrize(
    ("ranks", "steps", "peers"),
    [
        (2, 24, False),
        (4, 24, False),
        # Kernels of ranks that share a GPU wait for each other by turns.
        pytest.param(2, 24, True, marks=pytest.mark.slow),
        pytest.param(4, 200, False, marks=pytest.mark.slow),
    ],
)
def test_everything_over_nccl(what: str, ranks: int, steps: int, peers: bool) -> None:
    job = [str(SUPPORT / "nccl_job.py"), what, str(steps), *["peers"] * peers]
    done = finish(torchrun(ranks, *over_nccl(ranks, *job)), **(PEER_MEMORY if peers else NO_PEER_MEMORY))
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_mpirun_does_the_same(tmp_path: Path, expected: list[dict[str, Any]]) -> None:
    sim.run(CONFIG, 6, tmp_path)
    steps = ["--resume", str(tmp_path), "--steps", "14", "--transport", "mpi4py", "--no-pictures"]
    done = finish(mpirun(3, *SIMULATE, *steps))
    assert done.returncode == 0, done.stdout
    assert log(tmp_path) == expected[:14]


@pytest.mark.slow
def test_everything_over_mpi(tmp_path: Path) -> None:
    done = finish(mpirun(3, str(SUPPORT / "mpi_job.py"), str(tmp_path)))
    assert done.returncode == 0, done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rank-0", "rank-1", "rank-2"]


@pytest.mark.parametrize("where", WHERE)
def test_torchrun_starts_all_again_and_one_process_continues(
    where: str, tmp_path: Path, expected: list[dict[str, Any]]
) -> None:
    program = ["simulate", *WORLD, "--steps", "60", *AGAIN, "--out", str(tmp_path)]
    if where == "cuda":
        program = over_nccl(2, "-m", "pgccd", *program, "--device", "cuda", "--transport", "nccl")
        process = subprocess.Popen(
            torchrun(2, "--max-restarts", "2", *program),
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        wait_for_checkpoint(tmp_path, [process])
        killed = kill_last_child(process.pid)
        output, _ = process.communicate(timeout=180)
        code = process.returncode
    else:
        options = [*torchrun_options(2), "--max-restarts", "2"]
        with ForkedJob(1, tmp_path / "said", torchrun_of_forked, options, *program) as job:
            wait_for_checkpoint(tmp_path, [])
            killed = kill_last_child(job.processes[0].pid or 0)
            (code,), output = job.finish(180.0), job.said
    assert code == 0, output
    # Torchrun logs the first rank that it finds ended: the killed one, or the other one if its guard was faster.
    signs = "Signal 9 (SIGKILL)", "exitcode: -9", f"rank 1 (process {killed} on {os.uname().nodename}) has died"
    assert any(sign in output for sign in signs), output
    assert "without a CUDA graph" not in output, output
    last_line = output.strip().splitlines()[-1]
    assert re.fullmatch(r"robots=150 steps=60 pcs=\d+ contacts=\d+ seconds_per_step=\d+\.\d+", last_line), output
    assert len(sim.read_log(tmp_path)[-1]["ranks"]["pcs"]) == 2
    # Saved by 2 ranks, resumed by one process without a launcher.
    assert main(["simulate", "--resume", str(tmp_path), "--no-pictures", "--steps", "64"]) == 0
    assert hashes(log(tmp_path)) == hashes(expected)
    if where == "cpu":
        assert log(tmp_path) == expected


def kill_last_child(process: int) -> int:
    killed = children(process)[-1]
    os.kill(killed, signal.SIGKILL)
    return killed


def wait_for_checkpoint(folder: Path, processes: list[subprocess.Popen[str]]) -> None:
    deadline = time.monotonic() + 100
    while not (folder / "checkpoints" / "newest.json").exists():
        if time.monotonic() > deadline or any(process.poll() is not None for process in processes):
            for process in processes:
                process.terminate()
            raise AssertionError([process.communicate(timeout=60)[0] for process in processes])
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("who_keeps_the_store", ["agent", "rank"])
def test_of_two_machines_one_loses_its_rank(
    who_keeps_the_store: str, tmp_path: Path, expected: list[dict[str, Any]]
) -> None:
    """One torchrun agent counts a restart, the other does not."""
    variables = environment(TORCH_DISABLE_SHARE_RDZV_TCP_STORE="0" if who_keeps_the_store == "agent" else "1")
    meeting = ["--nnodes", "2", "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{free_port()}"]
    program = [*SIMULATE, *WORLD, "--steps", "60", *AGAIN, "--out", str(tmp_path)]
    command = torchrun(1, *meeting, "--rdzv-id", "two", "--max-restarts", "2", *program)
    agents = [
        subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT)
        for _ in range(2)
    ]
    wait_for_checkpoint(tmp_path, agents)
    os.kill(children(agents[1].pid)[-1], signal.SIGKILL)
    outputs = [agent.communicate(timeout=180)[0] for agent in agents]
    assert [agent.returncode for agent in agents] == [0, 0], outputs
    assert "exitcode: -9" in outputs[1], "no rank was killed"
    assert log(tmp_path) == expected[:60]


def test_a_signal_to_one_rank_stops_all_after_the_same_step(tmp_path: Path, expected: list[dict[str, Any]]) -> None:
    out = tmp_path / "run"
    with ForkedJob(2, tmp_path / "said", command_line, "simulate", *WORLD, "--steps", "9000", "--out", str(out)) as job:
        deadline = time.monotonic() + 100
        while not out.exists() or len(sim.read_log(out)) < 3:
            assert all(process.is_alive() for process in job.processes) and time.monotonic() < deadline, job.said
            time.sleep(0.02)
        os.kill(job.processes[1].pid or 0, signal.SIGINT)
        assert job.finish() == [130] * 2, job.said
    made = len(log(out))
    assert "to continue: pgccd simulate --resume" in job.said
    assert main(["simulate", "--resume", str(out), "--no-pictures", "--steps", str(made + 1)]) == 0
    compared = min(made + 1, len(expected))
    assert log(out)[:compared] == expected[:compared]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    ("fault", "timeout", "said"),
    [
        ("dies", 120.0, "rank 1 (process {pid} on {host}) has died"),
        pytest.param("hangs", 25.0, "rank 1 (process {pid} on {host}) hangs in step 2", marks=pytest.mark.slow),
        pytest.param("stops", 25.0, "rank 1 (process {pid} on {host}) does not answer", marks=pytest.mark.slow),
        pytest.param(
            "memory",
            120.0,
            "rank 1 (process {pid} on {host}) failed in step 2: OutOfMemoryError: tried to allocate",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_lost_rank_ends_all_and_is_named(fault: str, timeout: float, said: str, where: str, tmp_path: Path) -> None:
    """A hanging rank is detected after the time-out, which tolerates a busy machine; other losses much earlier."""
    program = [str(SUPPORT / "faulty_rank.py"), fault, where, str(timeout)]
    if where == "cpu":
        with ForkedJob(3, tmp_path, script, *program) as job:
            begin = time.monotonic()
            for rank in (0, 2):
                job.processes[rank].join(180.0)
            assert fault in ("hangs", "stops") or time.monotonic() - begin < timeout, job.said
            processes, outputs = [process.pid for process in job.processes], [job.said_by(rank) for rank in (0, 2)]
        codes = [process.exitcode for process in job.processes]
    else:
        started = start_ranks(3, over_nccl(3, *program))
        begin = time.monotonic()
        outputs = [started[rank].communicate(timeout=180)[0] for rank in (0, 2)]
        assert fault in ("hangs", "stops") or time.monotonic() - begin < timeout, outputs
        started[1].kill()  # the stopped rank
        started[1].communicate()
        processes, codes = [process.pid for process in started], [process.returncode for process in started]
    assert 0 not in codes and None not in codes
    message = said.format(pid=processes[1], host=os.uname().nodename)
    for output in outputs:
        assert message in output, outputs


def test_a_busy_interpreter_is_waited_for(tmp_path: Path) -> None:
    with ForkedJob(3, tmp_path, script, str(SUPPORT / "faulty_rank.py"), "busy", "cpu", "60") as job:
        assert job.finish() == [0, 0, 0] and job.said == "", job.said


def with_another_number(out: str) -> int:
    return command_line("simulate", "--robots", str(100 + int(os.environ["RANK"])), "--steps", "3", "--out", out)


def test_ranks_started_with_different_things_all_fail_at_once(tmp_path: Path) -> None:
    with ForkedJob(2, tmp_path / "said", with_another_number, str(tmp_path / "run")) as job:
        assert job.finish() == [2, 2], job.said
    assert "pgccd simulate: error: --robots: rank 0 has 100, rank 1 has 101" in job.said, job.said
    assert not (tmp_path / "run" / "steps.jsonl").exists()
