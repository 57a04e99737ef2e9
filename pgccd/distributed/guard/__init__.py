"""Finds the rank at fault when a message does not arrive: one that died, hangs, or reported a failure.

Every rank keeps a connection to a hub on rank 0. The operating system closes it when the process ends, so a rank counts
as dead when its connection is closed, not when the rank is slow. Hanging ranks are searched for only after a rank has
waited longer than the time-out: the hub then queries all P ranks.

torchrun, mpirun and srun end a job when one of its processes dies, but do not find the cause, and do not detect a
hanging rank.

Every rank also tells the hub the name and number of each public call, without waiting for an answer. Ranks that make
different calls would wait for each other forever, or mistake messages of other calls for their own.
"""

from __future__ import annotations

from pgccd.distributed.guard.calls import collective
from pgccd.distributed.guard.guard import Guard, RankFailureError, is_of_all_ranks, of_all_ranks
from pgccd.distributed.guard.hub import Hub

__all__ = ["Guard", "Hub", "RankFailureError", "collective", "is_of_all_ranks", "of_all_ranks"]
