"""Multi-rank programs, started as a user starts them."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = Path(__file__).resolve().parent
SECONDS = 240
# Whether small messages are written to the memory of other GPUs, also if ranks share a GPU.
PEER_MEMORY, NO_PEER_MEMORY = {"PGCCD_PEER_MEMORY": "1"}, {"PGCCD_PEER_MEMORY": "0"}
# By default Open MPI refuses to run as root (e.g. in a container) and to start more ranks than there are cores.
_OPEN_MPI = (
    "OMPI_ALLOW_RUN_AS_ROOT=1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1",
    "OMPI_MCA_rmaps_base_oversubscribe=1",
    "PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe",
)


def environment(**more: str) -> dict[str, str]:
    """Environment in which a process finds pgccd and the tests, without the launcher variables of the test process."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PMI_", "OMPI_COMM_", "SLURM_"))}
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    return kept | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"} | more


def torchrun(ranks: int, *arguments: str) -> list[str]:
    """The command; arguments: torchrun's, then the program's."""
    return [sys.executable, "-m", "torch.distributed.run", *torchrun_options(ranks), *arguments]


def torchrun_options(ranks: int) -> list[str]:
    port = str(free_port())
    return ["--master-port", port, "--nproc-per-node", str(ranks), "--monitor-interval", "0.1"]


def over_nccl(ranks: int, *program: str) -> list[str]:
    """Arguments of a program whose ranks communicate over NCCL; ranks share GPUs if there are fewer GPUs than ranks."""
    return [*program] if ranks <= torch.cuda.device_count() else ["-m", "support.machines", *program]


def mpirun(ranks: int, *arguments: str) -> list[str]:
    """The command; skips the test without MPI."""
    beside = Path(sys.executable).parent / "mpirun"
    program = str(beside) if beside.exists() else shutil.which("mpirun")
    probe = subprocess.run([sys.executable, "-c", "from mpi4py import MPI"], capture_output=True)
    if program is None or probe.returncode:
        pytest.skip("no mpirun, or no mpi4py")
    return ["env", *_OPEN_MPI, program, "-n", str(ranks), sys.executable, *arguments]


def finish(command: list[str], **more: str) -> subprocess.CompletedProcess[str]:
    """Runs a command to completion; merges stdout and stderr."""
    return subprocess.run(
        command,
        env=environment(**more),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=SECONDS,
    )


def children(process: int) -> list[int]:
    """Ids of the processes started by `process`."""
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def start_ranks(ranks: int, program: list[str], **more: str) -> list[subprocess.Popen[str]]:
    """Ranks with torchrun's variables but without torchrun, which would end them all when the first one fails."""
    port = str(free_port())
    started = []
    for rank in range(ranks):
        variables = {"RANK": str(rank), "WORLD_SIZE": str(ranks), "LOCAL_RANK": str(rank)}
        variables |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        process = subprocess.Popen(
            [sys.executable, *program],
            env=environment(**variables, **more),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
    return started


_ports = itertools.count()


def free_port() -> int:
    """A port that is free and used by no other test worker; below the ephemeral range."""
    worker = int(re.sub(r"\D", "", os.environ.get("PYTEST_XDIST_WORKER", "0")))
    for number in _ports:
        port = 20_000 + 100 * worker + number % 100
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("counting ends")
