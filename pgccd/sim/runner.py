"""Runs of the nanorobot world: steps, progress, log, checkpoints."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from pgccd.broad import BroadPhase
from pgccd.mesh import Mesh
from pgccd.sim.files import (
    CHECKPOINT_FILE,
    WORLD_FILE,
    Checkpoint,
    StepLog,
    load_checkpoint,
    meshes_digest,
    save_checkpoint,
    write_json,
)
from pgccd.sim.progress import Progress, Silent
from pgccd.sim.step import Step, make_step
from pgccd.sim.world import RobotState, World, WorldConfig


@dataclass
class Run:
    """A run so far."""

    world: World
    state: RobotState
    steps_made: int
    records: list[dict[str, Any]]  #: the lines of steps.jsonl, from step 0
    last_step: Step | None  #: None if no step was made in this process
    interrupted: bool  #: by a signal; the checkpoint is up to date


def run(
    config: WorldConfig,
    steps: int,
    folder: str | Path,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    checkpoint_every: int = 0,
    progress: Progress | None = None,
) -> Run:
    """Simulates a world from its start and writes `world.json`, `steps.jsonl` and `checkpoint.pt` into a folder.

    Ctrl-C (or SIGTERM) ends it after the step under way, with a checkpoint; a second one ends it at once, and the last
    checkpoint stays.

    Args:
        config: the world.
        steps: how many to make.
        folder: made if missing; the files of an earlier run in it are replaced.
        meshes: kinds of robots; default `robot_mesh()`.
        device: where to compute. The result does not depend on it.
        broad_phase: as for `detect`.
        checkpoint_every: steps between checkpoints; 0: one at the end only.
        progress: told about every step.

    Raises:
        ValueError: naming the argument.

    Example:
        >>> finished = pgccd.sim.run(pgccd.sim.WorldConfig(robots=1000), steps=10, folder="out/try")
        >>> sum(record["contacts"] for record in finished.records)
    """
    folder = Path(folder)
    if steps < 0:
        raise ValueError(f"steps: expected a number >= 0, got {steps}")
    world = World(config, meshes, device)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CHECKPOINT_FILE).unlink(missing_ok=True)  # an earlier run's would not fit the log that starts now
    write_json(folder / WORLD_FILE, world.describe())
    return _continue(world, world.start(), 0, steps, folder, broad_phase, checkpoint_every, progress)


def resume(
    folder: str | Path,
    steps: int | None = None,
    *,
    meshes: Sequence[Mesh] | None = None,
    device: torch.device | str = "cpu",
    broad_phase: BroadPhase = "auto",
    checkpoint_every: int = 0,
    progress: Progress | None = None,
) -> Run:
    """Continues a run from its checkpoint, to the same result as if it had not been interrupted.

    Args:
        folder: of the run.
        steps: how many to make in all; default: as many as the run was to make.
        meshes: those of the run.
        device, broad_phase, checkpoint_every, progress: as for `run`.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: it cannot be read, or does not fit the meshes, the log or the number of steps.

    Example:
        >>> finished = pgccd.sim.resume("out/try", steps=20)
    """
    folder = Path(folder)
    checkpoint = load_checkpoint(folder)
    world = World(checkpoint.config, meshes, device)
    if meshes_digest(world.meshes.meshes) != checkpoint.meshes:
        raise ValueError(f"meshes: the run in {folder} was made with others")
    steps = checkpoint.steps_wanted if steps is None else steps
    if steps < checkpoint.steps_made:
        raise ValueError(f"steps: the run in {folder} has made {checkpoint.steps_made} already, got {steps}")
    state = checkpoint.state.to(world.device)
    return _continue(world, state, checkpoint.steps_made, steps, folder, broad_phase, checkpoint_every, progress)


def _continue(
    world: World,
    state: RobotState,
    steps_made: int,
    steps: int,
    folder: Path,
    broad_phase: BroadPhase,
    checkpoint_every: int,
    progress: Progress | None,
) -> Run:
    if checkpoint_every < 0:
        raise ValueError(f"checkpoint_every: expected a number >= 0, got {checkpoint_every}")
    progress = progress or Silent()
    scene = world.scene(state.id)
    digest = meshes_digest(world.meshes.meshes)
    last_step = None
    with StepLog(folder, steps_made) as log, _stop_requests() as stop:
        while steps_made < steps and not stop.is_set():
            last_step = make_step(world, scene, state, steps_made, broad_phase)
            state = last_step.after
            log.append(last_step.record)
            steps_made += 1
            progress.advance(last_step.record)
            if checkpoint_every and steps_made % checkpoint_every == 0 and steps_made < steps:
                save_checkpoint(folder, Checkpoint(world.config, steps_made, steps, digest, state))
        save_checkpoint(folder, Checkpoint(world.config, steps_made, steps, digest, state))
        return Run(world, state, steps_made, log.records, last_step, interrupted=steps_made < steps)


@contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C or SIGTERM sets; the second acts as it always does."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may listen
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
