"""Ranks started with different settings all end at once, with a one-line error that names the setting."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch.distributed as dist
from support.launch import finish, mpirun, torchrun

from pgccd.distributed.launch import agreement
from pgccd.distributed.launch.agreement import PROBLEM, DisagreementError, agree_by_store
from pgccd.distributed.launch.placement import Placement

SETTINGS = {"--robots": "100", "--seed": "1", "device": "cpu"}


def compare(of_ranks: list[dict[str, str]], timeout: float = 20.0) -> list[str]:
    """The error of each rank; empty if there is none."""
    store = dist.HashStore()

    def of_rank(rank: int) -> str:
        try:
            agree_by_store(store, Placement("torchrun", rank, len(of_ranks), 0), of_ranks[rank], timeout)
        except DisagreementError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(len(of_ranks)) as threads:
        return list(threads.map(of_rank, range(len(of_ranks))))


def test_equal_settings_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agreement, "_KEYS_AT_A_TIME", 2)
    assert compare([SETTINGS] * 5) == [""] * 5


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("odd", [0, 1, 4])
def test_the_setting_and_two_ranks_are_named(name: str, odd: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agreement, "_KEYS_AT_A_TIME", 2)
    of_ranks = [SETTINGS | ({name: "other"} if rank == odd else {}) for rank in range(5)]
    first, other = of_ranks[0][name], of_ranks[odd or 1][name]
    assert compare(of_ranks) == [f"{name}: rank 0 has {first}, rank {odd or 1} has {other}"] * 5


def test_a_setting_that_one_rank_lacks() -> None:
    assert compare([SETTINGS, {"device": "cpu"}]) == ["--robots: rank 0 has 100, rank 1 has nothing"] * 2


def test_the_problem_of_one_rank_ends_all() -> None:
    of_ranks = [SETTINGS, SETTINGS, {PROBLEM: "argument --steps: no number"}]
    assert compare(of_ranks) == ["rank 2: argument --steps: no number"] * 3


def test_ranks_that_do_not_come_are_named() -> None:
    with pytest.raises(RuntimeError, match=r"^ranks \[1, 2\] of 3 did not connect within 0.2 s$"):
        agree_by_store(dist.HashStore(), Placement("torchrun", 0, 3, 0), SETTINGS, 0.2)


# Options of rank 1, and the error that all ranks print.
OPTIONS = {
    "--robots 0": "rank 1: argument --robots: expected at least 1, got 0",
    "--steps x": "rank 1: argument --steps: invalid int value: 'x'",
    "--seed 5": "--seed: rank 0 has None, rank 1 has 5",
    "--transport mpi4py": "--transport: rank 0 has auto, rank 1 has mpi4py",
    "--timeout 40": "--timeout: rank 0 has 30.0, rank 1 has 40.0",
    "--no-pictures": "--no-pictures: rank 0 has False, rank 1 has True",
    "--resume auto": "--resume: rank 0 has None, rank 1 has auto",
    "--resume elsewhere": "rank 1: argument --robots: not allowed with --resume",
    "--overwrite": "--overwrite: rank 0 has False, rank 1 has True",
    "--device meta": "device: rank 0 has cpu, rank 1 has meta",
    "--device nothing": "rank 1: device: ",
    "--balance none": "--balance: rank 0 has cost, rank 1 has none",
    "--checkpoint-every 3": "--checkpoint-every: rank 0 has 0, rank 1 has 3",
    "--out elsewhere": "--out: rank 0 has None, rank 1 has elsewhere",
    "--unknown": "rank 1: unrecognized arguments: --unknown",
}
OF_EVERY_RUN = {("torchrun", "--robots 0"), ("mpirun", "--seed 5"), ("mpirun", "--steps x")}


@pytest.mark.parametrize(
    ("launcher", "option"),
    [
        pytest.param(launcher, option, marks=[] if (launcher, option) in OF_EVERY_RUN else pytest.mark.slow)
        for launcher in ("torchrun", "mpirun")
        for option in OPTIONS
    ],
)
def test_options_that_differ_between_started_ranks(launcher: str, option: str, tmp_path: Path) -> None:
    variable = "RANK" if launcher == "torchrun" else "{PMI_RANK:-$OMPI_COMM_WORLD_RANK}"
    odd = f'$([ "${variable}" = 1 ] && echo "{option}")'
    shell = f'cd {tmp_path}; exec "$PYTHON" -m pgccd simulate --robots 100 --steps 3 --timeout 30 {odd}'
    begin = time.monotonic()
    if launcher == "torchrun":
        done = finish(torchrun(2, "--no-python", "bash", "-c", shell), PYTHON=sys.executable)
    else:
        command = mpirun(2, "-c", shell)
        command[command.index(sys.executable, len(command) - 3)] = "bash"
        done = finish(command, PYTHON=sys.executable)
    assert done.returncode != 0
    assert f"pgccd simulate: error: {OPTIONS[option]}" in done.stdout, done.stdout
    assert time.monotonic() - begin < 25.0, done.stdout  # before the time-out
    assert not list(tmp_path.rglob("steps.jsonl"))


def test_a_variable_that_is_wrong_on_one_rank_ends_all(tmp_path: Path) -> None:
    wrong = '[ "$RANK" = 1 ] && export PGCCD_PEER_MEMORY=yes'
    shell = f'{wrong}; cd {tmp_path}; exec "$PYTHON" -m pgccd simulate --robots 100 --steps 3 --timeout 30'
    begin = time.monotonic()
    done = finish(torchrun(2, "--no-python", "bash", "-c", shell), PYTHON=sys.executable)
    assert done.returncode != 0 and time.monotonic() - begin < 25.0
    assert "pgccd simulate: error: rank 1: PGCCD_PEER_MEMORY: expected 0 or 1, got 'yes'" in done.stdout, done.stdout
