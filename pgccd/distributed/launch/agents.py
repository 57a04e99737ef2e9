"""torchrun's agents, one a machine. When a machine joins, they restart all ranks without counting a restart; that
these are to go on with a run, and not to begin it, ranks know by an agent that has had its part in it.
"""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.launch.agreement import on_first

AGENTS_FILE = "agents.json"


def agent_name() -> str | None:
    """Of the agent that started this process: no other has it, on any machine, before or after. None where torchrun did
    not start it, or the system does not say."""
    run, agent = os.environ.get("TORCHELASTIC_RUN_ID"), os.getppid()
    try:
        # After the name in parentheses, which may hold anything: the 22nd field, when it was started.
        started = Path(f"/proc/{agent}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None
    return None if run is None else f"{run} on {socket.gethostname()}: {agent}, {started}"


def note_agents(comm: Comm, folder: Path) -> None:
    """Writes into a run's folder whose ranks make it now."""
    names = sorted(set(_names(comm)))

    def write() -> None:
        path = folder / AGENTS_FILE
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_text(json.dumps(names) + "\n")
        os.replace(unfinished, path)

    if names:
        on_first(comm, write)


def have_agents_here(comm: Comm, folder: Path) -> bool | None:
    """Whether one of the agents of these ranks was noted there; None where no rank knows its agent. The same on all."""
    names = _names(comm)

    def noted() -> list[str]:
        path = folder / AGENTS_FILE
        return json.loads(path.read_text()) if path.is_file() else []

    return not set(on_first(comm, noted)).isdisjoint(names) if names else None


def _names(comm: Comm) -> list[str]:
    return [name for name in comm.gather_objects(agent_name()) if name is not None]
