"""Mesh files and robots of public packages: how many `pgccd.Mesh.load`, `load_urdf` and `load_mjcf` read, and what they
say of the others.

Folders are those of packages of PyPI: installed, or wheels that `pip download --no-deps` brought, unpacked.

    python bench/real_files.py --package example-robot-data 6.0.0 DIR --package pybullet 3.2.7 DIR
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from support import results

import pgccd
from pgccd.robots import load_mjcf, load_urdf

MESHES = (".3mf", ".dae", ".glb", ".gltf", ".msh", ".obj", ".off", ".ply", ".stl")


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--package", nargs=3, action="append", required=True, metavar=("NAME", "VERSION", "DIR"))
    arguments = parser.parse_args()
    rows, refusals = [], []
    for name, version, folder in arguments.package:
        for kind, files, load in kinds(Path(folder)):
            outcomes = [(path, outcome(load, path).replace(str(folder), name)) for path in files]
            refused = [(path, said) for path, said in outcomes if said]
            row = {"package": name, "version": version, "files": kind, "count": len(files)}
            rows.append(row | {"loaded": len(files) - len(refused), "refused": len(refused)})
            for path, said in refused:
                refusals.append({"package": name, "file": str(path.relative_to(folder)), "message": said})
    results.table(rows)
    for said, count in Counter(general(each["message"]) for each in refusals).most_common():
        print(f"{count:5} {said}")
    results.write("real_files", "cpu", {"rows": rows, "refused": refusals}, arguments.out)


def kinds(folder: Path) -> Iterator[tuple[str, list[Path], Callable[[Path], Any]]]:
    """The kinds of files in a folder: their name, the files, and what loads one."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for suffix in MESHES:
        if found := [path for path in files if path.suffix.lower() == suffix]:
            yield suffix[1:], found, pgccd.Mesh.load
    if found := [path for path in files if path.suffix.lower() == ".urdf"]:
        yield "URDF", found, load_urdf
    if found := [path for path in files if path.suffix.lower() == ".xml" and b"<mujoco" in path.read_bytes()]:
        yield "MJCF", found, load_mjcf


def outcome(load: Callable[[Path], Any], path: Path) -> str:
    """Nothing if the file is loaded, else the error. Others than the documented ones end the benchmark."""
    try:
        load(path)
    except (ValueError, OSError, ImportError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


def general(message: str) -> str:
    """A message without names and numbers."""
    return re.sub(r"'[^']*'|\S*[/\\]\S*|\S+\.\w{3,4}\b|-?\d[\d.e+-]*", "*", message)


if __name__ == "__main__":
    main()
