"""Detection on many ranks: one process per GPU (or CPU core), on any number of machines.

`World` distributes a scene over ranks; `connect` connects the ranks that were launched together.
(`pgccd.sim.distributed` runs the nanorobot simulation.) Results are bitwise equal for any number of ranks.
"""

from pgccd.checkpoint.files import CheckpointError
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.comm.mpi_comm import MpiComm
from pgccd.distributed.comm.torch_comm import TorchComm
from pgccd.distributed.guard import RankFailureError
from pgccd.distributed.launch.agreement import DisagreementError, on_first, require_agreement, together
from pgccd.distributed.launch.connect import choose_device, connect
from pgccd.distributed.launch.placement import Placement, find_placement
from pgccd.distributed.partition.balance import POLICIES, BalanceOptions, CellLoads, imbalance, rebalance
from pgccd.distributed.partition.bisection import Bisection
from pgccd.distributed.partition.cells import Cells, factorise
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.world.captured import Bodies, CapturedWorld, WorldStep
from pgccd.distributed.world.world import World

__all__ = [
    "POLICIES",
    "Alone",
    "BalanceOptions",
    "Bisection",
    "Bodies",
    "CapturedWorld",
    "CellLoads",
    "Cells",
    "CheckpointError",
    "Comm",
    "DisagreementError",
    "MpiComm",
    "Partition",
    "Placement",
    "RankFailureError",
    "TorchComm",
    "World",
    "WorldStep",
    "choose_device",
    "connect",
    "factorise",
    "find_placement",
    "imbalance",
    "on_first",
    "rebalance",
    "require_agreement",
    "together",
]
