"""Results: JSON with machine, versions and command, and a short table on stdout."""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

import pgccd
from pgccd import ops

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "bench" / "results"
_PEERS = ("coal", "ipctk", "mujoco", "newton", "pybullet", "python-fcl", "scipy", "warp-lang")


_begin = time.perf_counter()


def _busy_seconds() -> float:
    """Processor time of the whole machine since it started."""
    user, nice, system, _idle, _waiting, *rest = Path("/proc/stat").read_text().split("\n")[0].split()[1:8]
    return sum(map(int, (user, nice, system, *rest))) / os.sysconf("SC_CLK_TCK")


def _own_seconds() -> float:
    """Processor time of this process and of its child processes that have ended."""
    return sum(os.times()[:4])


_busy_before = _busy_seconds() - _own_seconds()


def cores_busy_with_others() -> float:
    """Mean number of cores used by other processes since this one started: above about 0.1, times are doubtful."""
    others = _busy_seconds() - _own_seconds() - _busy_before
    return round(max(0.0, others / (time.perf_counter() - _begin)), 2)


def parser(description: str | None) -> argparse.ArgumentParser:
    """A parser with the arguments common to all scripts."""
    shared = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    shared.add_argument("--out", type=Path, help="file or folder for the result (default: bench/results)")
    return shared


def write(name: str, device: torch.device | str, content: dict[str, Any], out: Path | None = None) -> Path:
    """Writes `content` with its provenance. The default file name is made of the script and the device."""
    device_name = "cpu" if torch.device(device).type == "cpu" else torch.cuda.get_device_name(device)
    path = FOLDER / f"{name}-{re.sub('[^a-z0-9]+', '-', device_name.lower()).strip('-')}.json"
    if out is not None:
        path = out / path.name if out.is_dir() else out
    path.parent.mkdir(parents=True, exist_ok=True)
    made = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "command": command_line(),
        "device": describe_device(device),
        "cores_busy_with_others": cores_busy_with_others(),
        "versions": versions(),
    }
    path.write_text(json.dumps({"name": name, "made": made, **content}, indent=1) + "\n")
    print(f"\nwritten: {path.name} (other processes kept {made['cores_busy_with_others']} cores busy)")
    return path


def read(path: Path) -> dict[str, Any]:
    """A result written by `write`."""
    return json.loads(path.read_text())


def command_line() -> str:
    """The command, without machine-specific folders and without --out."""
    words = [str(Path(word).resolve().relative_to(ROOT)) if _is_inside(word) else word for word in sys.argv[:1]]
    for before, word in itertools.pairwise(sys.argv):
        if "--out" not in (before, word):
            words.append(Path(word).name if os.path.isabs(word) else word)
    return " ".join(["python", *words])


def _is_inside(word: str) -> bool:
    return Path(word).resolve().is_relative_to(ROOT)


def describe_device(device: torch.device | str) -> dict[str, Any]:
    """The processor, and the GPU if one was used."""
    described: dict[str, Any] = {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
    }
    if torch.device(device).type == "cuda":
        described["gpu"] = torch.cuda.get_device_name(device)
    return described


def _cpu_model() -> str:
    fields: dict[str, str] = {}
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        key, _, value = line.partition(":")
        fields.setdefault(key.strip(), value.strip())
    # Virtual machines may shorten the name, but these numbers identify the model.
    numbers = [f"{key} {fields[key]}" for key in ("cpu family", "model", "stepping") if key in fields]
    return ", ".join([fields.get("model name", platform.machine()), *numbers])


def versions() -> dict[str, str]:
    """Versions of pgccd (with commit), torch, and the installed peers."""
    found = {
        "pgccd": pgccd.__version__,
        "commit": _commit(),
        "extension": ops.build_information()["commit"],
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    for peer in _PEERS:
        try:
            found[peer] = importlib.metadata.version(peer)
        except importlib.metadata.PackageNotFoundError:
            found[peer] = "not installed"
    return found


def _commit() -> str:
    try:
        # The repository of the imported package.
        git = ["git", "-C", str(Path(pgccd.__file__).parents[1])]
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        # Only compiled or imported files: results may be written while documentation is being edited.
        status = [*git, "status", "--porcelain", "--", "csrc", "pgccd", "setup.py", "build_support"]
        changed = subprocess.run(status, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.stdout.strip() + ("-dirty" if changed.strip() else "")


def table(rows: list[dict[str, Any]]) -> None:
    """Prints rows with equal keys as aligned columns."""
    if not rows:
        return
    columns = list(rows[0])
    cells = [[_text(row.get(column)) for column in columns] for row in rows]
    widths = [max(len(column), *(len(row[k]) for row in cells)) for k, column in enumerate(columns)]
    for row in [columns, *cells]:
        first, *rest = (
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        print("  ".join([first, *rest]))


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
