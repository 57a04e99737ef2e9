"""Machines that join a job and leave it: agents of torchrun, each with a rank, all on this machine."""

from __future__ import annotations

import argparse
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
from pgccd.distributed import Alone
from pgccd.distributed.launch import agents
from pgccd.distributed.launch.agents import AGENTS_FILE, agent_name, have_agents_here, note_agents
from pgccd.sim.distributed import command

pytestmark = pytest.mark.ranks

ROBOTS, STEPS = 150, 4000


def hashes(folder: Path) -> list[tuple[str, str]]:
    return [(step["contacts_hash"], step["state_hash"]) for step in sim.read_log(folder)]


def ranks_of(step: dict[str, Any]) -> int:
    return len(step["ranks"]["pcs"]) if "ranks" in step else 1


@pytest.mark.slow
def test_a_machine_joins_and_another_is_lost(tmp_path: Path) -> None:
    """The ranks go on from where they were, one first, then two, then one again."""
    meeting = ["--nnodes", "1:2", "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{free_port()}"]
    meeting += ["--rdzv-id", "some", "--max-restarts", "2"]
    meeting += ["--rdzv-conf", "last_call_timeout=1,keep_alive_interval=1,keep_alive_max_attempt=3"]
    out = tmp_path / "spread"
    program = ["-m", "pgccd", "simulate", "--robots", str(ROBOTS), "--seed", "4", "--steps", str(STEPS)]
    program += ["--no-pictures", "--checkpoint-every", "20", "--timeout", "20", "--out", str(out)]
    command = torchrun(1, *meeting, *program)
    # Else torch's agents wait for one another without end when one joins.
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


def test_runs_are_known_by_their_agents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    comm, variable = Alone(), "TORCHELASTIC_RUN_ID"
    monkeypatch.delenv(variable, raising=False)
    note_agents(comm, tmp_path)
    assert agent_name() is None and have_agents_here(comm, tmp_path) is None and not any(tmp_path.iterdir())
    monkeypatch.setenv(variable, "run 7")
    name = agent_name()
    assert name is not None and name == agent_name()
    assert not have_agents_here(comm, tmp_path)
    note_agents(comm, tmp_path)
    assert have_agents_here(comm, tmp_path) and [path.name for path in tmp_path.iterdir()] == [AGENTS_FILE]
    # Another run, and another process with the same number as the agent had.
    monkeypatch.setenv(variable, "run 8")
    assert not have_agents_here(comm, tmp_path)
    monkeypatch.setenv(variable, "run 7")
    monkeypatch.setattr(agents.Path, "read_text", lambda path: f"1 (a b) c) {' '.join(map(str, range(30)))}")
    name = agent_name()
    assert name is not None and name.endswith(f": {os.getppid()}, 19")


def test_another_run_s_checkpoint_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even by ranks that were started again, since those before failed before they had begun theirs."""
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run 7")
    options, comm = argparse.Namespace(resume=None), Alone()
    comm.restarted = True
    sim.run(sim.ModelConfig(robots=20), 2, tmp_path)
    assert command.folder_to_resume(comm, options, tmp_path) is None
    command.begin_run(comm, tmp_path)
    assert command.folder_to_resume(comm, options, tmp_path) is None
    sim.run(sim.ModelConfig(robots=20), 2, tmp_path)
    assert command.folder_to_resume(comm, options, tmp_path) == tmp_path
    # No restart was counted: a machine has joined; but the run is over.
    comm.restarted = False
    assert command.folder_to_resume(comm, options, tmp_path) is None
    # Where no rank knows its agent, the count of restarts decides.
    monkeypatch.delenv("TORCHELASTIC_RUN_ID")
    assert command.folder_to_resume(comm, options, tmp_path) is None
    comm.restarted = True
    assert command.folder_to_resume(comm, options, tmp_path) == tmp_path
