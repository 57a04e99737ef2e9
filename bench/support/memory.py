"""Peak memory of a piece of work."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from pathlib import Path
from types import TracebackType

import torch


class PeakMemory:
    """`bytes`: peak memory above that on entry: torch's allocations on a GPU, resident pages on a CPU.

    On a CPU, enter it before the first allocation of the work. `bytes_before`: memory on entry.
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
    """Bytes allocated by torch on a GPU, or resident bytes."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    # Freed memory must be returned to the system, otherwise its reuse would not be counted.
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)
    return _status("VmRSS")


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"/proc/self/status has no {field}")
