"""A run's folder, protected against overwriting."""

import json
from pathlib import Path
from typing import Any

from pgccd.checkpoint.files import one_line, read_json, replace_text
from pgccd.checkpoint.lock import FolderError
from pgccd.checkpoint.regular import read_regular
from pgccd.sim.run_checkpoint import find_checkpoint, forget_checkpoints

WORLD_FILE = "world.json"
_MOST_BYTES = 1 << 24


def begin(folder: Path, world: dict[str, Any], overwrite: bool) -> None:
    """Prepares a locked folder for a new run.

    Args:
        folder: of the run.
        world: content of `world.json`.
        overwrite: whether a checkpoint of an earlier run may be removed.

    Raises:
        FolderError: the folder holds an earlier run, and `overwrite` is False; or it cannot be written to.
    """
    if not overwrite:
        try:
            earlier = find_checkpoint(folder)
        except ValueError as error:
            problem = f"folder: {folder} holds an earlier run ({error}); overwrite it, or take another"
            raise FolderError(problem) from error
        if earlier is not None:
            made, wanted = earlier.run.steps_made, earlier.run.steps_wanted
            run = f"a run that made {made} of {wanted} steps"
            raise FolderError(f"folder: {folder} holds {run}; resume it, overwrite it, or take another folder")
    try:
        forget_checkpoints(folder)
        replace_text(folder / WORLD_FILE, json.dumps(world, indent=2) + "\n")
    except OSError as error:
        raise FolderError(f"folder: {folder} cannot be written to: {error.strerror or error}") from error


def mesh_files(folder: Path) -> list[str] | None:
    """The mesh files that the run was started with; None for the built-in robot.

    Raises:
        ValueError: `world.json` cannot be read.
    """
    path = folder / WORLD_FILE
    try:
        files = read_json(path, read_regular(path, _MOST_BYTES)).get("mesh_files")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(one_line(f"{path} cannot be read: {error.strerror or error}")) from error
    if files is not None and not (isinstance(files, list) and all(isinstance(name, str) for name in files)):
        raise ValueError(one_line(f"{path}: mesh_files: expected a list of file names, got {files!r}"))
    return files or None
