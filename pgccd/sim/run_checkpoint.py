"""Checkpoints of a run, in the files of `pgccd.checkpoint`."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

from pgccd.checkpoint import files
from pgccd.checkpoint.files import CheckpointError
from pgccd.checkpoint.stored import Index, Stored, has_checkpoint
from pgccd.sim.model import ModelConfig, RobotState

KIND = "simulation"
ROBOTS = "robots"  #: the name of their table
_FORMER = "checkpoint.pt"  # of format 1
_WIDTHS = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}  # of float64; others are int64
# As from `layout_of`.
_LAYOUT = {
    ROBOTS: {
        field.name: ["float64", [_WIDTHS[field.name]]] if field.name in _WIDTHS else ["int64", []]
        for field in fields(RobotState)
    }
}


@dataclass
class Header:
    """A run between two steps, without its robots.

    Attributes:
        config: of the world.
        steps_made: number of steps made.
        steps_wanted: number of steps after which the run ends.
        meshes: the meshes' `meshes_digest`.
    """

    config: ModelConfig
    steps_made: int
    steps_wanted: int
    meshes: str

    @property
    def plain(self) -> dict[str, Any]:
        """The header of the index: all fields except `steps_made`."""
        return {"config": asdict(self.config), "meshes": self.meshes, "steps_wanted": self.steps_wanted}


@dataclass
class Checkpoint(Header):
    """A run between two steps, with its robots.

    Attributes:
        config, steps_made, steps_wanted, meshes: as for the run without its robots: the model's parameters, numbers of
            steps, and the meshes' digest.
        state: of all robots, ids ascending, on the CPU.
    """

    state: RobotState


class StoredCheckpoint(Stored):
    """The newest checkpoint in a run's folder. The hash of its index has been checked, those of its other files have
    not: see `verify`.

    Args:
        run_folder: of the run.
        index: as for `Stored`.

    Raises:
        CheckpointError: it cannot be read.
    """

    def __init__(self, run_folder: Path, index: Index | None = None) -> None:
        super().__init__(run_folder, KIND, index)
        path, content = self.folder / files.INDEX, self.header
        try:
            config = content["config"] | {"stay_steps": tuple(content["config"]["stay_steps"])}
            missing = sorted({field.name for field in fields(ModelConfig)} - config.keys())
            if missing:  # a default could change the run
                raise ValueError(f"config: {', '.join(missing)} missing; written by another version of pgccd?")
            #: The run.
            self.run = Header(ModelConfig(**config), self.steps_made, content["steps_wanted"], content["meshes"])
            if type(self.run.steps_wanted) is not int or self.run.steps_wanted < 0:
                raise ValueError("steps_wanted: expected a number >= 0")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{path} is not the index of a run: {error}") from error
        if files.layout_of(self.layout) != _LAYOUT:
            raise CheckpointError(f"{path}: expected the columns of robots, and no others")
        if self.row_count(ROBOTS) != self.run.config.robots:
            raise CheckpointError(f"{path}: of {self.run.config.robots} robots it has {self.row_count(ROBOTS)}")


def find_checkpoint(run_folder: Path, index: Index | None = None) -> StoredCheckpoint | None:
    """The newest checkpoint in a run's folder, `index` as for `Stored`; None if there is none.

    Raises:
        CheckpointError: there is one that cannot be read.
    """
    if index is not None or has_checkpoint(run_folder):
        return StoredCheckpoint(run_folder, index)
    if (run_folder / _FORMER).exists():
        raise CheckpointError(
            f"{run_folder / _FORMER} was written by an earlier version of pgccd (format 1), which must continue the run"
        )
    return None


def require_checkpoint(run_folder: Path, index: Index | None = None) -> StoredCheckpoint:
    """The newest checkpoint, `index` as for `Stored`.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it cannot be read.
    """
    found = find_checkpoint(run_folder, index)
    if found is None:
        raise FileNotFoundError(f"no checkpoint at {run_folder}")
    return found


def load_checkpoint(run_folder: str | Path) -> Checkpoint:
    """The newest checkpoint of a run in `run_folder`, written by any number of ranks, with all robots on the CPU.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it cannot be read, or is damaged.

    Example:
        >>> state = pgccd.sim.load_checkpoint("out/try").state
    """
    stored = require_checkpoint(Path(run_folder))
    stored.verify(stored.files)
    columns, total = stored.rows(ROBOTS, 0, stored.row_count(ROBOTS))
    stored.require_hash(ROBOTS, total)
    order = torch.argsort(columns["id"])
    return Checkpoint(**vars(stored.run), state=RobotState(**columns).map(lambda column: column[order]))


def forget_checkpoints(run_folder: Path) -> None:
    """Removes all checkpoints of an earlier run."""
    (run_folder / _FORMER).unlink(missing_ok=True)
    files.remove_all(run_folder / files.FOLDER)
