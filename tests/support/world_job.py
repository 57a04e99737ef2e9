"""Detection by ranks that torchrun started, on the given device: equal to the contacts of one CPU process."""

from __future__ import annotations

import sys

import torch
from distributed.world import test_world

from pgccd.distributed import choose_device, connect

torch.set_num_threads(1)
with connect(sys.argv[1]) as comm:
    for name in sys.argv[2:]:
        seen = test_world.find(comm, name, choose_device(sys.argv[1]))
        assert max(contacts for contacts, _ in seen) > 0, "nothing collides: nothing was tested"
