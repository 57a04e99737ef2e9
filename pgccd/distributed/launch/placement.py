"""Where this process stands among those that a launcher started: torchrun, mpirun, srun, or none at all."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

# The variables of rank, size and local rank, by launcher. srun sets SLURM_STEP_NUM_TASKS; a batch script, which is one
# process, has only SLURM_NTASKS.
_VARIABLES = {
    "torchrun": ("RANK", "WORLD_SIZE", "LOCAL_RANK"),
    "Open MPI": ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_RANK"),
    "MPICH": ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID"),
    "MVAPICH": ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_LOCAL_RANK"),
    "srun": ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID"),
}


@dataclass(frozen=True)
class Placement:
    """Where this process stands among those that were launched together."""

    launcher: str  #: a key of the variables above, or "none"
    rank: int
    size: int
    local_rank: int  #: among those of its machine


def find_placement(environment: Mapping[str, str] = os.environ) -> Placement:
    """Reads what the launcher left in the environment.

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
            return Placement(launcher, *numbers.values())
    return Placement("none", 0, 1, 0)
