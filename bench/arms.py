"""Certificates of random motions of robot arms, beside samples by pinocchio and coal: what samples find that the
certificate calls free (nothing, or it is wrong), times that are late, verdicts that are only the resolution, and time.

Robots are read from a folder of example-robot-data (--data). `pip install pin example-robot-data yourdfpy`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import results

import pgccd
from pgccd.robots import Obstacles, Robot, Verdict, load_urdf

# By name the URDF and SRDF files, below the folder of robots.
ROBOTS = {
    "Panda": ("panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"),
    "UR5": ("ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf"),
    "Talos": ("talos_data/robots/talos_reduced.urdf", "talos_data/srdf/talos.srdf"),
}
CUBE, CUBES = 0.15, 8


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the folder example-robot-data")
    parser.add_argument("--segments", type=int, default=1000)
    parser.add_argument("--sampled", type=int, default=200, help="segments that are sampled too")
    parser.add_argument("--samples", type=int, default=2001, help="configurations a sampled segment")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(name, arguments) for name in arguments.robots]
    results.table(rows)
    content = {"segments": arguments.segments, "samples": arguments.samples, "cubes": CUBES, "rows": rows}
    results.write("arms", "cpu", content, arguments.out)


def measure(name: str, arguments: Any) -> dict[str, Any]:
    """Random motions of a robot among cubes."""
    urdf, srdf = (arguments.data / "robots" / part for part in ROBOTS[name])
    robot = load_urdf(urdf, srdf, packages={"example-robot-data": arguments.data}).excluding_sampled(300)
    rng = np.random.default_rng(1)
    places = robot.reach * rng.uniform(-0.5, 0.5, (CUBES, 3)) + [0.0, 0.0, 0.3]
    cube = pgccd.Mesh.box([CUBE] * 3)
    obstacles = Obstacles([cube], torch.tensor(places), mesh_index=[0] * CUBES)
    low, high = (limit.numpy().clip(-np.pi, np.pi) for limit in (robot.lower, robot.upper))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    shape = (arguments.segments, robot.joint_count)
    start = middle + 0.6 * half * rng.uniform(-1, 1, shape)
    q = torch.tensor(np.stack([start, start + 0.25 * half * rng.uniform(-1, 1, shape)], axis=1))
    begin = time.perf_counter()
    found = robot.certify(q, obstacles)
    seconds = time.perf_counter() - begin
    row = {"robot": name, "bodies": robot.body_count, "triangles": sum(len(mesh.faces) for mesh in robot.meshes)}
    row |= {"ms a segment": 1e3 * seconds / arguments.segments}
    row |= {verdict.name.lower(): int((found.verdict == verdict).sum()) for verdict in Verdict}
    scene = Sampler(robot, urdf, arguments.data, cube, places)
    s = np.linspace(0.0, 1.0, arguments.samples)
    missed = late = collide = 0
    begin = time.perf_counter()
    for b in range(min(arguments.sampled, arguments.segments)):
        first = scene.first(q[b].numpy(), s)
        collide += first is not None
        missed += first is not None and bool(found.free[b])
        late += first is not None and bool(float(found.time[b]) > s[first])
    sampled = time.perf_counter() - begin
    row |= {"sampled": arguments.sampled, "samples collide": int(collide), "missed": int(missed), "late": int(late)}
    return row | {"ms a sampled segment": 1e3 * sampled / arguments.sampled}


class Sampler:
    """The same robot, pairs and cubes in pinocchio."""

    def __init__(self, robot: Robot, urdf: Path, data: Path, cube: pgccd.Mesh, places: np.ndarray) -> None:
        import coal
        import pinocchio as pin

        self.pin = pin
        self.model = pin.buildModelFromUrdf(str(urdf))
        folders = [str(data.parent), str(data), str(data / "robots")]
        self.geometry = pin.buildGeomFromUrdf(self.model, str(urdf), pin.GeometryType.COLLISION, folders)
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

    def first(self, ends: np.ndarray, s: np.ndarray) -> int | None:
        """The first of the samples that collides."""
        for k, t in enumerate(s):
            q = self.pin.neutral(self.model)
            for joint, own in self.joints:
                at = ends[:, own.coordinate]
                value = own.scale * (at[0] + t * (at[1] - at[0])) + own.offset
                q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
            if self.pin.computeCollisions(self.model, self.state, self.geometry, self.places, q, True):
                return k
        return None


if __name__ == "__main__":
    main()
