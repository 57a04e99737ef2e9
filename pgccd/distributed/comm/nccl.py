"""Configuration of NCCL: the guard, not NCCL or torch, ends a rank whose messages never arrive, and names the rank at
fault.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

_ERROR_HANDLING = "TORCH_NCCL_ASYNC_ERROR_HANDLING"
# Torch's own monitor marks a lost message in the launcher's store. Restarted ranks would find the mark there and hang.
_MONITOR = ("TORCH_NCCL_ENABLE_MONITORING", "TORCH_NCCL_DUMP_ON_TIMEOUT")
# Seconds that the guard has before torch's watchdog acts, which does not name the rank at fault.
_MARGIN = 60.0


def make_default_group(store: dist.Store, rank: int, size: int, timeout: float) -> Callable[[], bool]:
    """Makes the default process group, with the guard's time-out in seconds.

    Returns:
        A function that returns whether torch has recorded an error in the group.
    """
    patience = timedelta(seconds=timeout + _MARGIN)
    # Messages have priority over concurrent kernels.
    options = dist.ProcessGroupNCCL.Options(is_high_priority_stream=True)
    options._timeout = patience
    with _errors_left_to_the_guard():
        dist.init_process_group("nccl", store=store, rank=rank, world_size=size, timeout=patience, pg_options=options)
    return _watch(dist.group.WORLD)


def _watch(group: Any) -> Callable[[], bool]:
    backend = group._get_backend(torch.device("cuda"))
    return lambda: bool(backend.get_error().name != "SUCCESS")


@contextmanager
def _errors_left_to_the_guard() -> Iterator[None]:
    """Disables torch's error handling for groups made in this context; other groups of the process are not affected."""
    # Otherwise torch ends the process as soon as a message between machines is lost (torchrun sets that), before the
    # guard has found the rank at fault.
    names = (_ERROR_HANDLING, *_MONITOR)
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "0"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
