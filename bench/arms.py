"""Certificates of random motions of robot arms, beside samples by pinocchio and coal: what samples find that the
certificate calls free (nothing, or it is wrong), times that are late, verdicts that are only the resolution, and time.

Robots are read from a folder of example-robot-data (--data). `pip install pin example-robot-data yourdfpy`.
Times are processor time of one thread. With --resume, samples of earlier runs are not repeated.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import results

import pgccd
from pgccd.robots import Certificate, Obstacles, Robot, Verdict, load_urdf

# By name the URDF and SRDF files, below the folder of robots.
ROBOTS = {
    "Panda": ("panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"),
    "UR5": ("ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf"),
    "Talos": ("talos_data/robots/talos_reduced.urdf", "talos_data/srdf/talos.srdf"),
}
CUBE, CUBES = 0.15, 8
# Segments that are not free but without a colliding sample are sampled again from their time on, so densely.
FINE, FINE_LENGTH = 4001, 0.01
# Samples of each segment that are tested without boxes too.
CHECKED = 5


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the folder example-robot-data")
    parser.add_argument("--segments", type=int, default=1000, help="random segments whose start does not collide")
    parser.add_argument("--saved-only", action="store_true", help="take no samples besides those in --resume")
    parser.add_argument("--samples", type=int, default=2001, help="configurations a segment")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--resume", type=Path, help="folder for the samples taken so far")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(name, arguments) for name in arguments.robots]
    results.table(rows)
    content = {"segments": arguments.segments, "samples": arguments.samples, "cubes": CUBES, "rows": rows}
    results.write("arms", "cpu", content, arguments.out)


def measure(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Random motions of a robot among cubes."""
    urdf, srdf = (arguments.data / "robots" / part for part in ROBOTS[name])
    robot = load_urdf(urdf, srdf, packages={"example-robot-data": arguments.data}).excluding_sampled(300)
    rng = np.random.default_rng(1)
    places = robot.reach * rng.uniform(-0.5, 0.5, (CUBES, 3)) + [0.0, 0.0, 0.3]
    cube = pgccd.Mesh.box([CUBE] * 3)
    obstacles = Obstacles([cube], torch.tensor(places), mesh_index=[0] * CUBES)
    sampler = Sampler(robot, urdf, arguments.data, cube, places)
    q = random_segments(robot, sampler, arguments.segments, rng)
    robot.certify(q[:10], obstacles)
    begin = time.process_time()
    found = robot.certify(q, obstacles)
    seconds = time.process_time() - begin
    row = {"robot": name, "bodies": robot.body_count, "triangles": sum(len(mesh.faces) for mesh in robot.meshes)}
    row |= {verdict.name.lower(): int((found.verdict == verdict).sum()) for verdict in Verdict}
    kept = None if arguments.resume is None else arguments.resume / f"{name}.npz"
    first, sampled, count = sample_all(sampler, q.numpy(), arguments.samples, kept, arguments.saved_only)
    row |= {"sampled": len(first)}
    row |= compared(found, first, np.linspace(0.0, 1.0, arguments.samples), sampler, q.numpy())
    row |= {"ms a segment": 1e3 * seconds / len(q), "ms a sampled segment": 1e3 * sampled / len(first)}
    return row | {"us a sample": 1e6 * sampled / count, "tested without boxes too": sampler.checked}


def random_segments(robot: Robot, sampler: Sampler, count: int, rng: np.random.Generator) -> torch.Tensor:
    """(count, 2, J): starts in the middle 60 % of the limits that do not collide, ends up to an eighth of them away."""
    low, high = (limit.numpy().clip(-np.pi, np.pi) for limit in (robot.lower, robot.upper))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    segments: list[np.ndarray] = []
    while len(segments) < count:
        start, step = rng.uniform(-1, 1, (2, robot.joint_count))
        ends = np.stack([middle + 0.6 * half * start, middle + half * (0.6 * start + 0.25 * step)])
        if sampler.first(ends, np.zeros(1)) is None:
            segments.append(ends)
    return torch.tensor(np.stack(segments))


def sample_all(
    sampler: Sampler, q: np.ndarray, samples: int, kept: Path | None, saved_only: bool
) -> tuple[np.ndarray, float, int]:
    """The first sample of each segment that collides (B,), -1 without one; processor seconds; how many were taken."""
    first, seconds = np.zeros(0, dtype=np.int64), 0.0
    if kept is not None and kept.is_file():
        saved = np.load(kept)
        done = len(saved["first"])
        if saved["samples"] == samples and done <= len(q) and np.array_equal(saved["q"][:done], q[:done]):
            first, seconds, sampler.checked = saved["first"], float(saved["seconds"]), int(saved["checked"])
    s = np.linspace(0.0, 1.0, samples)
    for b in range(len(first), len(first) if saved_only else len(q)):
        begin = time.process_time()
        at = sampler.first(q[b], s)
        seconds += time.process_time() - begin
        first = np.append(first, -1 if at is None else at)
        sampler.check(q[b], s[:: samples // CHECKED])
        if kept is not None and (b % 25 == 24 or b == len(q) - 1):
            kept.parent.mkdir(parents=True, exist_ok=True)
            np.savez(kept, q=q, samples=samples, first=first, seconds=seconds, checked=sampler.checked)
    return first, seconds, int(np.where(first < 0, samples, first + 1).sum())


def compared(found: Certificate, first: np.ndarray, s: np.ndarray, sampler: Sampler, q: np.ndarray) -> dict[str, Any]:
    """Certificates beside the samples at times s."""
    free, begin, verdict = (column.numpy()[: len(first)] for column in (found.free, found.time, found.verdict))
    collides = first >= 0
    early = (s[first] - begin)[collides & ~free]
    unseen = np.flatnonzero(~free & ~collides)
    finer = [b for b in unseen if sampler.first(q[b], begin[b] + np.linspace(0.0, FINE_LENGTH, FINE)) is not None]
    near = int((verdict[unseen] == int(Verdict.NEAR)).sum())
    return {
        "samples collide": int(collides.sum()),
        "missed": int((collides & free).sum()),
        "late": int((early < 0.0).sum()),
        "median early": float(np.median(early)),
        "most early": float(early.max()),
        "not free, no sample collides": len(unseen),
        "of them near": near,
        "of them in finer samples": len(finer),
    }


class Sampler:
    """The same robot, pairs and cubes in pinocchio. Pairs are those whose boxes overlap in a tree of boxes of coal."""

    def __init__(self, robot: Robot, urdf: Path, data: Path, cube: pgccd.Mesh, places: np.ndarray) -> None:
        import coal
        import pinocchio as pin

        self.pin = pin
        self.model = pin.buildModelFromUrdf(str(urdf))
        folders = [str(data.parent), str(data), str(data / "robots")]
        self.geometry = pin.buildGeomFromUrdf(self.model, str(urdf), pin.GeometryType.COLLISION, package_dirs=folders)
        link_of = [self.model.frames[shape.parentFrame].name for shape in self.geometry.geometryObjects]
        mesh = coal.BVHModelOBBRSS()
        mesh.beginModel(len(cube.faces), len(cube.vertices))
        vertices, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for vertex in cube.vertices.numpy():
            vertices.append(vertex)
        for face in cube.faces.tolist():
            triangles.append(coal.Triangle(*face))
        mesh.addSubModel(vertices, triangles)
        mesh.endModel()
        for place in places:
            name = f"cube{self.geometry.ngeoms}"
            self.geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, pin.SE3(np.eye(3), place), mesh))
        body = {robot.link_names[link]: k for k, link in enumerate(robot.body_link.tolist())}
        excluded = {tuple(pair) for pair in robot.exclude.tolist()}
        for i, one in enumerate(link_of):
            for j in range(i + 1, self.geometry.ngeoms):
                if j < len(link_of):
                    pair = tuple(sorted((body[one], body[link_of[j]])))
                    tested = pair[0] != pair[1] and pair not in excluded
                else:
                    tested = bool(robot.moves[body[one]])
                if tested:
                    self.geometry.addCollisionPair(pin.CollisionPair(i, j))
        self.state = self.model.createData()
        self.places = pin.GeometryData(self.geometry)
        # Joints that mimic others are joints of their own there.
        moving = [joint for joint in robot._tree.joints if joint.kind != "fixed"]
        self.joints = [(self.model.joints[self.model.getJointId(joint.name)], joint) for joint in moving]
        self.tree = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(self.model, self.geometry, self.places)
        self.checked = 0

    def first(self, ends: np.ndarray, s: np.ndarray) -> int | None:
        """The first of the samples at times s that collides."""
        for k, q in enumerate(self.configurations(ends, s)):
            if self.pin.computeCollisions(self.model, self.state, self.tree, q, True):
                return k
        return None

    def check(self, ends: np.ndarray, s: np.ndarray) -> None:
        """Compares the samples at times s with those of all pairs.

        Raises:
            RuntimeError: they differ.
        """
        for q in self.configurations(ends, s):
            with_boxes = self.pin.computeCollisions(self.model, self.state, self.tree, q, True)
            if with_boxes != self.pin.computeCollisions(self.model, self.state, self.geometry, self.places, q, True):
                raise RuntimeError(f"boxes of coal lose a pair at {q.tolist()}")
            self.checked += 1

    def configurations(self, ends: np.ndarray, s: np.ndarray) -> np.ndarray:
        """(len(s), nq) of pinocchio."""
        q = np.tile(self.pin.neutral(self.model), (len(s), 1))
        for joint, own in self.joints:
            at = ends[:, own.coordinate]
            value = own.scale * (at[0] + s * (at[1] - at[0])) + own.offset
            columns = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            q[:, joint.idx_q : joint.idx_q + joint.nq] = np.stack(columns, axis=1)
        return q


if __name__ == "__main__":
    main()
