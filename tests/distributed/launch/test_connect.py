"""Detection of launchers from the environment."""

from __future__ import annotations

import os
import re
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from support.forked_job import ForkedJob, script
from support.launch import SUPPORT

from pgccd.distributed import Placement, choose_device, connect, find_placement
from pgccd.distributed.comm import nccl
from pgccd.distributed.launch.connect import Transport


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, Placement("none", 0, 1, 0, True)),
        ({"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "1"}, Placement("torchrun", 5, 8, 1)),
        (
            {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "TORCHELASTIC_RESTART_COUNT": "2"},
            Placement("torchrun", 0, 2, 0),
        ),
        ({"PMI_RANK": "3", "PMI_SIZE": "4", "MPI_LOCALRANKID": "3"}, Placement("MPICH", 3, 4, 3)),
        (
            {"OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "6", "OMPI_COMM_WORLD_LOCAL_RANK": "1"},
            Placement("Open MPI", 1, 6, 1),
        ),
        (
            {"SLURM_PROCID": "9", "SLURM_STEP_NUM_TASKS": "16", "SLURM_LOCALID": "1", "SLURM_NTASKS": "32"},
            Placement("srun", 9, 16, 1),
        ),
        # All ranks on one machine, for each launcher.
        (
            {"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "5", "LOCAL_WORLD_SIZE": "8"},
            Placement("torchrun", 5, 8, 5, True),
        ),
        (
            {"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "4"},
            Placement("torchrun", 5, 8, 1),
        ),
        (
            {"PMI_RANK": "3", "PMI_SIZE": "4", "MPI_LOCALRANKID": "3", "MPI_LOCALNRANKS": "4"},
            Placement("MPICH", 3, 4, 3, True),
        ),
        (
            {"SLURM_PROCID": "1", "SLURM_STEP_NUM_TASKS": "2", "SLURM_LOCALID": "1", "SLURM_STEP_NUM_NODES": "1"},
            Placement("srun", 1, 2, 1, True),
        ),
        # A batch script is a single process, whatever the number of tasks.
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "32", "SLURM_LOCALID": "0"}, Placement("none", 0, 1, 0, True)),
    ],
)
def test_placement(environment: dict[str, str], expected: Placement) -> None:
    assert find_placement(environment) == expected


def test_numbers_that_are_none_are_named() -> None:
    with pytest.raises(ValueError, match="^WORLD_SIZE: expected a number, got 'many'"):
        find_placement({"RANK": "0", "WORLD_SIZE": "many"})


def test_devices_by_local_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    placement = Placement("torchrun", 6, 8, 2)
    assert choose_device("cuda", placement) == torch.device("cuda:2")
    assert choose_device("cuda:1", placement) == torch.device("cuda:1")
    assert choose_device("cpu", placement) == torch.device("cpu")
    assert choose_device("cuda", Placement("none", 0, 1, 0)) == torch.device("cuda")


def test_one_process_needs_no_launcher() -> None:
    with connect() as comm:
        assert (comm.rank, comm.size, comm.transport) == (0, 1, "none")
    for arguments in ({"transport": "pigeon"}, {"timeout": 0.0}):
        with pytest.raises(ValueError, match=f"^{next(iter(arguments))}: "):
            connect(**arguments)


@pytest.mark.skipif(not dist.is_nccl_available(), reason="this torch was built without NCCL")
@pytest.mark.parametrize("before", [None, "1"])
def test_the_guard_alone_ends_what_waits_for_nccl(monkeypatch: pytest.MonkeyPatch, before: str | None) -> None:
    """torchrun makes torch end the process; this is disabled for pgccd's group only."""
    name, seen = "TORCH_NCCL_ASYNC_ERROR_HANDLING", {}
    monkeypatch.delenv(name, raising=False) if before is None else monkeypatch.setenv(name, before)

    def init(backend: str, **group: Any) -> None:
        seen.update(group, backend=backend, handling=os.environ[name])

    monkeypatch.setattr(dist, "init_process_group", init)
    monkeypatch.setattr(nccl, "_watch", lambda group: lambda: False)
    assert not nccl.make_default_group(dist.HashStore(), 1, 2, 7.0)()
    assert (seen["backend"], seen["rank"], seen["world_size"], seen["handling"]) == ("nccl", 1, 2, "0")
    # The guard acts before torch's watchdog.
    assert seen["pg_options"].is_high_priority_stream and seen["pg_options"]._timeout > timedelta(seconds=7)
    assert os.environ.get(name) == before


def test_process_groups_of_the_user(tmp_path: Path) -> None:
    with ForkedJob(3, tmp_path, script, str(SUPPORT / "group_job.py")) as started:
        assert started.finish() == [0] * 3 and started.said.count("is done") == 3, started.said


def connect_with(variables: dict[str, str], transport: Transport) -> None:
    os.environ |= variables
    connect(transport=transport, timeout=30.0)


@pytest.mark.parametrize(
    ("transport", "variables", "said"),
    [
        (
            "gloo",
            {"GLOO_SOCKET_IFNAME": "eth99"},
            r"rank 0: GLOO_SOCKET_IFNAME: \S+ has no interface 'eth99', but .*lo",
        ),
        ("nccl", {"CUDA_VISIBLE_DEVICES": ""}, "rank 0: transport: 'nccl' needs a GPU and a torch that was built with"),
    ],
)
def test_what_ranks_cannot_use_is_named(
    transport: Transport, variables: dict[str, str], said: str, tmp_path: Path
) -> None:
    with ForkedJob(2, tmp_path / "said", connect_with, variables, transport) as started:
        assert started.finish() == [1, 1], started.said
    assert len(re.findall(f"DisagreementError: {said}", started.said)) == 2, started.said
