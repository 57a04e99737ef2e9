"""The nanorobot model: very many robots that move, collide, stop and reverse (Du, Liu & Suzumura 2017, section 5).

A run is `run(ModelConfig(...), steps, folder)`; on many ranks, every rank calls `run(..., comm=comm)`. The parts of a
run are public too, for other simulations.
"""

from pgccd.checkpoint.files import CheckpointError
from pgccd.resolution.rounds import Fractions
from pgccd.sim.log import LOG_FILE, read_log
from pgccd.sim.model import PATTERNS, Model, ModelConfig, RobotState
from pgccd.sim.nanorobot import robot_mesh
from pgccd.sim.pictures import page_of_steps, snapshot_of_state, snapshot_of_step
from pgccd.sim.response import respond
from pgccd.sim.run_checkpoint import Checkpoint, load_checkpoint
from pgccd.sim.runner import Run, resume, run
from pgccd.sim.simulation import Simulation, starting_share
from pgccd.sim.state_hashes import contacts_hash, state_hash
from pgccd.sim.step import Step
from pgccd.sim.step_graph import CommittedStep

__all__ = [
    "LOG_FILE",
    "PATTERNS",
    "Checkpoint",
    "CheckpointError",
    "CommittedStep",
    "Fractions",
    "RobotState",
    "Run",
    "Simulation",
    "Step",
    "Model",
    "ModelConfig",
    "contacts_hash",
    "load_checkpoint",
    "page_of_steps",
    "read_log",
    "respond",
    "resume",
    "robot_mesh",
    "run",
    "snapshot_of_state",
    "snapshot_of_step",
    "starting_share",
    "state_hash",
]


def __dir__() -> list[str]:
    return sorted(__all__)
