"""The nanorobot simulation on many ranks, with the results of one process, to the last bit.

`run` and `resume` make whole runs; `DistributedSimulation` makes steps.
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
