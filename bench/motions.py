"""Motions between two configurations, as planners ask for them: one by one, in a batch, and on a GPU.

    python bench/motions.py [--data DIR] [--device cuda] [--problems N] [--rounds N]

An arm of six joints whose links are capsules of 320 triangles, and with --data (the folder of the package
example-robot-data) a Panda, each among eight boxes in random places. The motions are those that RRT-Connect asks for
on its way between random configurations; states are checked besides. Times are of one thread.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import results, timing

import pgccd
from pgccd.robots import MotionValidator, Obstacles, Robot, load_urdf

PANDA = ("panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf")
BATCHES = (1_000, 10_000, 100_000)
# RRT-Connect: the longest step, and how often a tree is grown at most.
STEP, GROWTHS = 1.5, 400


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, help="the folder example-robot-data")
    parser.add_argument("--device", default="cpu", help="of the batches: cpu or cuda")
    parser.add_argument("--problems", type=int, default=20, help="pairs of configurations to plan between")
    parser.add_argument("--rounds", type=int, default=5, help="calls timed of each batch")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(name, arguments) for name in ("capsules", "Panda") if name == "capsules" or arguments.data]
    results.table(rows)
    results.write("motions", arguments.device, {"problems": arguments.problems, "rows": rows}, arguments.out)


def measure(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """One row: times of a robot's motions."""
    if name == "capsules":
        robot = capsule_arm()
    else:
        urdf, srdf = (arguments.data / "robots" / part for part in PANDA)
        robot = load_urdf(urdf, srdf, packages={"example-robot-data": arguments.data}).excluding_sampled(300)
    rng = np.random.default_rng(1)
    places = robot.reach * rng.uniform(-0.5, 0.5, (8, 3)) + [0.0, 0.0, 0.3]
    obstacles = Obstacles([pgccd.Mesh.box([0.15] * 3)], torch.tensor(places), mesh_index=[0] * 8)
    is_valid = robot.motion_validator(obstacles)
    edges, plans = ask(robot, is_valid, arguments.problems, rng)
    row: dict[str, Any] = {"robot": name, "triangles": sum(mesh.triangle_count for mesh in robot.meshes)}
    row |= {"plans": len(plans), "plan, ms": 1e3 * float(np.median(plans)), "motions": len(edges)}
    spent = []
    free = 0
    is_valid = is_valid.clone()
    for start, goal in edges:
        begin = time.perf_counter()
        free += is_valid(start, goal)
        spent.append(time.perf_counter() - begin)
    row |= {"free": free, "one, ms": 1e3 * float(np.median(spent)), "one, 99 %": 1e3 * float(np.quantile(spent, 0.99))}
    states = torch.tensor([start for start, _ in edges], dtype=torch.float64)
    seconds, _ = timing.seconds(lambda: is_valid.check_states(states))
    row["state, ms"] = 1e3 * seconds / len(states)
    motions = torch.tensor(edges, dtype=torch.float64)
    for size in BATCHES if arguments.device == "cuda" else BATCHES[:1]:
        some = motions[torch.arange(size) % len(motions)].to(arguments.device)
        found = robot.certify(some, obstacles)
        call = partial(robot.certify, some, obstacles)
        least = min(timing.seconds(call, arguments.device)[0] for _ in range(arguments.rounds))
        row |= {f"{size}: motions a second": round(size / least), "tests a motion": found.steps / size}
    return {key: timing.rounded(value) if isinstance(value, float) else value for key, value in row.items()}


def capsule_arm() -> Robot:
    """Six joints about z and y in turn; links of 0.3, thinner towards the end."""
    with tempfile.TemporaryDirectory() as folder:
        links = '<link name="base"/>'
        for k in range(6):
            ball = pgccd.Mesh.icosphere(0.06 - 0.006 * k, 2)
            along = ball.vertices.clone()
            along[:, 0] += torch.where(along[:, 0] > 0.0, 0.22, 0.08)
            rows = [("v", along), ("f", ball.faces + 1)]
            lines = [f"{kind} {x} {y} {z}" for kind, column in rows for x, y, z in column.tolist()]
            Path(folder, f"{k}.obj").write_text("\n".join(lines))
            at = f"{0.3 if k else 0.0} 0 {0.0 if k else 0.3}"
            before, axis = f"link{k - 1}" if k else "base", "0 0 1" if k % 2 == 0 else "0 1 0"
            links += f"""<link name="link{k}">
            <collision><geometry><mesh filename="{folder}/{k}.obj"/></geometry></collision></link>
            <joint name="joint{k}" type="revolute"><parent link="{before}"/><child link="link{k}"/>
            <origin xyz="{at}"/><axis xyz="{axis}"/>
            <limit lower="-2.9" upper="2.9" effort="1" velocity="1"/></joint>"""
        Path(folder, "arm.urdf").write_text(f'<robot name="capsules">{links}</robot>')
        return load_urdf(Path(folder, "arm.urdf"))


def ask(
    robot: Robot, is_valid: MotionValidator, problems: int, rng: np.random.Generator
) -> tuple[list[tuple[list[float], list[float]]], list[float]]:
    """The motions that RRT-Connect asks for, and the time of each plan that it finds, without its tests of states."""
    low, high = (limit.numpy().clip(-np.pi, np.pi) for limit in (robot.lower, robot.upper))
    ends = rng.uniform(low, high, (20 * problems, robot.joint_count))
    ends = ends[is_valid.check_states(torch.from_numpy(ends)).numpy()][: 2 * problems]
    edges: list[tuple[list[float], list[float]]] = []
    plans = []

    def extend(tree: list[np.ndarray], target: np.ndarray) -> bool:
        away = np.linalg.norm(np.stack(tree) - target, axis=1)
        nearest = tree[int(away.argmin())]
        to = target if away.min() <= STEP else nearest + STEP / away.min() * (target - nearest)
        edges.append((nearest.tolist(), to.tolist()))
        if is_valid(*edges[-1]):
            tree.append(to)
            return True
        return False

    for start, goal in ends.reshape(-1, 2, robot.joint_count):
        trees, begin = ([start], [goal]), time.perf_counter()
        for k in range(GROWTHS):
            grown, other = trees[k % 2], trees[1 - k % 2]
            if not extend(grown, rng.uniform(low, high)):
                continue
            while extend(other, grown[-1]) and other[-1] is not grown[-1]:
                pass
            if other[-1] is grown[-1]:
                plans.append(time.perf_counter() - begin)
                break
    return edges, plans


if __name__ == "__main__":
    main()
