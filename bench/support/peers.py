"""Loading of the other programs that pgccd is compared with. Each may be missing."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from typing import Any


def load(name: str) -> Any | None:
    """The module, or None with a message."""
    try:
        with _quiet():  # some print on import
            return importlib.import_module(name)
    except ImportError:
        print(f"{name}: not installed")
        return None


def load_ipctk() -> Any | None:
    """IPC Toolkit on one thread, without its warnings about queries that touch at the start."""
    ipctk = load("ipctk")
    if ipctk is not None:
        ipctk.set_num_threads(1)
        ipctk.set_logger_level(ipctk.LoggerLevel.off)
    return ipctk


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    kept = os.dup(1)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)
