"""Ten thousand robots, one whole step, beside PyBullet on the same world.

pgccd: plan, continuous detection of the exact meshes, response (further detections, until nobody collides), hashes:
all of `pgccd.sim.make_step`, on all cores. PyBullet: `stepSimulation` with the convex hulls of the same meshes at the
same poses and velocities, without gravity, friction and damping; discrete detection and impulse response on one
thread, as its Python module is built. The two answer different questions, the second an easier one; the comparison is
of what a step of a world costs.
"""

from __future__ import annotations

from typing import Any

import torch
from support import peers, results, timing
from support.scenes import MixedWorld

from pgccd import sim


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots", type=int, default=10_000)
    parser.add_argument("--steps-before", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=20, help="steps timed")
    parser.add_argument("--warm-up", type=int, default=3)
    parser.add_argument("--threads", type=int, help="CPU threads of pgccd (default: torch's)")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)

    mixed = MixedWorld(arguments.robots, arguments.steps_before)
    pybullet = peers.load("pybullet")
    bullet = None if pybullet is None else BulletWorld(pybullet, mixed.world, next(iter(mixed)))

    spent: dict[str, list[float]] = {}
    records: list[dict[str, Any]] = []
    for index in range(arguments.warm_up + arguments.rounds):
        parts: dict[str, float] = {}
        parts["pgccd, exact meshes"], step = timing.seconds(mixed.advance)
        if bullet is not None:
            parts["PyBullet, convex hulls"], _ = timing.seconds(bullet.advance)
        if index < arguments.warm_up:
            continue
        records.append(step.record)
        for name, part in parts.items():
            spent.setdefault(name, []).append(part)

    rows: list[dict[str, Any]] = [{"method": name, "ms": timing.summary(part)} for name, part in spent.items()]
    mean = {
        key: timing.rounded(sum(record[key] for record in records) / len(records))
        for key in ("pcs", "contacts", "secondary_contacts", "settle_rounds", "stopped")
    }
    stages = {
        stage: timing.summary([record["stage_seconds"][stage] for record in records])["median"]
        for stage in records[0]["stage_seconds"]
    }
    rows[0] |= {"stage_ms": stages, "a_step": mean}
    if bullet is not None:
        rows[1]["contact_points"] = len(bullet.pybullet.getContactPoints())
    print(f"{arguments.robots} robots, one whole step")
    results.table(
        [
            {"method": row["method"], "ms": row["ms"]["median"], "low": row["ms"]["low10"], "high": row["ms"]["high90"]}
            for row in rows
        ]
    )
    results.table([stages])
    content = {"robots": arguments.robots, "steps_before": arguments.steps_before, "rows": rows}
    results.write("ten_thousand", "cpu", content, arguments.out)


class BulletWorld:
    """The robots of a world as convex hulls in PyBullet."""

    def __init__(self, pybullet: Any, world: sim.World, state: sim.RobotState) -> None:
        self.pybullet = pybullet
        pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0.0, 0.0, 0.0)
        pybullet.setTimeStep(1.0)
        mesh = world.meshes.meshes[0]
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=mesh.vertices.tolist())
        columns = (state.position, state.orientation, state.velocity, state.angular_velocity)
        for position, (w, x, y, z), velocity, spin in zip(*(column.tolist() for column in columns), strict=True):
            # Maximal coordinates: plain rigid bodies, which are faster here than one-link articulations.
            body = pybullet.createMultiBody(
                1.0, shape, basePosition=position, baseOrientation=(x, y, z, w), useMaximalCoordinates=True
            )
            pybullet.resetBaseVelocity(body, velocity, spin)
            # Nobody slows down, so that the world stays as lively as it starts.
            pybullet.changeDynamics(
                body, -1, linearDamping=0.0, angularDamping=0.0, restitution=1.0, lateralFriction=0.0
            )

    def advance(self) -> None:
        """One step."""
        self.pybullet.stepSimulation()


if __name__ == "__main__":
    main()
