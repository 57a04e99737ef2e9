"""The nanorobot model: very many robots that move, collide, stop and turn round (Du, Liu & Suzumura 2017, section 5).

A run is `run(ModelConfig(...), steps, folder)`. Its parts are here too, for worlds that are put together differently.
"""

from pgccd.sim.files import LOG_FILE, Checkpoint, load_checkpoint, read_log, save_checkpoint
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.model import PATTERNS, Model, ModelConfig, RobotState
from pgccd.sim.response import Exchange, Resolution, first_collisions, resolve_collisions, respond
from pgccd.sim.robot import robot_mesh
from pgccd.sim.runner import Run, resume, run
from pgccd.sim.step import Step, make_step

__all__ = [
    "LOG_FILE",
    "PATTERNS",
    "Checkpoint",
    "Exchange",
    "RobotState",
    "Run",
    "Resolution",
    "Step",
    "Model",
    "ModelConfig",
    "contacts_hash",
    "first_collisions",
    "load_checkpoint",
    "make_step",
    "read_log",
    "respond",
    "resume",
    "robot_mesh",
    "run",
    "save_checkpoint",
    "resolve_collisions",
    "state_hash",
]
