"""Rank, size and local rank of this process, as set by torchrun, mpirun, srun, or no launcher. torch.distributed reads
only torchrun's variables.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

# The variables of rank, size and local rank, by launcher. srun sets SLURM_STEP_NUM_TASKS; a batch script, which is a
# single process, has only SLURM_NTASKS.
_VARIABLES = {
    "torchrun": ("RANK", "WORLD_SIZE", "LOCAL_RANK"),
    "Open MPI": ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_RANK"),
    "MPICH": ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID"),
    "MVAPICH": ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_LOCAL_RANK"),
    "srun": ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID"),
}
# The number of ranks on this machine; for srun, the number of machines.
_LOCAL_SIZE = {
    "torchrun": "LOCAL_WORLD_SIZE",
    "Open MPI": "OMPI_COMM_WORLD_LOCAL_SIZE",
    "MPICH": "MPI_LOCALNRANKS",
    "MVAPICH": "MV2_COMM_WORLD_LOCAL_SIZE",
}
_SRUN_MACHINES = "SLURM_STEP_NUM_NODES"


@dataclass(frozen=True)
class Placement:
    """Position of this process among those launched together.

    Attributes:
        launcher: "torchrun", "Open MPI", "MPICH", "MVAPICH", "srun" or "none".
        rank: of this process, from 0.
        size: number of processes.
        local_rank: rank within its machine.
        is_one_machine: whether all ranks are known to be on one machine.
    """

    launcher: str
    rank: int
    size: int
    local_rank: int
    is_one_machine: bool = False


def find_placement(environment: Mapping[str, str] = os.environ) -> Placement:
    """Reads the launcher's environment variables.

    Raises:
        ValueError: if a variable is not a number.

    Example:
        >>> pgccd.distributed.find_placement().size
        1
    """
    for launcher, (rank, size, local_rank) in _VARIABLES.items():
        if rank in environment and size in environment:
            numbers = {}
            for name in (rank, size, local_rank):
                text = environment.get(name, "0")
                if not re.fullmatch(r"\d+", text):
                    raise ValueError(f"{name}: expected a number, got {text!r}")
                numbers[name] = int(text)
            if launcher == "srun":
                is_one_machine = environment.get(_SRUN_MACHINES) == "1"
            else:
                is_one_machine = environment.get(_LOCAL_SIZE[launcher]) == environment[size]
            return Placement(launcher, numbers[rank], numbers[size], numbers[local_rank], is_one_machine)
    return Placement("none", 0, 1, 0, True)
