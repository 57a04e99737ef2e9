"""A run's folder, protected against overwriting."""

import json
from pathlib import Path
from typing import Any

from pgccd.checkpoint.lock import FolderError
from pgccd.sim.checkpoint import find_checkpoint, forget_checkpoints

WORLD_FILE = "world.json"


def begin(folder: Path, world: dict[str, Any], overwrite: bool) -> None:
    """Prepares a locked folder for a new run.

    Args:
        folder: of the run.
        world: content of `world.json`.
        overwrite: whether a checkpoint of an earlier run may be removed.

    Raises:
        FolderError: the folder holds an earlier run, and `overwrite` is False.
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
    forget_checkpoints(folder)
    (folder / WORLD_FILE).write_text(json.dumps(world, indent=2) + "\n")
