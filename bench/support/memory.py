"""Peak memory of a piece of work."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from pathlib import Path
from types import TracebackType

import torch


class PeakMemory:
    """`bytes`: how far memory rose above where it stood on entry. On a GPU what torch allocated, on a CPU resident
    pages.

    On a CPU this is meant for all of a piece of work, from its first allocation on. `bytes_before`: where it stood.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.bytes = 0
        self.bytes_before = 0

    def __enter__(self) -> PeakMemory:
        self.bytes_before = bytes_in_use(self.device)
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        peak = torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else _status("VmHWM")
        self.bytes = max(0, peak - self.bytes_before)


def bytes_in_use(device: torch.device | str) -> int:
    """What torch has allocated on a GPU, or the resident pages."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    # What earlier work has freed must go back to the system, or it would be used again unseen.
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # GNU's C library has it
        ctypes.CDLL(None).malloc_trim(0)
    return _status("VmRSS")


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"/proc/self/status has no {field}")
