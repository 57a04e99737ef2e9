"""Simulates several machines on this one, to run more NCCL ranks than there are GPUs.

    torchrun ... -m support.machines -m MODULE | FILE, ARGUMENTS

NCCL requires a separate GPU for every rank of a machine. With different NCCL_HOSTID values it treats ranks as running
on several machines, lets one rank of each share a GPU, and uses sockets between machines.
"""

import os
import runpy
import sys

import torch

machine = int(os.environ["LOCAL_RANK"]) // torch.cuda.device_count()
os.environ |= {"NCCL_HOSTID": f"machine {machine}", "NCCL_IB_DISABLE": "1", "NCCL_MNNVL_ENABLE": "0"}
del sys.argv[0]
if sys.argv[0] == "-m":
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
else:
    runpy.run_path(sys.argv[0], run_name="__main__")
