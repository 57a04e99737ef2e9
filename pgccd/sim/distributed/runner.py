"""Runs of the nanorobot simulation on many ranks, with results bitwise equal to those of `pgccd.sim.run`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from pgccd.checkpoint.files import FOLDER, KEEP, checked_keep, require_writable
from pgccd.detection.broad import BroadPhase
from pgccd.distributed.checkpoint.partition import load_partition, stored_kind
from pgccd.distributed.checkpoint.reading import load_share, open_stored
from pgccd.distributed.checkpoint.shared_folder import hold_together
from pgccd.distributed.checkpoint.writing import CheckpointWriter
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import collective
from pgccd.distributed.launch.agreement import on_first, require_agreement, together
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.cut import DEFAULT_AXES, DEFAULT_CELLS, Cut
from pgccd.distributed.partition.interface import Partition, Triple
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh
from pgccd.sim.checkpoint import KIND, ROBOTS, Header, StoredCheckpoint, require_checkpoint
from pgccd.sim.distributed.gathering import gather_sample
from pgccd.sim.distributed.simulation import CommittedRankStep, DistributedSimulation, RankStep, starting_share
from pgccd.sim.hashing import state_hash
from pgccd.sim.log import StepLog
from pgccd.sim.model import Model, ModelConfig, RobotState
from pgccd.sim.progress import Progress
from pgccd.sim.run_folder import begin
from pgccd.sim.runner import LastSteps, Run, continued, drive
from pgccd.sim.step import Step

# Maximum number of robots gathered on one rank, some 0.3 GB with their contacts; a picture draws no more.
_MOST_GATHERED = 1_000_000


@dataclass(frozen=True)
class DistributedOptions:
    """Options of the distribution over ranks. No result depends on them.

    Attributes:
        partition: "cells" or "bisection". "auto": that of the checkpoint, or bisection; but cells if `axes` or `cells`
            is not the default or the policy moves single cells.
        axes: number of axes that are cut: 1 (slabs), 2 or 3.
        cells: number in each subdomain: m means m x m in X-Y.
        balance: options of load balancing.
        overlap: whether pairs of own bodies are tested while ghosts are sent.
    """

    partition: str = "auto"
    axes: int = DEFAULT_AXES
    cells: int | Triple = DEFAULT_CELLS
    balance: BalanceOptions = field(default_factory=BalanceOptions)
    overlap: bool = True


@partial(collective, name="sim.distributed.run")
def run(
    comm: Comm,
    config: ModelConfig,
    steps: int,
    folder: str | Path,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    options: DistributedOptions | None = None,
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 0,
    overwrite: bool = False,
    keep: int = KEEP,
    notes: Mapping[str, Any] | None = None,
) -> Run:
    """Simulates a world from its start on all ranks; rank 0 writes `world.json` and `steps.jsonl`.

    Checkpoints are written to the folder `checkpoints`, which all ranks must share. A signal to any rank ends all of
    them after the current step.

    Args:
        comm: between the ranks.
        config, steps, folder, meshes, broad_phase, checkpoint_every, progress, overwrite, keep, notes: as for
            `pgccd.sim.run`; equal on all ranks.
        device: of this rank.
        options: of the distribution.
        keep_steps: number of last steps of which the robots and the contacts are gathered on rank 0, for pictures. Of
            more than a million robots the last step of an even sample, whose size does not grow with the world.

    Returns:
        The run; without its folder and records on ranks other than 0. With `keep_steps` rank 0 has the gathered state.

    Raises:
        ValueError: naming the argument; on all ranks.

    Example:
        >>> with pgccd.distributed.connect() as comm:
        ...     pgccd.sim.distributed.run(comm, pgccd.sim.ModelConfig(robots=10**6), 100, "out/million")
    """
    folder, options = Path(folder), options or DistributedOptions()
    if steps < 0:
        raise ValueError(f"steps: expected a number >= 0, got {steps}")
    model = together(comm, lambda: Model(config, meshes, device))
    _compare(comm, model, steps, folder, checkpoint_every, keep_steps, options, keep)

    with hold_together(comm, folder):
        on_first(comm, lambda: begin(folder, model.describe() | dict(notes or {}), overwrite))
        partition = _partition(comm, model, options)
        start = starting_share(comm, model)
        simulation = DistributedSimulation.create(
            comm, model, partition, start, options.balance, options.overlap, broad_phase
        )
        return _continue(simulation, 0, steps, folder, checkpoint_every, progress, keep_steps, keep)


@partial(collective, name="sim.distributed.resume")
def resume(
    comm: Comm,
    folder: str | Path,
    steps: int | None = None,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    options: DistributedOptions | None = None,
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 0,
    keep: int = KEEP,
) -> Run:
    """Continues a run from its newest checkpoint, on any number of ranks, with the same result as without interruption.
    The checkpoint may be from `pgccd.sim.run`.

    Args:
        comm, folder, meshes, device, broad_phase, options, checkpoint_every, progress, keep_steps, keep: as for `run`.
        steps: total number of steps; default: that of the run.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint cannot be read, or does not match the meshes or the number of steps; on all ranks.

    Example:
        >>> pgccd.sim.distributed.resume(comm, "out/million", steps=200)
    """
    folder, options = Path(folder), options or DistributedOptions()
    on_first(comm, lambda: require_checkpoint(folder) and None)  # before anything is written to the folder
    with hold_together(comm, folder):
        stored = open_stored(comm, lambda index: require_checkpoint(folder, index))
        header = stored.run
        model, steps = together(comm, lambda: continued(folder, header, steps, meshes, device))
        _compare(comm, model, steps, folder, checkpoint_every, keep_steps, options, keep)
        state = load_robots(comm, stored).to(model.device)
        partition = load_partition(comm, stored, _partition(comm, model, options, stored_kind(stored)))
        simulation = DistributedSimulation.create(
            comm, model, partition, state, options.balance, options.overlap, broad_phase
        )
        made = header.steps_made
        return _continue(simulation, made, steps, folder, checkpoint_every, progress, keep_steps, keep)


def load_robots(comm: Comm, stored: StoredCheckpoint) -> RobotState:
    """An equal share of the robots of a checkpoint, on the CPU: see `load_share`."""
    return RobotState(**load_share(comm, stored, ROBOTS)[ROBOTS])


def _compare(
    comm: Comm,
    model: Model,
    steps: int,
    folder: Path,
    checkpoint_every: int,
    keep_steps: int,
    options: DistributedOptions,
    keep: int,
) -> None:
    together(comm, lambda: checked_keep(keep))
    facts = {"configuration": model.config, "steps": steps, "folder": str(folder), "options": options}
    facts |= {"checkpoint_every": checkpoint_every, "keep_steps": keep_steps, "keep": keep}
    facts |= {"device": model.device.type}
    facts |= {"meshes": meshes_digest(model.meshes.meshes), "transport": comm.transport}
    require_agreement(comm, facts)


def _partition(comm: Comm, model: Model, options: DistributedOptions, former: str | None = None) -> Partition:
    x, y, z = model.half_extent
    cut = Cut(options.partition, (-x, -y, -z), (x, y, z), options.axes, options.cells)
    return cut.uniform(comm.size, model.device, options.balance, former)


class _SimulationMachine:
    """A simulation as `Machine` of `drive`."""

    def __init__(
        self, simulation: DistributedSimulation, folder: Path, digest: str, last_steps: LastSteps[RankStep], keep: int
    ) -> None:
        self.simulation, self._digest = simulation, digest
        self._checkpoints = CheckpointWriter(simulation.comm, folder, KIND, keep)
        self._last_steps = last_steps
        self._asked = False  # on this rank
        self._stopping: bool | None = None  # on all ranks; None before the first step

    def stops(self, requested: bool) -> bool:
        # All ranks get the request at the end of the next step.
        self._asked = requested
        if self._stopping is None:
            self._stopping = self.simulation.comm.any(requested)
        return self._stopping and not self.simulation.is_ahead

    def step(self, index: int, more: int) -> RankStep | CommittedRankStep:
        more = 0 if self._stopping else self._last_steps.replayed_after(index, more)
        made = self.simulation.step(index, self._asked, more)
        self._stopping = self._stopping or made.stop_requested
        self._last_steps.add(made)
        return made

    def save(self, steps_made: int, steps_wanted: int) -> None:
        self.simulation.verify()
        header = Header(self.simulation.model.config, steps_made, steps_wanted, self._digest)
        tables = {ROBOTS: self.simulation.state.columns}
        self._checkpoints.begin(steps_made, header.plain, tables, self.simulation.partition)

    def finish(self) -> None:
        self._checkpoints.finish()


def _continue(
    simulation: DistributedSimulation,
    steps_made: int,
    steps: int,
    folder: Path,
    checkpoint_every: int,
    progress: Progress | None,
    keep_steps: int,
    keep: int,
) -> Run:
    comm, model = simulation.comm, simulation.model
    one_in = -(-model.config.robots // _MOST_GATHERED) if keep_steps else 1
    last_steps = LastSteps(steps, min(keep_steps, 1) if one_in > 1 else keep_steps, RankStep)
    machine = _SimulationMachine(simulation, folder, meshes_digest(model.meshes.meshes), last_steps, keep)
    signed = (state_hash(simulation.state) + 2**63) % 2**64 - 2**63
    total = int(comm.sum(torch.tensor([signed]))) % 2**64
    together(comm, lambda: require_writable(folder / FOLDER))
    log = together(comm, lambda: StepLog(folder, steps_made, f"{total:016x}") if comm.rank == 0 else None)
    made = drive(machine, log, steps_made, steps, checkpoint_every, progress)
    comm.barrier()  # rank 0 has completed the last checkpoint
    state, shown = simulation.state, list[Step]()
    if keep_steps:
        state, shown = gather_sample(comm, state, last_steps.steps, one_in)
    of_first = None if log is None else folder
    return Run(model, state, made, of_first, shown, interrupted=made < steps, one_in=one_in)
