"""Two hundred steps of the simulator on ranks, over MPI, Gloo and on GPUs: the log of one process on a CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.launch import finish, mpirun, over_nccl, torchrun

from pgccd import sim

pytestmark = [pytest.mark.slow, pytest.mark.ranks]

STEPS = 200
SIMULATE = ["-m", "pgccd", "simulate", "--seed", "5", "--steps", str(STEPS), "--no-pictures"]
# Enough work for every rank, also on a GPU.
ROBOTS = 300

Log = list[dict[str, Any]]


def log(folder: Path) -> Log:
    """Values that do not depend on times and ranks."""
    left_out = ("seconds", "stage_seconds", "ranks")
    return [{name: value for name, value in line.items() if name not in left_out} for line in sim.read_log(folder)]


@pytest.fixture(scope="module", params=sim.PATTERNS)
def single(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Log]:
    """Arguments, and the log of one process."""
    folder = tmp_path_factory.mktemp("single")
    sim.run(sim.ModelConfig(robots=ROBOTS, pattern=request.param, seed=5), STEPS, folder)
    steps = log(folder)
    assert sum(step["contacts"] for step in steps) > 5 * STEPS
    return [*SIMULATE, "--robots", str(ROBOTS), "--world", request.param], steps


#: Partitions and policies.
CUTS = [["--balance", "cost"], ["--balance", "one-cell"], ["--partition", "bisection", "--balance", "cost"]]


@pytest.mark.parametrize("cut", CUTS, ids=["cost", "one cell", "bisection"])
@pytest.mark.parametrize("ranks", [2, 3, 4])
def test_over_mpi(ranks: int, cut: list[str], single: tuple[list[str], Log], tmp_path: Path) -> None:
    arguments, expected = single
    done = finish(mpirun(ranks, *arguments, "--transport", "mpi4py", *cut, "--out", str(tmp_path)))
    assert done.returncode == 0, done.stdout
    assert log(tmp_path) == expected


@pytest.mark.parametrize("cut", CUTS, ids=["cost", "one cell", "bisection"])
@pytest.mark.parametrize("ranks", [2, 3, 5])
def test_over_gloo(ranks: int, cut: list[str], single: tuple[list[str], Log], tmp_path: Path) -> None:
    arguments, expected = single
    done = finish(torchrun(ranks, *arguments, *cut, "--out", str(tmp_path)))
    assert done.returncode == 0, done.stdout
    assert log(tmp_path) == expected


@pytest.mark.cuda
@pytest.mark.parametrize("cut", CUTS, ids=["cost", "one cell", "bisection"])
@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_on_gpus(ranks: int, cut: list[str], single: tuple[list[str], Log], tmp_path: Path) -> None:
    arguments, expected = single
    where = ["--device", "cuda", "--transport", "nccl"]
    program = over_nccl(ranks, *arguments, *where, *cut, "--out", str(tmp_path))
    done = finish(torchrun(ranks, *program))
    assert done.returncode == 0, done.stdout
    # The candidates tested before the first contact is known depend on the device.
    found, wanted = ([line | {"candidates": None} for line in lines] for lines in (log(tmp_path), expected))
    assert found == wanted
