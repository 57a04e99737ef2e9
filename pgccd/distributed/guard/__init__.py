"""Finds the cause when a message does not come: a rank that died, hangs, or reported a failure.

Every rank keeps a connection to a hub on rank 0. The operating system closes it when the process ends, however busy its
interpreter was before: so a rank is dead when its connection is closed, and never because it is slow. Whether a rank
hangs is asked only when another has waited for longer than the time-out; of P ranks, P are asked.

torchrun, mpirun and srun end a job when a process of theirs dies, but do not find the cause, and do not notice a rank
that hangs.
"""

from __future__ import annotations

from pgccd.distributed.guard.guard import Guard, RankFailureError, is_of_all_ranks, of_all_ranks
from pgccd.distributed.guard.hub import Hub

__all__ = ["Guard", "Hub", "RankFailureError", "is_of_all_ranks", "of_all_ranks"]
