"""Prints the addresses on which this job's processes listen, one per line, in Linux's notation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pgccd.distributed import connect


def own_listeners() -> set[str]:
    links = (os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd") if _exists(name))
    sockets = {link[len("socket:[") : -1] for link in links if link.startswith("socket:[")}
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in sockets:
                found.add(fields[1].split(":")[0])
    return found


def _exists(name: str) -> bool:
    return os.path.lexists(f"/proc/self/fd/{name}")


with connect("cpu", "gloo") as comm:
    _ = comm.background
    for addresses in comm.gather_objects(sorted(own_listeners())):
        sys.stdout.write(f"listens: {sorted(addresses)}\n")
