"""Certificates of paths of planners; where and how deep the paths touch that are not free."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pgccd
from pgccd.robots import Robot, Verdict
from pgccd.robots.kinematics import turned
from support.planner_process import Discrete
from support.planning_problems import Problem

# Contact is told apart from nearness at this resolution, length units: far below that of meshes and joints.
FINE = 1e-6
# Paths that touch are sampled with joints that move by this much, radians; depth is that of so many of the samples.
STEP, DEPTHS = 0.001, 10
# Directions in which links are moved out of what they touch.
DIRECTIONS = 60
# Random points of a surface.
POINTS = 4000
# Kinds of problems in which obstacles hide little.
OPEN_KINDS = ("table bars", "cage")
# Waypoints of planners with single precision differ by this much from start and goal.
END_TOLERANCE = 1e-5


class Judge:
    """Certifies the paths of a problem.

    Args:
        robot: the arm.
        problem: the problem.
        path: of its URDF and SRDF, without an ending, for the independent checks.
    """

    def __init__(self, robot: Robot, problem: Problem, path: str) -> None:
        self.robot, self.problem, self._path = robot, problem, path
        self.obstacles = problem.obstacles()
        self._is_valid = robot.motion_validator(self.obstacles)
        self.scene = robot.scene(self.obstacles)

    def verdict(self, q: np.ndarray) -> dict[str, Any]:
        """Columns of a row: of a path (T, 7).

        Raises:
            RuntimeError: it does not lead from the start to the goal.
        """
        for end, own in ((q[0], self.problem.start), (q[-1], self.problem.goal)):
            if np.abs(end - own).max() > END_TOLERANCE:
                raise RuntimeError(f"a path begins or ends at {end.tolist()} instead of {own}")
        if len(q) == 1:
            q = np.repeat(q, 2, axis=0)
        ways, validator = q.tolist(), self._is_valid.clone()
        begin = time.perf_counter()
        is_clear = all(validator(*ends) for ends in zip(ways[:-1], ways[1:], strict=True))
        seconds = time.perf_counter() - begin
        found = self.robot.certify(torch.from_numpy(q)[None], self.obstacles, resolution=FINE)
        verdict = Verdict(int(found.verdict[0]))
        row: dict[str, Any] = {"verdict": verdict.name, "within": not is_clear, "certificate": seconds}
        if verdict == Verdict.COLLISION:
            row |= {"names": list(found.names(0)), "time": float(found.time[0]), "point": found.point[0].tolist()}
            row |= self._samples(q, float(found.time[0]))
        elif verdict != Verdict.FREE:
            row |= {"names": list(found.names(0)), "time": float(found.time[0])}
        return row

    def _samples(self, q: np.ndarray, first: float) -> dict[str, Any]:
        """How deep, how long, and whether pinocchio and coal agree in a sample."""
        counts = np.maximum(1, np.ceil(np.abs(np.diff(q, axis=0)).max(axis=1) / STEP)).astype(int)
        times = [np.linspace(k, k + 1, count, endpoint=False) for k, count in enumerate(counts)]
        segments = len(q) - 1
        s = np.concatenate([*times, first * segments + np.array([0.0, 1e-6, 1e-5, 1e-4]), [float(segments)]])
        s = np.unique(np.clip(s, 0.0, segments))
        at = between(q, s)
        touches = ~self._is_valid.check_states(torch.from_numpy(at)).numpy()
        where = np.flatnonzero(touches)
        if len(where) == 0:
            return {"samples": 0, "depth": 0.0, "longest": 0.0, "by coal": False, "deepest": None}
        # The longest run of samples that touch, as a length in joint space.
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
        runs = np.split(where, np.flatnonzero(np.diff(where) > 1) + 1)
        longest = max(float(along[run[-1]] - along[run[0]]) for run in runs)
        # The middles of all runs, and samples evenly from all.
        chosen = {int(run[len(run) // 2]) for run in runs} | set(where[:: max(1, len(where) // DEPTHS)].tolist())
        depth, deepest = max((self.depth(at[k]), k) for k in sorted(chosen))
        by_coal = self._by_coal(at[[deepest, *sorted(chosen)]])
        return {
            "samples": len(where),
            "depth": depth,
            "longest": longest,
            "by coal": by_coal,
            "deepest": at[deepest].tolist(),
        }

    def depth(self, q: np.ndarray) -> float:
        """The depth of penetration in a configuration: the least of the distances, by `pgccd.exit_distance`, in many
        directions by which a link must be translated to be apart from what it touches, and the greatest of all pairs.
        """
        scene, motion = self.scene, self.at_rest(q)
        pairs = pgccd.collide(scene, motion).pairs
        if len(pairs) == 0:
            return 0.0
        own = self.robot.body_count
        solids = [self.problem.solids[k - own] for k in pairs[:, 1].tolist() if k >= own]
        directions = np.concatenate([evenly(DIRECTIONS), *map(_axes, {solid.yaw for solid in solids})])
        count = len(directions)
        out = pgccd.exit_distance(
            scene,
            motion,
            torch.from_numpy(directions).repeat(len(pairs), 1),
            pairs=pairs.repeat_interleave(count, dim=0),
            tolerance=1e-6,
        )
        return float(out.upper.view(len(pairs), count).amin(dim=1).max())

    def at_rest(self, q: np.ndarray) -> pgccd.RigidMotion:
        """The scene in a configuration (7,)."""
        position, orientation = self.robot.poses(torch.from_numpy(q))
        return pgccd.RigidMotion.at_rest(
            torch.cat([position, self.obstacles.position]), torch.cat([orientation, self.obstacles.orientation])
        )

    def _by_coal(self, q: np.ndarray) -> bool:
        """Whether pinocchio and coal find a contact in any of configurations (K, 7); False without them."""
        try:
            discrete = Discrete(self._path)
        except ImportError:
            return False
        return any(discrete.collides(each) for each in q)


def between(q: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(K, 7) configurations of a path (T, 7) at times s, of which each segment takes 1."""
    segment = np.minimum(s.astype(int), len(q) - 2)
    return q[segment] + (s - segment)[:, None] * (q[segment + 1] - q[segment])


def tested_pairs(judge: Judge) -> set[frozenset[str]]:
    """The names of links and obstacles that a certificate tests against each other."""
    robot = judge.robot
    body = [robot.link_names[link] for link in robot.body_link.tolist()]
    untested = {frozenset(pair[:2]) for pair in robot.untested}
    pairs = {frozenset((one, other)) for k, one in enumerate(body) for other in body[k + 1 :]} - untested
    moving = [name for name, moves in zip(body, robot.moves.tolist(), strict=True) if moves]
    return pairs | {frozenset((name, solid.name)) for name in moving for solid in judge.problem.solids}


def evenly(count: int) -> np.ndarray:
    """(count, 3) unit vectors, spread evenly (Fibonacci)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _axes(yaw: float) -> np.ndarray:
    """(6, 3): the normals of an upright box."""
    x, y = [np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0]
    axes = np.array([x, y, [0.0, 0.0, 1.0]])
    return np.concatenate([axes, -axes])


def picture(touched: list[dict[str, Any]], judges: dict[tuple[str, int], Judge], written: Path) -> None:
    """The deepest contact of a planner that has the same meshes, in scenes that do not hide it: a PNG beside the
    results.
    """
    same = [path for path in touched if path["deepest"] is not None and path["planner"] != "vamp"]
    same = [path for path in same if path["kind"] in OPEN_KINDS]
    of_ompl = [path for path in same if path["planner"] == "ompl"]
    if not same:
        return
    worst = max(of_ompl or same, key=lambda path: float(path["depth"]))
    judge = judges[worst["kind"], worst["number"]]
    scene, motion = judge.scene, judge.at_rest(np.array(worst["deepest"]))
    hits = pgccd.detect(scene, motion)
    pgccd.show(scene, motion, hits, path=written.with_suffix(".png"))
    print(f"picture: {worst['planner']}, {worst['path']}, {worst['kind']} {worst['number']}: {worst['names']}")


def outside(robot: Robot, q: list[float], spheres: list[list[float]]) -> tuple[float, str]:
    """How far a moving link's surface is outside of all spheres (x, y, z, radius), at most of random points on its
    triangles, and of which link.
    """
    position, orientation = robot.poses(torch.tensor(q, dtype=torch.float64))
    balls, rng, found = np.array(spheres), np.random.default_rng(1), []
    for body, mesh in enumerate(robot.meshes):
        if robot.moves[body]:
            corners = turned(orientation[body].numpy(), mesh.vertices.numpy()) + position[body].numpy()
            of_triangles = corners[mesh.faces.numpy()[rng.integers(mesh.triangle_count, size=POINTS)]]
            points = (rng.dirichlet(np.ones(3), POINTS)[..., None] * of_triangles).sum(axis=1)
            away = (np.linalg.norm(points[:, None] - balls[:, :3], axis=2) - balls[:, 3]).min(axis=1).max()
            found.append((float(away), robot.link_names[int(robot.body_link[body])]))
    return max(found)
