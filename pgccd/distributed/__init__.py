"""Detection on many ranks: one process per GPU (or CPU core), on any number of machines.

`World` distributes a scene over ranks; `connect` connects the ranks that were launched together. (`pgccd.sim.run(...,
comm=comm)` runs the nanorobot simulation.) Results are equal, bit by bit, for any number of ranks.
"""

from pgccd.checkpoint.files import CheckpointError
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.comm.mpi_comm import MpiComm
from pgccd.distributed.comm.torch_comm import TorchComm
from pgccd.distributed.detection.options import RankOptions
from pgccd.distributed.guard import RankFailureError
from pgccd.distributed.launch.agreement import DisagreementError
from pgccd.distributed.launch.connect import choose_device, connect
from pgccd.distributed.launch.placement import Placement, find_placement
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.bisection import Bisection
from pgccd.distributed.partition.cells import Cells
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.world.functions import Bodies
from pgccd.distributed.world.loop import CapturedWorld
from pgccd.distributed.world.options import WorldOptions
from pgccd.distributed.world.resolve import WorldResolution
from pgccd.distributed.world.world import World
from pgccd.distributed.world.world_graphs import WorldStep

__all__ = [
    "Alone",
    "BalanceOptions",
    "Bisection",
    "Bodies",
    "CapturedWorld",
    "Cells",
    "CheckpointError",
    "Comm",
    "DisagreementError",
    "MpiComm",
    "Partition",
    "Placement",
    "RankFailureError",
    "RankOptions",
    "TorchComm",
    "World",
    "WorldOptions",
    "WorldResolution",
    "WorldStep",
    "choose_device",
    "connect",
    "find_placement",
]


def __dir__() -> list[str]:
    return sorted(__all__)
