"""Watches torchrun's agent, the process that launches the ranks of a machine, while the ranks start; later the guard
does.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_TURN_SECONDS = 0.2
_EXIT_CODE = 70


@contextmanager
def watching_agent(rank: int) -> Iterator[None]:
    """Ends this process if torchrun's agent dies meanwhile. Otherwise the process would wait until the time-out, in
    calls that cannot be interrupted, for the agent's store or for ranks that the agent no longer starts.

    Args:
        rank: of this process.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:  # other launchers end their ranks
        yield
        return
    agent, is_over = os.getppid(), threading.Event()

    def watch() -> None:
        while not is_over.wait(_TURN_SECONDS):
            if os.getppid() != agent:
                where = " ".join(f"{name}={os.environ.get(name)}" for name in ("MASTER_ADDR", "MASTER_PORT"))
                sys.stderr.write(
                    f"pgccd: rank {rank} ends: torchrun's agent, process {agent}, which launched it, has died while "
                    f"the ranks connected ({where})\n"
                )
                sys.stderr.flush()
                os._exit(_EXIT_CODE)

    thread = threading.Thread(target=watch, name="pgccd-agent", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
