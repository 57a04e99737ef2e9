"""The nanorobot world: very many robots that move, collide, stop and turn round (Du, Liu & Suzumura 2017, section 5).

A run is `run(WorldConfig(...), steps, folder)`. Its parts are here too, for worlds that are put together differently.
"""

from pgccd.sim.files import LOG_FILE, Checkpoint, load_checkpoint, read_log, save_checkpoint
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.response import Exchange, Settlement, first_collisions, respond, settle
from pgccd.sim.robot import robot_mesh
from pgccd.sim.runner import Run, resume, run
from pgccd.sim.step import Step, make_step
from pgccd.sim.world import PATTERNS, RobotState, World, WorldConfig

__all__ = [
    "LOG_FILE",
    "PATTERNS",
    "Checkpoint",
    "Exchange",
    "RobotState",
    "Run",
    "Settlement",
    "Step",
    "World",
    "WorldConfig",
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
    "settle",
    "state_hash",
]
