"""A run's folder: a run begins only where nothing would be lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pgccd.checkpoint.lock import FolderError
from pgccd.sim.checkpoint import find_checkpoint, forget_checkpoints

WORLD_FILE = "world.json"


def begin(folder: Path, world: dict[str, Any], overwrite: bool) -> None:
    """Lets a new run begin in a folder that is held.

    Args:
        folder: of the run.
        world: for `world.json`.
        overwrite: whether a checkpoint of an earlier run may be removed.

    Raises:
        FolderError: there is one, and it may not.
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
