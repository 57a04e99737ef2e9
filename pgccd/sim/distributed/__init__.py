"""The nanorobot simulation on many ranks, with results bitwise equal to those of one process.

`run` and `resume` perform whole runs; `DistributedSimulation` performs steps.
"""

from pgccd.sim.distributed.runner import DistributedOptions, resume, run
from pgccd.sim.distributed.simulation import DistributedSimulation, RankStep, starting_share

__all__ = [
    "DistributedOptions",
    "DistributedSimulation",
    "RankStep",
    "resume",
    "run",
    "starting_share",
]


def __dir__() -> list[str]:
    return sorted(__all__)
