"""Are the paths that motion planners return free of contact on the collision meshes, between waypoints too?

    python bench/planners.py --data DIR [--problems N] [--python NAME=PYTHON ...] [--planners NAME ...]

A Panda in scenes of the kinds of MotionBenchMaker. Each planner runs with its default settings in a process of its own,
with the interpreter given by --python where it needs one (MPlib needs an old NumPy); those that are not installed are
skipped with a line. Every path is certified. Beside them OMPL's RRT-Connect whose motions are all certified, and its
motions again by discrete tests. DIR is the folder of the package example-robot-data.
`pip install ompl pin example-robot-data yourdfpy vamp-planner mplib roboplan tesseract-robotics`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import results, timing
from support.planner_process import NOT_INSTALLED, PLANNERS
from support.planning_problems import Arm, problems
from support.touched_paths import Judge, outside, picture

from pgccd.robots import Robot

PROCESS = Path(__file__).parent / "support" / "planner_process.py"


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the folder example-robot-data")
    parser.add_argument("--problems", type=int, default=10, help="of each kind")
    parser.add_argument("--seconds", type=float, default=5.0, help="to plan, where a planner has such a limit")
    parser.add_argument("--planners", nargs="*", default=list(PLANNERS), choices=list(PLANNERS))
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PYTHON", help="a planner's interpreter")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        run(arguments, Path(folder))


def run(arguments: argparse.Namespace, folder: Path) -> None:
    """With files in a folder."""
    arm = Arm(arguments.data, folder)
    posed = list(problems(arm, arguments.problems))
    described = [problem.described() | {"path": str(arm.write(problem))} for problem in posed]
    (folder / "problems.json").write_text(json.dumps(described))
    print(f"{len(posed)} problems")
    judges = [Judge(arm.robot, problem, row["path"]) for problem, row in zip(posed, described, strict=True)]
    skipped: dict[str, str] = {}
    versions: dict[str, str] = {}
    paths: list[dict[str, Any]] = []
    interpreters = dict(each.split("=", 1) for each in arguments.python)
    for name in arguments.planners:
        found, why = plans_of(name, interpreters.get(name.split(",")[0], sys.executable), folder, arguments.seconds)
        if found is None:
            print(f"{name}: skipped: {why}")
            skipped[name] = why
            continue
        versions |= found["versions"]
        paths += judged(name, found["rows"], judges)
    certified: dict[str, Any] = {}
    try:
        from support import certified_planning
    except ImportError as error:
        print(f"ompl, certified: skipped: {error}")
        skipped["ompl, certified"] = str(error)
    else:
        rows, certified = certified_planning.measure(arm, judges, described, arguments.seconds)
        paths += judged("ompl, certified", rows, judges)
    table = [row for name in dict.fromkeys(path["planner"] for path in paths) for row in summary(name, paths)]
    results.table(table)
    print("\npaths that touch, of those found, by kind of problem:")
    of_kinds = by_kind(paths)
    results.table(of_kinds)
    print()
    for key, value in certified.items():
        print(f"{key}: {value}")
    touched = [path for path in paths if path["verdict"] == "COLLISION"]
    own_model = as_spheres(touched, described, interpreters.get("vamp", sys.executable), folder, arm.robot)
    print(f"\nVAMP's paths that touch, where they are deepest: {own_model}")
    print(f"\n{len(touched)} paths touch. What and where:")
    for what, count in Counter(f"{path['names'][0]} and {path['names'][1]}" for path in touched).most_common(12):
        print(f"{count:4d}  {what}")
    print(f"without an independent sample that collides: {sum(not path['by coal'] for path in touched)}")
    unsolved = Counter(f"{path['planner']}: {path['failed']}" for path in paths if path["path"] is None)
    content: dict[str, Any] = {"planners": versions, "skipped": skipped, "seconds": arguments.seconds, "rows": table}
    content |= {"kinds": of_kinds, "unsolved": unsolved, "certified": certified}
    content |= {"as spheres": own_model, "touched": [shortened(path) for path in touched]}
    written = results.write("planners", "cpu", content, arguments.out)
    if touched:
        picture(touched, {(judge.problem.kind, judge.problem.number): judge for judge in judges}, written)


def plans_of(
    name: str, python: str, folder: Path, seconds: float, asked: str = "problems"
) -> tuple[dict[str, Any] | None, str]:
    """What a planner's process found, or why it did not run."""
    result = folder / f"{name.replace(', ', '_')}_of_{asked}.json"
    command = [python, str(PROCESS), name, str(folder / f"{asked}.json"), str(result), "--seconds", str(seconds)]
    # Another interpreter has packages of its own.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH" or python == sys.executable}
    environment |= {"OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1500, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, f"{type(error).__name__}"
    if done.returncode == NOT_INSTALLED:
        return None, done.stdout.strip().split("\n")[-1]
    if done.returncode != 0 or not result.is_file():
        return None, f"exit status {done.returncode}: {(done.stderr.strip().split(chr(10)) or [''])[-1]}"
    return json.loads(result.read_text()), ""


def as_spheres(
    touched: list[dict[str, Any]], described: list[dict[str, Any]], python: str, folder: Path, robot: Robot
) -> dict[str, Any]:
    """By kind of path, how many of VAMP's paths that touch are free for its spheres where they are deepest, and how far
    the collision meshes are outside of its spheres. Its other paths touch between its samples.
    """
    own = [path for path in touched if path["planner"] == "vamp" and path["deepest"] is not None]
    if not own:
        return {}
    by_problem = {(row["kind"], row["number"]): row for row in described}
    asked = [by_problem[path["kind"], path["number"]] | {"check": path["deepest"]} for path in own]
    (folder / "checks.json").write_text(json.dumps(asked))
    found, why = plans_of("vamp", python, folder, 0.0, "checks")
    if found is None:
        raise RuntimeError(f"VAMP does not check its paths: {why}")
    counts: dict[str, Any] = {}
    for path, row in zip(own, found["rows"], strict=True):
        count = counts.setdefault(path["path"], {"touch": 0, "free as spheres": 0})
        count["touch"] += 1
        count["free as spheres"] += row["valid"]
    away, link = outside(robot, own[0]["deepest"], found["rows"][0]["spheres"])
    return counts | {"surface outside of spheres, mm": timing.rounded(1e3 * away), "of": link}


def judged(name: str, rows: list[dict[str, Any]], judges: list[Judge]) -> list[dict[str, Any]]:
    """A row for each path of a planner, and for each problem without one."""
    found = []
    for row, judge in zip(rows, judges, strict=True):
        of_problem = {"planner": name, "kind": row["kind"], "number": row["number"]}
        if not row["paths"]:
            found.append(of_problem | {"path": None, "verdict": None, "failed": row["failed"]})
        for path in row["paths"]:
            of_path = {"path": path["name"], "seconds": path["seconds"], "waypoints": len(path["q"])}
            found.append(of_problem | of_path | judge.verdict(np.array(path["q"])))
    return found


def summary(name: str, paths: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row of the table for each kind of path of a planner."""
    own = [path for path in paths if path["planner"] == name]
    asked = len({(path["kind"], path["number"]) for path in own})
    rows = []
    for kind in dict.fromkeys(path["path"] for path in own if path["path"] is not None):
        some = [path for path in own if path["path"] == kind]
        verdicts = Counter(path["verdict"] for path in some)
        depths = [path["depth"] for path in some if path["verdict"] == "COLLISION"]
        certificates = [path["certificate"] for path in some if not path["within"]]
        rows.append(
            {
                "planner": name,
                "path": kind,
                "problems": asked,
                "solved": len(some),
                "free": verdicts["FREE"],
                "of them within the resolution": sum(path["within"] for path in some if path["verdict"] == "FREE"),
                "collision": verdicts["COLLISION"],
                "near": verdicts["NEAR"],
                "deepest, mm": 1e3 * max(depths) if depths else None,
                "median, mm": 1e3 * float(np.median(depths)) if depths else None,
                "plan, ms": 1e3 * float(np.median([path["seconds"] for path in some])),
                "certificate of a free path, ms": 1e3 * float(np.median(certificates)) if certificates else None,
            }
        )
    return [{key: timing.rounded(v) if isinstance(v, float) else v for key, v in row.items()} for row in rows]


def shortened(path: dict[str, Any]) -> dict[str, Any]:
    """A path that touches, as written to JSON: lengths in millimetres."""
    of_path = {key: path[key] for key in ("planner", "path", "kind", "number", "waypoints", "names", "by coal")}
    lengths = {"depth, mm": 1e3 * path["depth"], "time": path["time"], "longest, rad": path["longest"]}
    return of_path | {key: timing.rounded(value) for key, value in lengths.items()}


def by_kind(paths: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each kind of path of a planner and each kind of problem how many paths touch, and of how many."""
    kinds = list(dict.fromkeys(path["kind"] for path in paths))
    rows = []
    for planner, kind_of_path in dict.fromkeys((path["planner"], path["path"]) for path in paths if path["path"]):
        row = {"planner": planner, "path": kind_of_path}
        for kind in kinds:
            some = [
                path for path in paths if (path["planner"], path["path"], path["kind"]) == (planner, kind_of_path, kind)
            ]
            row[kind] = f"{sum(path['verdict'] == 'COLLISION' for path in some)} / {len(some)}"
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()
