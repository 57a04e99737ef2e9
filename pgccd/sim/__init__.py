"""The nanorobot model: very many robots that move, collide, stop and reverse (Du, Liu & Suzumura 2017, section 5).

A run is `run(ModelConfig(...), steps, folder)`; on many ranks, `sim.distributed.run(comm, ...)`. Their parts are public
too, for other simulations.
"""

import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from pgccd.checkpoint.files import CheckpointError
from pgccd.resolution.rounds import Fractions
from pgccd.sim.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.log import LOG_FILE, read_log
from pgccd.sim.model import PATTERNS, Model, ModelConfig, RobotState
from pgccd.sim.pictures import page_of_steps, snapshot_of_state, snapshot_of_step
from pgccd.sim.replay import StepMaker
from pgccd.sim.response import respond
from pgccd.sim.robot import robot_mesh
from pgccd.sim.runner import Run, resume, run
from pgccd.sim.step import Step, StepPlan, make_step

if _TYPE_CHECKING:
    from pgccd.sim import distributed

__all__ = [
    "LOG_FILE",
    "PATTERNS",
    "Checkpoint",
    "CheckpointError",
    "Fractions",
    "RobotState",
    "Run",
    "Step",
    "StepMaker",
    "StepPlan",
    "Model",
    "ModelConfig",
    "contacts_hash",
    "distributed",
    "load_checkpoint",
    "make_step",
    "page_of_steps",
    "read_log",
    "respond",
    "resume",
    "robot_mesh",
    "run",
    "save_checkpoint",
    "snapshot_of_state",
    "snapshot_of_step",
    "state_hash",
]


def __getattr__(name: str) -> _Any:
    if name == "distributed":  # imported on first use: one process needs no ranks
        return _importlib.import_module("pgccd.sim.distributed")
    raise AttributeError(f"module 'pgccd.sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
