"""Configuration of NCCL: the guard, not NCCL or torch, ends a rank whose messages never arrive, and names the rank at
fault.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

# Without torch's error handling, which ends the process as soon as a message between machines is lost (torchrun sets
# it), before the guard has found the rank at fault; and without its monitor, which marks a lost message in the
# launcher's store, where restarted ranks would find the mark and hang.
_ERRORS_LEFT_TO_THE_GUARD = {
    "TORCH_NCCL_ASYNC_ERROR_HANDLING": "0",
    "TORCH_NCCL_ENABLE_MONITORING": "0",
    "TORCH_NCCL_DUMP_ON_TIMEOUT": "0",
}
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
    with _environment(_ERRORS_LEFT_TO_THE_GUARD):  # other groups of the process are not affected
        dist.init_process_group("nccl", store=store, rank=rank, world_size=size, timeout=patience, pg_options=options)
    return _watch(dist.group.WORLD)


def _watch(group: Any) -> Callable[[], bool]:
    backend = group._get_backend(torch.device("cuda"))
    return lambda: bool(backend.get_error().name != "SUCCESS")


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """A context in which these environment variables of the process are set."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
