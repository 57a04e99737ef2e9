"""`pgccd` with a file size limit on rank 1, to act as a full disk."""

from __future__ import annotations

import os
import resource
import signal
import sys

from pgccd.cli import main
from pgccd.distributed import find_placement

if "PMI_RANK" in os.environ or "OMPI_COMM_WORLD_RANK" in os.environ:
    from mpi4py import MPI  # noqa: F401  # whose own files may be large

if find_placement().rank == 1:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
sys.exit(main(sys.argv[1:]))
