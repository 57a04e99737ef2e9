"""What `pgccd simulate` needs to run on many ranks."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import torch

from pgccd.distributed.balance import POLICIES, BalanceOptions
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import RankFailureError
from pgccd.distributed.launch.agents import have_agents_here, note_agents
from pgccd.distributed.launch.agreement import on_first
from pgccd.distributed.launch.connect import DEFAULT_TIMEOUT, TRANSPORTS, connect
from pgccd.distributed.launch.placement import find_placement
from pgccd.sim.distributed.runner import DistributedOptions, find_checkpoint
from pgccd.sim.files import forget_checkpoints

_FAILURE_CODE = 70


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that only matter with several ranks."""
    add = parser.add_argument_group(
        "on many ranks", "started by torchrun, mpirun or srun; none of these changes the result"
    ).add_argument
    add("--transport", choices=TRANSPORTS, default="auto", help="what carries messages (NCCL for GPUs, else Gloo)")
    add("--timeout", type=float, default=DEFAULT_TIMEOUT, metavar="SECONDS", help="longest wait for another rank (300)")
    add("--axes", type=int, choices=(1, 2, 3), default=3, help="along which space is cut; 1: slabs (3)")
    add("--cells", type=int, default=16, metavar="M", help="each rank starts with M x M cells (16)")
    add("--balance", choices=POLICIES, default="cost", help="how cells change hands (cost)")


def distributed_options(options: argparse.Namespace) -> DistributedOptions:
    """Of the command line."""
    return DistributedOptions(options.axes, options.cells, BalanceOptions(options.balance))


@contextmanager
def connected(options: argparse.Namespace) -> Iterator[Comm]:
    """All processes that were started together; a rank that is lost ends this one with a message that names it."""
    if find_placement().size > 1 and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)  # ranks share the cores of their machine
    try:
        with connect(options.device, options.transport, options.timeout) as comm:
            yield comm
    except RankFailureError as error:
        _give_up(error)


def _give_up(error: RankFailureError) -> NoReturn:
    sys.stderr.write(f"pgccd simulate: rank {find_placement().rank} stops: {error}\n")
    sys.stderr.flush()
    # Ordinary ways out would wait for messages of a rank that is no more.
    os._exit(_FAILURE_CODE)


def folder_to_resume(comm: Comm, options: argparse.Namespace, out: Path) -> Path | None:
    """The run to continue: the one asked for, or, once torchrun has started all ranks again, since one was lost or a
    machine has joined, the one under way."""
    if options.resume is not None:
        return options.resume

    def is_under_way() -> bool:
        try:
            header, _ = find_checkpoint(out)
        except FileNotFoundError:
            return False
        # One agent may start ranks for one run after another.
        return comm.restarted or header.steps_made < header.steps_wanted

    took_part = have_agents_here(comm, out)
    goes_on = comm.restarted if took_part is None else took_part
    if not (goes_on and on_first(comm, is_under_way)):
        return None
    note_agents(comm, out)
    return out


def begin_run(comm: Comm, out: Path) -> None:
    """From now on restarted ranks continue the run that begins in this folder. What an earlier one left
    there goes first, lest it be continued should this one fail before its own first checkpoint."""
    on_first(comm, lambda: forget_checkpoints(out))
    note_agents(comm, out)


def needs_ranks(comm: Comm, folder: Path | None) -> bool:
    """Whether a run must be made by `pgccd.distributed`: there are ranks, or it continues one of several."""
    return comm.size > 1 or (folder is not None and not find_checkpoint(folder)[1])
