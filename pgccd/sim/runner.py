"""Runs of the nanorobot model: steps, progress, log, checkpoints."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Generic, Protocol, TypeVar

import torch

from pgccd.checkpoint.files import FOLDER, KEEP, checked_keep, require_writable
from pgccd.checkpoint.lock import hold
from pgccd.detection.broad import BroadPhase
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh
from pgccd.sim.checkpoint import Checkpoint, Header, load_checkpoint, require_checkpoint, save_checkpoint
from pgccd.sim.hashing import state_hash
from pgccd.sim.log import StepLog, iterate_log
from pgccd.sim.model import Model, ModelConfig, RobotState
from pgccd.sim.progress import Progress
from pgccd.sim.replay import StepMaker
from pgccd.sim.run_folder import begin
from pgccd.sim.step import Step


@dataclass
class Run:
    """State of a run.

    Attributes:
        model: the world.
        state: the robots after the last step.
        steps_made: number of steps, those before a resumption included.
        folder: of the run; None on ranks other than 0.
        last_steps: the last steps, as many as were to be kept and were made in this process, oldest first.
        interrupted: whether a signal ended the run; a checkpoint was written.
        one_in: `state` has one in this many robots; above 1 for very large worlds on many ranks.
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


def run(
    config: ModelConfig,
    steps: int,
    folder: str | Path,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 1,
    graph: bool | None = None,
    overwrite: bool = False,
    keep: int = KEEP,
    notes: Mapping[str, Any] | None = None,
) -> Run:
    """Simulates a world from its start and writes `world.json`, `steps.jsonl` and `checkpoints/` into a folder.

    Ctrl-C (or SIGTERM) ends it after the current step, with a checkpoint; a second one ends it at once, keeping the
    last checkpoint.

    Args:
        config: the world.
        steps: number of steps.
        folder: created if missing; locked against other jobs.
        meshes: kinds of robots; default `robot_mesh()`.
        device: of the computation. The result does not depend on it.
        broad_phase: as for `detect`.
        checkpoint_every: steps between checkpoints; 0: one at the end only.
        progress: notified after every step.
        keep_steps: number of last steps that are kept with their details, for pictures. On a GPU they are not replayed.
        graph: whether steps are replays of one CUDA graph. Default: on a GPU. The result does not depend on it.
        overwrite: whether to replace an earlier run in the folder.
        keep: number of checkpoints to keep: the newest ones.
        notes: additional plain values for `world.json`.

    Raises:
        ValueError: naming the argument; also if the folder is in use, or holds a run, or cannot be written to.

    Example:
        >>> finished = pgccd.sim.run(pgccd.sim.ModelConfig(robots=1000), steps=10, folder="out/ten")
        >>> sum(record["contacts"] for record in finished.records)
    """
    folder = Path(folder)
    if steps < 0:
        raise ValueError(f"steps: expected a number >= 0, got {steps}")
    model = Model(config, meshes, device)
    with hold(folder):
        begin(folder, model.describe() | dict(notes or {}), overwrite)
        machine = _OneProcess(
            model, model.start(), folder, broad_phase, graph, LastSteps(steps, keep_steps, Step), checked_keep(keep)
        )
        return _finish(machine, 0, steps, folder, checkpoint_every, progress)


def resume(
    folder: str | Path,
    steps: int | None = None,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    checkpoint_every: int = 0,
    progress: Progress | None = None,
    keep_steps: int = 1,
    graph: bool | None = None,
    keep: int = KEEP,
) -> Run:
    """Continues a run from its checkpoint, with the same result as without interruption.

    Args:
        folder: of the run.
        steps: total number of steps; default: that of the run.
        meshes: of the run; default `robot_mesh()`.
        device, broad_phase, checkpoint_every, progress, keep_steps, graph, keep: as for `run`.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint cannot be read, or does not match the meshes or the number of steps; or the folder is
            in use.

    Example:
        >>> finished = pgccd.sim.resume("out/try", steps=20)
    """
    folder = Path(folder)
    require_checkpoint(folder)  # before anything is written to the folder
    with hold(folder):
        checkpoint = load_checkpoint(folder)
        model, steps = continued(folder, checkpoint, steps, meshes, device)
        state = checkpoint.state.to(model.device)
        last_steps = LastSteps(steps, keep_steps, Step)
        machine = _OneProcess(model, state, folder, broad_phase, graph, last_steps, checked_keep(keep))
        return _finish(machine, checkpoint.steps_made, steps, folder, checkpoint_every, progress)


def continued(
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


class HasRecord(Protocol):
    """A step with a record for the log."""

    @property
    def record(self) -> dict[str, Any]:
        """Its line in the log."""
        ...


class Machine(Protocol):
    """Runs the steps of a run."""

    def stops(self, requested: bool) -> bool:
        """Whether to stop now, given whether this process received a request."""
        ...

    def step(self, index: int, more: int) -> HasRecord:
        """Runs a step; `more` steps follow before the state is read."""
        ...

    def save(self, steps_made: int, steps_wanted: int) -> None:
        """Starts to write a checkpoint."""
        ...

    def finish(self) -> None:
        """Waits until the last checkpoint is complete."""
        ...


S = TypeVar("S")


class LastSteps(Generic[S]):
    """The last steps of a run, with their details.

    Args:
        steps: total number of steps of the run.
        kept: how many are kept.
        eager: type of steps with details; those replayed have another.
    """

    def __init__(self, steps: int, kept: int, eager: type[S]) -> None:
        if kept < 0:
            raise ValueError(f"keep_steps: expected a number >= 0, got {kept}")
        self._first, self._kept, self._eager = steps - kept, kept, eager
        self.steps: list[S] = []

    def replayed_after(self, index: int, more: int) -> int:
        """Number of steps that follow step `index` before details of one are read, if `more` follow before the state
        is.
        """
        return min(more, max(0, self._first - index))

    def add(self, made: object) -> None:
        """Records a step."""
        if not isinstance(made, self._eager):
            self.steps = []
            return
        self.steps = [*self.steps, made][max(0, len(self.steps) + 1 - self._kept) :]


class _OneProcess:
    """All robots in this process. On a GPU consecutive steps are replays of one CUDA graph."""

    def __init__(
        self,
        model: Model,
        state: RobotState,
        folder: Path,
        broad_phase: BroadPhase,
        graph: bool | None,
        last_steps: LastSteps[Step],
        keep: int,
    ) -> None:
        self.model, self.state, self._folder, self._keep = model, state, folder, keep
        self._digest = meshes_digest(model.meshes.meshes)
        self._steps = StepMaker(model, state, broad_phase, graph)
        self._stopping = False
        self.last_steps = last_steps

    def stops(self, requested: bool) -> bool:
        self._stopping = requested
        return requested and not self._steps.is_ahead

    def step(self, index: int, more: int) -> HasRecord:
        made = self._steps.step(index, 0 if self._stopping else self.last_steps.replayed_after(index, more))
        self.last_steps.add(made)
        if not more:
            self.state = self._steps.state
        return made

    def save(self, steps_made: int, steps_wanted: int) -> None:
        self.state = self._steps.state
        checkpoint = Checkpoint(self.model.config, steps_made, steps_wanted, self._digest, self.state)
        save_checkpoint(self._folder, checkpoint, self._keep)

    def finish(self) -> None:
        pass


def _finish(
    machine: _OneProcess, made: int, steps: int, folder: Path, checkpoint_every: int, progress: Progress | None
) -> Run:
    require_writable(folder / FOLDER)
    log = StepLog(folder, made, f"{state_hash(machine.state):016x}")
    made = drive(machine, log, made, steps, checkpoint_every, progress)
    return Run(machine.model, machine.state, made, folder, machine.last_steps.steps, interrupted=made < steps)


def drive(
    machine: Machine,
    log: StepLog | None,
    steps_made: int,
    steps: int,
    checkpoint_every: int,
    progress: Progress | None,
) -> int:
    """Runs steps until `steps` are made or a signal arrives; then writes a checkpoint.

    Args:
        machine: runs the steps.
        log: closed at the end; None if another process writes it.
        steps_made: number of steps made so far.
        steps: total number.
        checkpoint_every: steps between checkpoints; 0: one at the end only.
        progress: notified after every step.

    Returns:
        The total number of steps made.
    """
    if checkpoint_every < 0:
        raise ValueError(f"checkpoint_every: expected a number >= 0, got {checkpoint_every}")
    every = checkpoint_every
    with log or nullcontext(), _stop_requests() as stop:
        with _DelayedLog(log, progress) as lines:
            while steps_made < steps and not machine.stops(stop.is_set()):
                until = steps if not checkpoint_every else min(steps, -(-(steps_made + 1) // every) * every)
                lines.add(machine.step(steps_made, more=until - steps_made - 1))
                steps_made += 1
                if steps_made == until < steps:
                    lines.sync()
                    machine.save(steps_made, steps)
            lines.sync()  # a checkpoint is never ahead of the log
        machine.save(steps_made, steps)
        machine.finish()
    return steps_made


class _DelayedLog:
    """Writes the line of each step after the next one has been enqueued, so that the host does not wait for a GPU.

    Args:
        log: None if another process writes it.
        progress: notified after every step.
    """

    def __init__(self, log: StepLog | None, progress: Progress | None) -> None:
        self._log, self._progress = log, progress
        self._last: HasRecord | None = None

    def add(self, step: HasRecord) -> None:
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
