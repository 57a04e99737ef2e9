"""How NCCL is set up, so that the guard ends a rank whose messages never come: NCCL does not, or names nobody."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist


def options(timeout: timedelta) -> Any:
    """For `torch.distributed.init_process_group`."""
    # Else torch ends the process as soon as a message between machines is lost, before the guard knows who is to blame.
    # torchrun sets it, too.
    os.environ["TORCH_NCCL_ASYNC_ERROR_HANDLING"] = "0"
    # Messages go before what a GPU is doing meanwhile.
    chosen = dist.ProcessGroupNCCL.Options(is_high_priority_stream=True)
    chosen._timeout = timeout
    return chosen


def watch_errors() -> Callable[[], bool]:
    """Tells whether torch has seen an error in the default group."""
    group: Any = dist.group.WORLD
    backend = group._get_backend(torch.device("cuda"))
    return lambda: bool(backend.get_error().name != "SUCCESS")
