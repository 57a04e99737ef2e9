"""What a run leaves in its folder: `model.json`, `steps.jsonl` and `checkpoint.pt` (or `checkpoints/`)."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import torch

from pgccd.sim.model import ModelConfig, RobotState

WORLD_FILE = "world.json"
LOG_FILE = "steps.jsonl"
CHECKPOINT_FILE = "checkpoint.pt"
CHECKPOINT_FOLDER = "checkpoints"  # of runs on many ranks
_FORMAT = 1


@dataclass
class Checkpoint:
    """A run between two steps."""

    config: ModelConfig
    steps_made: int
    steps_wanted: int
    meshes: str  #: their `meshes_digest`
    state: RobotState  #: on the CPU


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Writes `checkpoint.pt`: to a temporary name first, so that there is a whole one at any moment."""
    path = folder / CHECKPOINT_FILE
    content = {
        "format": _FORMAT,
        "config": asdict(checkpoint.config),
        "steps_made": checkpoint.steps_made,
        "steps_wanted": checkpoint.steps_wanted,
        "meshes": checkpoint.meshes,
        "state": {name: column.cpu() for name, column in checkpoint.state.columns.items()},
    }
    unfinished = path.with_suffix(".unfinished")
    with open(unfinished, "wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, path)
    return path


def load_checkpoint(folder: Path) -> Checkpoint:
    """Reads `checkpoint.pt`.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it cannot be read.
    """
    path = folder / CHECKPOINT_FILE
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']}, this version reads {_FORMAT}")
        config = content["config"] | {"stay_steps": tuple(content["config"]["stay_steps"])}
        return Checkpoint(
            ModelConfig(**config),
            content["steps_made"],
            content["steps_wanted"],
            content["meshes"],
            RobotState(**content["state"]),
        )
    except Exception as error:
        raise ValueError(f"{path} is not a checkpoint of a simulation: {error}") from error


def forget_checkpoints(folder: Path) -> None:
    """Removes all that an earlier run left to continue from."""
    (folder / CHECKPOINT_FILE).unlink(missing_ok=True)
    if (folder / CHECKPOINT_FOLDER).is_dir():
        shutil.rmtree(folder / CHECKPOINT_FOLDER)


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n")


class StepLog:
    """`steps.jsonl`: one line a step. Continuing a run drops the lines of steps made after its checkpoint.

    Args:
        folder: of the run.
        steps_made: how many lines to keep; their number must be there.
    """

    def __init__(self, folder: Path, steps_made: int) -> None:
        self.path = folder / LOG_FILE
        #: Records of all steps of the run so far.
        self.records = read_log(folder)[:steps_made] if steps_made else []
        if len(self.records) != steps_made:
            raise ValueError(
                f"{self.path} holds {len(self.records)} steps, but the checkpoint was made after {steps_made}"
            )
        unfinished = self.path.with_suffix(".unfinished")
        unfinished.write_text("".join(json.dumps(record) + "\n" for record in self.records))
        os.replace(unfinished, self.path)
        self._file: TextIO = open(self.path, "a")  # noqa: SIM115  (closed by __exit__)

    def append(self, record: dict[str, Any]) -> None:
        self.records.append(record)
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def __enter__(self) -> StepLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The records of `steps.jsonl`, up to the first line that is not whole; empty without one."""
    path = folder / LOG_FILE
    records = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:  # the process died while writing it
            break
    return records
