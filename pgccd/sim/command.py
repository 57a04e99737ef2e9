"""Functions of `pgccd simulate` for many ranks."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import torch

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.options import RankOptions
from pgccd.distributed.guard import RankFailureError, is_of_all_ranks
from pgccd.distributed.launch.agreement import on_first
from pgccd.distributed.launch.connect import DEFAULT_TIMEOUT, TRANSPORTS, connect, tell_problem
from pgccd.distributed.launch.placement import find_placement
from pgccd.distributed.partition.balance import POLICIES, BalanceOptions
from pgccd.distributed.partition.cut import DEFAULT_AXES, DEFAULT_CELLS, PARTITION_CHOICES
from pgccd.sim.run_checkpoint import find_checkpoint

_FAILURE_CODE = 70
_TELLING_SECONDS = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that only matter with several ranks."""
    add = parser.add_argument_group(
        "on many ranks", "started by torchrun, mpirun or srun; these options do not change the result"
    ).add_argument
    add("--transport", choices=TRANSPORTS, default="auto", help="communication library (NCCL for GPUs, else Gloo)")
    add("--timeout", type=float, default=DEFAULT_TIMEOUT, metavar="SECONDS", help="longest wait for another rank (300)")
    bisection = "bisection; cells for --balance one-cell or other --axes or --cells than the defaults"
    add("--partition", choices=PARTITION_CHOICES, default="auto", help=f"partition of space ({bisection})")
    cut = "cells: number of axes that are cut; 1: slabs (3)"
    add("--axes", type=int, choices=(1, 2, 3), default=DEFAULT_AXES, help=cut)
    add("--cells", type=int, default=DEFAULT_CELLS, metavar="M", help="cells: M x M for each rank at the start (16)")
    add("--balance", choices=POLICIES, default="cost", help="load balancing policy (cost)")


def rank_options(options: argparse.Namespace) -> RankOptions:
    """From the options of the command line."""
    balance = BalanceOptions(options.balance)
    return RankOptions(options.partition, options.axes, options.cells, balance, broad_phase=options.broad_phase)


def connect_ranks(options: argparse.Namespace) -> Comm:
    """Connects all processes that were started together.

    Raises:
        ValueError: ranks were started with different or invalid options; on all ranks.
    """
    if find_placement().size > 1 and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)  # ranks share the cores of their machine
    left_out = ("run", "command", "device", "mesh")  # meshes and device types are compared separately
    settings = {f"--{name.replace('_', '-')}": str(v) for name, v in vars(options).items() if name not in left_out}
    try:
        return connect(options.device, options.transport, options.timeout, settings)
    except (ImportError, RuntimeError) as error:
        _stop(error)


@contextmanager
def stopping(comm: Comm) -> Iterator[None]:
    """Ends this process with a message that names the rank if another rank is lost."""
    try:
        with comm:
            yield
    except RankFailureError as error:
        _stop(error)


def tell_ranks(problem: Exception) -> Exception:
    """Sends the reason why this rank cannot connect to all ranks, so that they end too. Returns the problem to report:
    the problem of the first rank that has one.
    """
    if find_placement().size > 1:
        try:
            tell_problem(str(problem))
        except (ValueError, ImportError, RuntimeError) as error:
            return error
    return problem


def is_told_by_rank_0(error: Exception) -> bool:
    """Whether rank 0 reports the error, because all ranks have it."""
    if find_placement().rank == 0 or not is_of_all_ranks(error):
        return False
    time.sleep(_TELLING_SECONDS)  # launchers end all ranks when the first one ends
    return True


def _stop(error: Exception) -> NoReturn:
    sys.stderr.write(f"pgccd simulate: rank {find_placement().rank} stops: {error}\n")
    sys.stderr.flush()
    # A regular exit would wait for messages of a dead rank.
    os._exit(_FAILURE_CODE)


def folder_to_resume(comm: Comm, resume: str | None, out: Path) -> Path | None:
    """The folder of the run to continue; None for a new run.

    Args:
        comm: between the ranks.
        resume: a folder, or "auto": `out`, if it holds a checkpoint.
        out: folder of a new run.

    Raises:
        ValueError: there is a checkpoint that cannot be read.
    """
    if resume != "auto":
        return None if resume is None else Path(resume)
    return out if on_first(comm, lambda: find_checkpoint(out) is not None) else None
