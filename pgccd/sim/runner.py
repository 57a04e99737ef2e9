"""Runs of the nanorobot model: steps, progress, log, checkpoints."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from pgccd.checkpoint.files import FOLDER, KEEP, CheckpointError, checked_keep, require_writable
from pgccd.distributed.checkpoint.partition import load_partition, stored_kind
from pgccd.distributed.checkpoint.reading import load_share, open_stored
from pgccd.distributed.checkpoint.shared_folder import hold_together
from pgccd.distributed.checkpoint.writing import CheckpointWriter
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.detection.options import RankOptions
from pgccd.distributed.guard import collective
from pgccd.distributed.launch.agreement import on_first, require_agreement, together
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh
from pgccd.sim.gathering import gather_sample
from pgccd.sim.log import StepLog, iterate_log
from pgccd.sim.model import Model, ModelConfig, RobotState
from pgccd.sim.progress import Progress
from pgccd.sim.run_checkpoint import KIND, ROBOTS, Header, StoredCheckpoint, require_checkpoint
from pgccd.sim.run_folder import begin
from pgccd.sim.simulation import Simulation, starting_partition
from pgccd.sim.state_hashes import state_hash
from pgccd.sim.step import Step
from pgccd.sim.step_graph import CommittedStep

# Maximum number of robots gathered on one rank, some 0.3 GB with their contacts; a picture draws no more.
_MOST_GATHERED = 1_000_000


@dataclass
class Run:
    """State of a run.

    Attributes:
        model: the world.
        state: the robots after the last step: with `keep_steps`, all robots on rank 0, or a sample of a very large
            world; without, this rank's own robots.
        steps_made: number of steps, those before a resumption included.
        folder: of the run; None on ranks other than 0.
        last_steps: the last steps, as many as were to be kept and were made in this process, oldest first.
        interrupted: whether a signal ended the run; a checkpoint was written.
        one_in: `state` has one in this many robots.
    """

    model: Model
    state: RobotState
    steps_made: int
    folder: Path | None
    last_steps: list[Step]
    interrupted: bool
    one_in: int = 1

    @property
    def records(self) -> list[dict[str, Any]]:
        """The lines of steps.jsonl, from step 0, read from the file now."""
        return list(self.iterate(with_ranks=True))

    def iterate(self, with_ranks: bool = False) -> Iterator[dict[str, Any]]:
        """These records, one at a time.

        Args:
            with_ranks: whether records have the object `ranks`, whose size grows with the number of ranks.
        """
        if self.folder is not None:
            for record in iterate_log(self.folder, with_ranks):
                if record["step"] >= self.steps_made:
                    return
                yield record


@partial(collective, name="sim.run")
def run(
    config: ModelConfig,
    steps: int,
    folder: str | Path,
    *,
    comm: Comm | None = None,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    options: RankOptions | None = None,
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 1,
    graph: bool | None = None,
    overwrite: bool = False,
    keep: int = KEEP,
    notes: Mapping[str, Any] | None = None,
) -> Run:
    """Simulates a world from its start, and writes `world.json`, `steps.jsonl` and `checkpoints/` to a folder, which
    all ranks must share.

    Ctrl-C (or SIGTERM) on any rank ends the run after the current step, with a checkpoint. A second one ends it at once
    and keeps the last checkpoint.

    Args:
        config: the world.
        steps: number of steps.
        folder: created if missing; locked against other jobs.
        comm: between the ranks, all of which call this with equal arguments. Default: one process with all robots.
        meshes: kinds of robots. Default: `robot_mesh()`.
        device: of the computation, of this rank. The result does not depend on it.
        options: of the distribution over ranks, and the broad phase: see `pgccd.distributed.RankOptions`.
        checkpoint_every: steps between checkpoints; 0: one at the end only.
        progress: notified after every step.
        keep_steps: number of last steps that are kept with their details on rank 0, for pictures. On a GPU they are not
            replayed. With more than a million robots, only the last step is kept, for an even sample whose size does
            not grow with the world.
        graph: whether steps are replays of one CUDA graph. Default: on a GPU. The result does not depend on it.
        overwrite: whether to replace an earlier run in the folder.
        keep: number of checkpoints to keep: the newest ones.
        notes: additional plain values for `world.json`.

    Returns:
        The run; without its folder and records on ranks other than 0.

    Raises:
        ValueError: naming the argument; also if the folder is in use, holds a run, or cannot be written to. On all
            ranks.

    Example:
        >>> finished = pgccd.sim.run(pgccd.sim.ModelConfig(robots=1000), steps=10, folder="out/ten")
        >>> sum(record["contacts"] for record in finished.records)
    """
    comm, folder, options = comm or Alone(), Path(folder), options or RankOptions()
    if steps < 0:
        raise ValueError(f"steps: expected a number >= 0, got {steps}")
    model = together(comm, lambda: Model(config, meshes, device))
    plan = _Plan(steps, folder, checkpoint_every, progress, keep_steps, keep)
    plan.agree(comm, model, options)
    with hold_together(comm, folder):
        on_first(comm, lambda: begin(folder, model.describe() | dict(notes or {}), overwrite))
        return plan.finish(Simulation.create(comm, model, options=options, graph=graph), 0)


@partial(collective, name="sim.resume")
def resume(
    folder: str | Path,
    steps: int | None = None,
    *,
    comm: Comm | None = None,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    options: RankOptions | None = None,
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 1,
    graph: bool | None = None,
    keep: int = KEEP,
) -> Run:
    """Continues a run from its newest checkpoint, on any number of ranks, with the same result as without interruption.

    Args:
        folder: of the run.
        steps: total number of steps. Default: that of the run.
        meshes: of the run. Default: `robot_mesh()`.
        comm, device, options, checkpoint_every, progress, keep_steps, graph, keep: as for `run`.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint cannot be read, or does not match the meshes or the number of steps; or the folder is
            in use. On all ranks.

    Example:
        >>> finished = pgccd.sim.resume("out/try", steps=20)
    """
    comm, folder, options = comm or Alone(), Path(folder), options or RankOptions()
    on_first(comm, lambda: require_checkpoint(folder) and None)  # before anything is written to the folder
    with hold_together(comm, folder):
        stored = open_stored(comm, lambda index: require_checkpoint(folder, index))
        model, steps = together(comm, lambda: _continued(folder, stored.run, steps, meshes, device))
        plan = _Plan(steps, folder, checkpoint_every, progress, keep_steps, keep)
        plan.agree(comm, model, options)
        state = load_robots(comm, stored).to(model.device)
        uniform = starting_partition(comm, model, options, stored_kind(stored))
        partition = load_partition(comm, stored, uniform)
        return plan.finish(Simulation.create(comm, model, partition, state, options, graph), stored.run.steps_made)


def load_robots(comm: Comm, stored: StoredCheckpoint) -> RobotState:
    """An equal share of the robots of a checkpoint, on the CPU: see `load_share`."""
    return RobotState(**load_share(comm, stored, ROBOTS)[ROBOTS])


def _continued(
    folder: Path, header: Header, steps: int | None, meshes: Sequence[Mesh] | None, device: torch.device | str
) -> tuple[Model, int]:
    """The model of a resumed run, and its total number of steps.

    Raises:
        ValueError: naming the argument that does not match the checkpoint.
    """
    model = Model(header.config, meshes, device)
    if meshes_digest(model.meshes.meshes) != header.meshes:
        raise ValueError(f"meshes: the run in {folder} was made with different meshes")
    steps = header.steps_wanted if steps is None else steps
    if steps < header.steps_made:
        raise ValueError(f"steps: the run in {folder} has made {header.steps_made} already, got {steps}")
    return model, steps


class _LastSteps:
    """The last steps of a run, with their details.

    Args:
        steps: total number of steps of the run.
        kept: how many are kept.
    """

    def __init__(self, steps: int, kept: int) -> None:
        self._first, self._kept = steps - kept, kept
        self.steps: list[Step] = []

    def replayed_after(self, index: int, more: int) -> int:
        """Number of steps that follow step `index` before the details of a step are read, if `more` steps follow before
        the state is read.
        """
        return min(more, max(0, self._first - index))

    def add(self, made: Step | CommittedStep) -> None:
        """Records a step; replayed ones have no details."""
        if not isinstance(made, Step):
            self.steps = []
            return
        self.steps = [*self.steps, made][max(0, len(self.steps) + 1 - self._kept) :]


@dataclass
class _Plan:
    """What is to be done with the steps of a run: arguments as for `run`."""

    steps: int
    folder: Path
    checkpoint_every: int
    progress: Progress | None
    keep_steps: int
    keep: int

    def agree(self, comm: Comm, model: Model, options: RankOptions) -> None:
        """Raises ValueError on all ranks if an argument is wrong or differs between ranks."""
        if self.keep_steps < 0:
            raise ValueError(f"keep_steps: expected a number >= 0, got {self.keep_steps}")
        if self.checkpoint_every < 0:
            raise ValueError(f"checkpoint_every: expected a number >= 0, got {self.checkpoint_every}")
        together(comm, lambda: checked_keep(self.keep))
        facts = {"configuration": model.config, "steps": self.steps, "folder": str(self.folder), "options": options}
        facts |= {"checkpoint_every": self.checkpoint_every, "keep_steps": self.keep_steps, "keep": self.keep}
        facts |= {"device": model.device.type}
        facts |= {"meshes": meshes_digest(model.meshes.meshes), "transport": comm.transport}
        require_agreement(comm, facts)

    def finish(self, simulation: Simulation, made: int) -> Run:
        """Runs the steps after those `made` until all are, or a signal arrives; then writes a checkpoint."""
        comm, model, folder = simulation.comm, simulation.model, self.folder
        one_in = -(-model.config.robots // _MOST_GATHERED) if self.keep_steps else 1
        last_steps = _LastSteps(self.steps, min(self.keep_steps, 1) if one_in > 1 else self.keep_steps)
        signed = (state_hash(simulation.state) + 2**63) % 2**64 - 2**63
        total = int(comm.sum(torch.tensor([signed]))) % 2**64
        together(comm, lambda: require_writable(folder / FOLDER))
        log = together(comm, lambda: StepLog(folder, made, f"{total:016x}") if comm.rank == 0 else None)
        made = self._drive(_Machine(simulation, folder, last_steps, self.keep), log, made)
        comm.barrier()  # rank 0 has completed the last checkpoint
        state, shown = simulation.state, list[Step]()
        if self.keep_steps:
            state, shown = gather_sample(comm, state, last_steps.steps, one_in)
        of_first = None if log is None else folder
        return Run(model, state, made, of_first, shown, interrupted=made < self.steps, one_in=one_in)

    def _drive(self, machine: _Machine, log: StepLog | None, made: int) -> int:
        """Runs the steps, given the log on rank 0, which is closed at the end. Returns the total number made."""
        steps, every = self.steps, self.checkpoint_every
        with log or nullcontext(), _stop_requests() as stop:
            with machine, _DelayedLog(log, self.progress) as lines:
                while made < steps and not machine.stops(stop.is_set()):
                    until = steps if not every else min(steps, -(-(made + 1) // every) * every)
                    lines.add(machine.step(made, more=until - made - 1))
                    made += 1
                    if made == until < steps:
                        lines.sync()
                        machine.save(made, steps)
                lines.sync()  # a checkpoint is never ahead of the log
            machine.save(made, steps)
            machine.finish()
        return made


class _Machine:
    """A simulation that stops on request, keeps its last steps and writes checkpoints."""

    def __init__(self, simulation: Simulation, folder: Path, last_steps: _LastSteps, keep: int) -> None:
        self._simulation, self._last_steps = simulation, last_steps
        self._digest = meshes_digest(simulation.model.meshes.meshes)
        self._checkpoints = CheckpointWriter(simulation.comm, folder, KIND, keep)
        self._asked = False  # on this rank
        self._stopping: bool | None = None  # on all ranks; None before the first step

    def stops(self, requested: bool) -> bool:
        """Whether to stop now, given whether this process received a request."""
        comm = self._simulation.comm
        # All of several ranks get the request at the end of the next step.
        self._asked = requested
        if self._stopping is None or comm.size == 1:
            self._stopping = comm.any(requested)
        return self._stopping and not self._simulation.is_ahead

    def step(self, index: int, more: int) -> Step | CommittedStep:
        """Runs a step; `more` steps follow before the state is read."""
        more = 0 if self._stopping else self._last_steps.replayed_after(index, more)
        made = self._simulation.step(index, self._asked, more)
        self._stopping = self._stopping or made.stop_requested
        self._last_steps.add(made)
        return made

    def save(self, steps_made: int, steps_wanted: int) -> None:
        """Starts to write a checkpoint."""
        simulation = self._simulation
        simulation.verify()
        header = Header(simulation.model.config, steps_made, steps_wanted, self._digest)
        tables = {ROBOTS: simulation.state.columns}
        self._checkpoints.begin(steps_made, header.plain, tables, simulation.partition)

    def finish(self) -> None:
        """Waits until the last checkpoint is complete."""
        self._checkpoints.finish()

    def __enter__(self) -> _Machine:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        # The checkpoint that is being written survives a failure. Of several ranks, one that failed could wait forever.
        if isinstance(error, Exception) and self._simulation.comm.size == 1:
            with suppress(CheckpointError):
                self.finish()


class _DelayedLog:
    """Writes the line of each step after the next one has been enqueued, so that the host does not wait for a GPU.

    Args:
        log: None if another process writes it.
        progress: notified after every step.
    """

    def __init__(self, log: StepLog | None, progress: Progress | None) -> None:
        self._log, self._progress = log, progress
        self._last: Step | CommittedStep | None = None

    def add(self, step: Step | CommittedStep) -> None:
        """Writes the line of the previous step."""
        self.finish()
        self._last = step

    def sync(self) -> None:
        """Writes the line of the last step, and syncs the log to disk."""
        self.finish()
        if self._log is not None:
            self._log.sync()

    def finish(self) -> None:
        """Writes the line of the last step."""
        if self._last is None:
            return
        record, self._last = self._last.record, None
        if self._log is not None:
            self._log.append(record)
        if self._progress is not None:
            self._progress.advance(record)

    def __enter__(self) -> _DelayedLog:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        # After a failure of a GPU or another rank, reading the record could block forever.
        if not (isinstance(error, RuntimeError) and torch.cuda.is_initialized()):
            self.finish()


@contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """An event set by the first Ctrl-C or SIGTERM; the second has its default effect."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set signal handlers
        yield stop
        return
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def listen_once(number: int, _frame: FrameType | None) -> None:
        stop.set()
        signal.signal(number, former[signal.Signals(number)])

    for number in former:
        signal.signal(number, listen_once)
    try:
        yield stop
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
