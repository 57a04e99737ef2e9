"""Machines that join and leave a job: torchrun agents with one rank each, all on this machine."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.launch import ROOT, children, environment, free_port, torchrun

from pgccd import sim

pytestmark = pytest.mark.ranks

ROBOTS, STEPS = 150, 4000


def hashes(folder: Path) -> list[tuple[str, str]]:
    return [(step["contacts_hash"], step["state_hash"]) for step in sim.read_log(folder)]


def ranks_of(step: dict[str, Any]) -> int:
    return len(step["ranks"]["pcs"]) if "ranks" in step else 1


@pytest.mark.slow
def test_a_machine_joins_and_another_is_lost(tmp_path: Path) -> None:
    """The run continues with one rank, then two, then one again."""
    meeting = ["--nnodes", "1:2", "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{free_port()}"]
    meeting += ["--rdzv-id", "some", "--max-restarts", "2"]
    meeting += ["--rdzv-conf", "last_call_timeout=1,keep_alive_interval=1,keep_alive_max_attempt=3"]
    out = tmp_path / "spread"
    program = ["-m", "pgccd", "simulate", "--robots", str(ROBOTS), "--seed", "4", "--steps", str(STEPS)]
    program += ["--no-pictures", "--checkpoint-every", "20", "--timeout", "20", "--out", str(out), "--resume", "auto"]
    command = torchrun(1, *meeting, *program)
    # Otherwise torch's agents deadlock when one joins.
    variables = environment(TORCH_DISABLE_SHARE_RDZV_TCP_STORE="1")
    started: list[subprocess.Popen[str]] = []

    def start_agent() -> None:
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        started.append(subprocess.Popen(command, env=variables, cwd=ROOT, **pipes))

    def wait_for(reached: Callable[[list[dict[str, Any]]], bool]) -> None:
        deadline = time.monotonic() + 100
        while not (out.exists() and reached(sim.read_log(out))):
            alive = all(agent.poll() is None for agent in started)
            assert alive and time.monotonic() < deadline, [agent.communicate(timeout=10)[0] for agent in started]
            time.sleep(0.1)

    try:
        start_agent()
        wait_for(lambda steps: len(steps) > 100)
        start_agent()
        wait_for(lambda steps: sum(ranks_of(step) == 2 for step in steps) > 100)
        for process in [started[1].pid, *children(started[1].pid)]:  # the agent, then its rank
            os.kill(process, signal.SIGKILL)
        output, _ = started[0].communicate(timeout=200)
    finally:
        for agent in started:
            if agent.poll() is None:
                agent.kill()
    assert started[0].returncode == 0, output
    counts = [count for count, _ in itertools.groupby(sim.read_log(out), ranks_of)]
    assert counts == [1, 2, 1]
    sim.run(sim.ModelConfig(robots=ROBOTS, seed=4), STEPS, tmp_path / "alone")
    assert hashes(out) == hashes(tmp_path / "alone")
