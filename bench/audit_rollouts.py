"""Audits of rollouts of MuJoCo, Newton and PyBullet that tunnel: random scenes of thin walls, spinning bars and stacks,
beside coal, sampled finely between frames, and separating axes where both bodies are boxes.

Rows of the oracle that the audit does not report: missed. Passages that neither finer samples about their time nor the
distance there confirm: false. `pip install mujoco newton pybullet coal`, as far as wanted.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from support import results

import pgccd

# Samples between two frames, and about a passage; and how near a passage without an overlap must come.
SAMPLES, FINE, NEAR = 400, 400, 3e-6
STEP, FRAMES = 0.01, 40


@dataclass
class Part:
    """A body: "box", "sphere" or "capsule" along z, with half edges, radius, or radius and half length.

    Attributes:
        fixed: whether it does not move.
        spin: rate about z at which a motor turns it, radians per unit of time; else it moves freely.
    """

    kind: str
    size: tuple[float, ...]
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    fixed: bool = False
    spin: float = 0.0


#: (N, 3) and (N, 4).
Frame = tuple[np.ndarray, np.ndarray]


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--simulators", nargs="+", default=list(SIMULATORS), choices=list(SIMULATORS))
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in arguments.simulators:
        try:
            importlib.import_module(name.lower())
        except ImportError:
            print(f"{name} is not installed")
            continue
        scenes = [measure(name, seed) for seed in range(arguments.first, arguments.first + arguments.scenes)]
        total = {key: sum(scene[key] for scene in scenes) for key in scenes[0]}
        rows.append({"simulator": name, "scenes": len(scenes), **total})
        results.table(rows[-1:])
    results.write("audit_rollouts", "cpu", {"samples": SAMPLES, "rows": rows}, arguments.out)


def measure(name: str, seed: int) -> dict[str, Any]:
    """One random scene in one simulator."""
    parts = scene_of(np.random.default_rng(seed), seed % 3)
    position, orientation = (np.stack(column) for column in zip(*SIMULATORS[name](parts), strict=True))
    meshes, margins = zip(*(surface(part) for part in parts), strict=True)
    scene = pgccd.Scene(list(meshes), margin=list(margins), static=[part.fixed for part in parts])
    found = pgccd.audit(scene, pgccd.Trajectory(torch.tensor(position), torch.tensor(orientation)))
    oracle = Oracle(parts, position, orientation)
    sampled = oracle.passages()
    reported = set(rows_of(found.passages))
    touching = {
        (frame, *pair)
        for pair, first, last in zip(
            found.touching.pairs.tolist(), found.touching.first.tolist(), found.touching.last.tolist(), strict=True
        )
        for frame in range(first, last + 1)
    }
    # At a frame, a pair within the tolerance touches, which coal need not see.
    shown = {(s, i, j) for s, i, j in sampled - reported if {(s, i, j), (s + 1, i, j)} & touching}
    grazing = false = 0
    for row, toi in zip(rows_of(found.passages), found.passages.toi.tolist(), strict=True):
        if row not in sampled:
            confirmed = oracle.about(row, toi)
            grazing += confirmed
            false += not confirmed
    return {
        "bodies": len(parts),
        "segments": len(position) - 1,
        "touching": len(found.touching),
        "passages": len(reported),
        "sampled by coal": len(sampled),
        "of boxes by axes": len(oracle.by_axes),
        "missed": len(sampled - reported - shown) + len(oracle.by_axes - reported - shown),
        "touch at a frame by tolerance": len(shown),
        "shorter than samples": grazing,
        "false": false,
    }


def rows_of(passages: Any) -> list[tuple[int, int, int]]:
    """Segment and pair of each."""
    return [(s, i, j) for s, (i, j) in zip(passages.segment.tolist(), passages.pairs.tolist(), strict=True)]


def scene_of(rng: np.random.Generator, kind: int) -> list[Part]:
    """Thin walls, spinning bars or stacks, and what is thrown at them."""
    still, upright = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])

    def wall(size: tuple[float, ...], at: np.ndarray, turn: np.ndarray = upright) -> Part:
        return Part("box", size, at, turn, still, still, fixed=True)

    def thrown(target: np.ndarray, speed: float) -> Part:
        kind = rng.choice(["box", "sphere", "capsule"])
        size = tuple(rng.uniform(0.01, 0.06, {"box": 3, "sphere": 1, "capsule": 2}[kind]))
        way = unit(rng.normal(size=3))
        at = target - way * rng.uniform(0.5, 3.0) + rng.normal(0, 0.1, 3)
        return Part(kind, size, at, unit(rng.normal(size=4)), speed * way, rng.normal(0, 25, 3))

    parts = []
    if kind == 0:
        for k in range(rng.integers(3, 7)):
            size = (*rng.uniform(0.3, 0.8, 2), rng.uniform(0.0005, 0.004))
            parts.append(wall(size, np.array([1.2 * k, 0.0, 0.0]), unit(rng.normal(size=4))))
    elif kind == 1:
        for k in range(rng.integers(2, 5)):
            at = np.array([2.0 * k, 0.0, 0.0])
            size = (rng.uniform(0.5, 0.8), *rng.uniform(0.004, 0.02, 2))
            spin = rng.uniform(30.0, 250.0) * rng.choice([-1, 1])
            parts.append(Part("box", size, at, upright, still, still, spin=spin))
            for _ in range(rng.integers(2, 6)):
                angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9)
                parts.append(wall((0.01, 0.01, 0.2), at + far * np.array([np.cos(angle), np.sin(angle), 0.0])))
    else:
        parts.append(wall((3.0, 3.0, 0.002), np.array([0.0, 0.0, -0.002])))
        for k in range(rng.integers(2, 4)):
            for level in range(rng.integers(2, 5)):
                half = (0.1, 0.1, 0.05)
                at = np.array([0.8 * k, 0.0, 0.05 + 0.1001 * level])
                parts.append(Part("box", half, at, upright, still, still))
    for _ in range(rng.integers(8, 16)):
        parts.append(thrown(parts[rng.integers(0, len(parts))].position, rng.uniform(5.0, 80.0)))
    return parts


def unit(values: np.ndarray) -> np.ndarray:
    """Of length 1."""
    return values / np.linalg.norm(values)


def surface(part: Part) -> tuple[pgccd.Mesh, float]:
    """The mesh and the margin of a body."""
    if part.kind == "box":
        return pgccd.Mesh.box(2.0 * np.array(part.size)), 0.0
    half = part.size[1] if part.kind == "capsule" else 1e-9
    corners = np.array([[0.0, 0.0, -half], [0.0, 0.0, half], [0.0, 0.0, 0.0]])
    return pgccd.Mesh(corners, [[0, 1, 2]]), part.size[0]


def mujoco_frames(parts: list[Part]) -> Iterator[Frame]:
    """Frames of MuJoCo."""
    import mujoco

    bodies = []
    for part in parts:
        at, turn = (" ".join(f"{x:.17g}" for x in values) for values in (part.position, part.orientation))
        size = " ".join(f"{x:.17g}" for x in part.size)
        joint = "" if part.fixed else "<freejoint/>"
        if part.spin:
            joint = '<joint type="hinge" axis="0 0 1"/>'
        bodies.append(f'<body pos="{at}" quat="{turn}">{joint}<geom type="{part.kind}" size="{size}"/></body>')
    text = f'<mujoco><option timestep="{STEP}"/><worldbody>{"".join(bodies)}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for k, part in enumerate(parts):
        first, count = model.body_dofadr[k + 1], model.body_dofnum[k + 1]
        data.qvel[first : first + count] = part.spin if part.spin else [*part.velocity, *part.turning][:count]
    for _ in range(FRAMES):
        mujoco.mj_kinematics(model, data)
        yield data.xpos[1:].copy(), data.xquat[1:].copy()
        mujoco.mj_step(model, data)
        if any(
            data.warning[int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{of}"))].number for of in ("POS", "VEL", "ACC")
        ):
            return  # unstable: it would begin again


def newton_frames(parts: list[Part]) -> Iterator[Frame]:
    """Frames of Newton, by extended position-based dynamics."""
    import newton
    import warp

    warp.config.quiet = True
    builder = newton.ModelBuilder()
    for part in parts:
        turn = warp.quat(*part.orientation[[1, 2, 3, 0]].tolist())
        body = builder.add_body(xform=warp.transform(part.position.tolist(), turn))
        if part.kind == "box":
            builder.add_shape_box(body, hx=part.size[0], hy=part.size[1], hz=part.size[2])
        elif part.kind == "sphere":
            builder.add_shape_sphere(body, radius=part.size[0])
        else:
            builder.add_shape_capsule(body, radius=part.size[0], half_height=part.size[1])
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverXPBD(model)
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()
    old, new, control = model.state(), model.state(), model.control()
    start = model.body_q.numpy()
    turning = np.array([[0, 0, part.spin] if part.spin else part.turning for part in parts])
    velocity = np.concatenate([[part.velocity for part in parts], turning], axis=1).astype(np.float32)
    old.body_qd.assign(velocity)
    for frame in range(FRAMES):
        poses, rates = old.body_q.numpy().copy(), old.body_qd.numpy().copy()
        for k, part in enumerate(parts):
            if part.fixed or part.spin:  # moved by hand
                poses[k], rates[k] = start[k], velocity[k]
                angle = 0.5 * part.spin * STEP * frame
                poses[k, 5:7] = (np.sin(angle), np.cos(angle)) if part.spin else poses[k, 5:7]
        old.body_q.assign(poses)
        old.body_qd.assign(rates)
        q = poses[:, [6, 3, 4, 5]].astype(np.float64)
        yield poses[:, :3].astype(np.float64), q / np.linalg.norm(q, axis=1, keepdims=True)
        old.clear_forces()
        collisions.collide(old, contacts)
        solver.step(old, new, control, contacts, STEP)
        old, new = new, old


def pybullet_frames(parts: list[Part]) -> Iterator[Frame]:
    """Frames of PyBullet."""
    import pybullet as bullet

    client = bullet.connect(bullet.DIRECT)
    bullet.setTimeStep(STEP)
    for part in parts:
        if part.kind == "box":
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=part.size)
        elif part.kind == "sphere":
            shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=part.size[0])
        else:
            shape = bullet.createCollisionShape(bullet.GEOM_CAPSULE, radius=part.size[0], height=2 * part.size[1])
        turn = part.orientation[[1, 2, 3, 0]].tolist()
        mass = 0.0 if part.fixed or part.spin else 1.0
        body = bullet.createMultiBody(mass, shape, basePosition=part.position.tolist(), baseOrientation=turn)
        if mass:
            bullet.resetBaseVelocity(body, part.velocity.tolist(), part.turning.tolist())
    for frame in range(FRAMES):
        for body, part in enumerate(parts):
            if part.spin:
                angle = 0.5 * part.spin * STEP * frame
                turn = [0.0, 0.0, np.sin(angle), np.cos(angle)]
                bullet.resetBasePositionAndOrientation(body, part.position.tolist(), turn)
        poses = [bullet.getBasePositionAndOrientation(body) for body in range(len(parts))]
        q = np.array([turn for _, turn in poses])[:, [3, 0, 1, 2]]
        yield np.array([at for at, _ in poses]), q / np.linalg.norm(q, axis=1, keepdims=True)
        bullet.stepSimulation()
    bullet.disconnect(client)


SIMULATORS: dict[str, Callable[[list[Part]], Iterator[Frame]]] = {
    "MuJoCo": mujoco_frames,
    "Newton": newton_frames,
    "PyBullet": pybullet_frames,
}


class Oracle:
    """Overlaps of solids between frames, where origins move straight and turn at a constant rate the shorter way."""

    def __init__(self, parts: list[Part], position: np.ndarray, orientation: np.ndarray) -> None:
        import coal

        self.coal, self.parts, self.position, self.orientation = coal, parts, position, orientation
        made = {
            "box": lambda size: coal.Box(*(2.0 * x for x in size)),
            "sphere": lambda size: coal.Sphere(*size),
            "capsule": lambda size: coal.Capsule(size[0], 2.0 * size[1]),
        }
        self.shapes = [made[part.kind](part.size) for part in parts]
        self.reach = np.array([np.linalg.norm(p.size) if p.kind == "box" else sum(p.size) for p in parts])
        #: What separating axes find, of pairs of boxes.
        self.by_axes: set[tuple[int, int, int]] = set()

    def passages(self) -> set[tuple[int, int, int]]:
        """Segments and pairs that coal finds apart at both frames, and overlapping at a sample between them."""
        found = set()
        times = np.linspace(0.0, 1.0, SAMPLES + 1)
        for segment in range(len(self.position) - 1):
            for i, j in self._near(segment):
                if self.overlaps(segment, np.array([0.0, 1.0]), i, j):
                    continue
                if self.overlaps(segment, times, i, j):
                    found.add((segment, i, j))
                if self.parts[i].kind == self.parts[j].kind == "box":
                    poses = [self.at(segment, times, k) for k in (i, j)]
                    gap = axis_gap(poses[0], self.parts[i].size, poses[1], self.parts[j].size)
                    if gap[0] > 0.0 and gap[-1] > 0.0 and gap.min() < 0.0:
                        self.by_axes.add((segment, i, j))
        return found

    def about(self, row: tuple[int, int, int], toi: float) -> bool:
        """Whether a pair is apart at both frames, and overlaps, or comes near, about a time."""
        segment, i, j = row
        if self.overlaps(segment, np.array([0.0, 1.0]), i, j):
            return False
        times = np.clip(toi + np.linspace(0.0, 2.0 / SAMPLES, FINE), 0.0, 1.0)
        return self.overlaps(segment, times, i, j) or self.distance(segment, toi, i, j) < NEAR

    def _near(self, segment: int) -> Iterator[tuple[int, int]]:
        """Pairs whose spheres meet; not of two that are fixed."""
        moves = np.array([not part.fixed for part in self.parts])
        i, j = np.triu_indices(len(self.parts), 1)
        i, j = (column[moves[i] | moves[j]] for column in (i, j))
        offset = self.position[segment : segment + 2, j] - self.position[segment : segment + 2, i]
        move = offset[1] - offset[0]
        nearest = np.clip(-(offset[0] * move).sum(1) / np.maximum((move * move).sum(1), 1e-30), 0.0, 1.0)
        least = np.linalg.norm(offset[0] + nearest[:, None] * move, axis=1)
        close = least <= (self.reach[i] + self.reach[j]) * (1.0 + 1e-9)
        yield from zip(i[close].tolist(), j[close].tolist(), strict=True)

    def at(self, segment: int, times: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Centres (T, 3) and rotation matrices (T, 3, 3)."""
        x0, x1 = self.position[segment : segment + 2, body]
        p, q = self.orientation[segment : segment + 2, body]
        cosine = float(p @ q)
        p, half = (-p if cosine < 0.0 else p), np.arccos(min(abs(cosine), 1.0))
        t = times[:, None]
        sine = np.sin(half) if half > 1e-9 else half
        ratio = t if half <= 1e-9 else np.sin(t * half) / sine
        rest = 1.0 - t if half <= 1e-9 else np.sin((1.0 - t) * half) / sine
        turn = rest * p + ratio * q
        w, x, y, z = (turn / np.linalg.norm(turn, axis=1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return (1.0 - t) * x0 + t * x1, np.moveaxis(np.array(rows), 2, 0)

    def overlaps(self, segment: int, times: np.ndarray, i: int, j: int) -> bool:
        """Whether the solids overlap at one of these times; where spheres around them do not, they do not."""
        (x, u), (y, v) = (self.at(segment, times, k) for k in (i, j))
        near = np.linalg.norm(y - x, axis=1) <= (self.reach[i] + self.reach[j]) * (1.0 + 1e-9)
        request, place = self.coal.CollisionRequest(), self.coal.Transform3s
        for k in np.flatnonzero(near):
            result = self.coal.CollisionResult()
            one, other = place(u[k], x[k]), place(v[k], y[k])
            if self.coal.collide(self.shapes[i], one, self.shapes[j], other, request, result):
                return True
        return False

    def distance(self, segment: int, time: float, i: int, j: int) -> float:
        """Between the solids; negative if they overlap."""
        poses = (self.at(segment, np.array([time]), k) for k in (i, j))
        one, other = (self.coal.Transform3s(turn[0], x[0]) for x, turn in poses)
        request, result = self.coal.DistanceRequest(), self.coal.DistanceResult()
        return float(self.coal.distance(self.shapes[i], one, self.shapes[j], other, request, result))


def axis_gap(
    one: tuple[np.ndarray, np.ndarray], a: tuple[float, ...], other: tuple[np.ndarray, np.ndarray], b: tuple[float, ...]
) -> np.ndarray:
    """(T,): the largest gap of two boxes along the 15 axes that may separate them; negative if they overlap."""
    (x, u), (y, v) = one, other
    own, its = u.transpose(0, 2, 1), v.transpose(0, 2, 1)  # rows: the axes of the boxes
    cross = np.cross(own[:, :, None], its[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(cross, axis=2, keepdims=True)
    cross = np.where(length > 1e-9, cross / np.maximum(length, 1e-9), own[:, :1])
    axes = np.concatenate([own, its, cross], axis=1)
    apart = np.abs((axes * (y - x)[:, None]).sum(axis=2))
    reach = np.abs(axes @ u) @ np.array(a) + np.abs(axes @ v) @ np.array(b)
    return (apart - reach).max(axis=1)


if __name__ == "__main__":
    main()
