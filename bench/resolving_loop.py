"""Time of a step of a loop in which no two bodies meet: `CapturedWorld(resolve=True)` as replays of one CUDA graph and
with separate launches, and `pgccd.resolve` on the same scenes. Two worlds: unit boxes that drift, turn and rebound from
each other and from walls, of which some 22 % are stopped in each step; and the nanorobots, beside their own step.

Every way must end in the same state. The nanorobots' own step counts as 1: it does without the test of surfaces that
intersect at t = 0 (initial="assume_free").

    python bench/resolving_loop.py --bodies 100000
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch
from support import results
from torch import Tensor

import pgccd
from pgccd import distributed, sim
from pgccd.runtime.hashing import row_hash

# Of the boxes, for unit edges: edge of the cell of the lattice at the start, displacement and turn a step.
_CELL, _DISPLACEMENT, _TURN = 2.2, 0.3, 0.2


class Boxes:
    """Unit boxes in a box, and how they move."""

    def __init__(self, count: int, device: torch.device, seed: int = 0) -> None:
        draw = torch.Generator().manual_seed(seed)
        across = max(sim.model.lattice_cells(count))
        k = torch.arange(count)
        lattice = torch.stack([k % across, k // across % across, k // across**2], dim=1)
        self.half_extent = 0.5 * _CELL * across
        self.position = (_CELL * (lattice + 0.5) - self.half_extent).to(device)
        q = torch.randn(count, 4, generator=draw, dtype=torch.float64)
        direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw, dtype=torch.float64))
        axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw, dtype=torch.float64))
        columns = {"q": q / q.norm(dim=1, keepdim=True), "v": _DISPLACEMENT * direction, "w": _TURN * axis}
        self.payload = {name: column.to(device) for name, column in columns.items()}
        self.meshes = [pgccd.Mesh.box((1.0, 1.0, 1.0))]

    def motion(self, bodies: distributed.Bodies) -> tuple[pgccd.RigidMotion, dict[str, Tensor]]:
        """Boxes whose centres reach a wall turn back."""
        outwards = (bodies.position.abs() > self.half_extent) & (bodies.position * bodies.payload["v"] > 0.0)
        v = torch.where(outwards, -bodies.payload["v"], bodies.payload["v"])
        at = bodies.payload
        return pgccd.RigidMotion.from_velocity(bodies.position, at["q"], v, at["w"], dt=1.0), {"v": v}

    def response(self, bodies: distributed.Bodies, motion: pgccd.RigidMotion, fraction: Tensor) -> dict[str, Tensor]:
        """Stopped boxes turn back."""
        position, q = motion.at(1.0)
        sign = torch.where(fraction < 1.0, -1.0, 1.0)[:, None]
        return {"position": position, "q": q, "v": sign * bodies.payload["v"], "w": sign * bodies.payload["w"]}


class Robots:
    """The nanorobots as a user would write them."""

    def __init__(self, count: int, device: torch.device) -> None:
        self.model = sim.Model(sim.ModelConfig(robots=count), device=device)
        self.half_extent = max(self.model.half_extent)
        state = self.model.start()
        self.position, self.meshes = state.position, self.model.meshes.meshes
        self.payload = {name: column for name, column in state.columns.items() if name not in ("id", "position")}

    def motion(self, bodies: distributed.Bodies) -> tuple[pgccd.RigidMotion, dict[str, Tensor]]:
        """By the plan of the model."""
        planned = self.model.plan(_state(bodies), bodies.step)
        return self.model.motion(planned), {name: getattr(planned, name) for name in sim.model.PLANNED}

    def response(self, bodies: distributed.Bodies, motion: pgccd.RigidMotion, fraction: Tensor) -> dict[str, Tensor]:
        """Stopped robots turn back."""
        new = sim.respond(_state(bodies), fraction)
        position, orientation = motion.at(1.0)
        turned = {"velocity": new.velocity, "angular_velocity": new.angular_velocity}
        return {"position": position, "orientation": orientation, **turned}


def _state(bodies: distributed.Bodies) -> sim.RobotState:
    return sim.RobotState(id=bodies.id, position=bodies.position, **bodies.payload)


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--bodies", type=int, nargs="+", default=[100_000])
    parser.add_argument("--worlds", choices=("boxes", "robots"), nargs="+", default=["boxes", "robots"])
    parser.add_argument("--steps-before", type=int, default=30, help="steps made before the first is timed")
    parser.add_argument("--steps", type=int, default=60, help="steps timed")
    arguments = parser.parse_args()
    device, rows = torch.device(arguments.device), []
    for count in arguments.bodies:
        for name in arguments.worlds:
            world: Boxes | Robots = Boxes(count, device) if name == "boxes" else Robots(count, device)
            for initial in ("assume_free", "report"):
                rows += measure_world(name, world, initial, arguments)
        if "robots" in arguments.worlds:
            rows.append(measure_own_step(count, device, arguments))
    results.table(rows)
    results.write("resolving_loop", device.type, {"rows": rows}, arguments.out)


def measure_world(
    name: str, world: Boxes | Robots, initial: Any, arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """A row for each way."""
    made = []
    for way in ("graph", "eager") if world.position.is_cuda else ("eager",):
        low, high = (-world.half_extent,) * 3, (world.half_extent,) * 3
        scene = pgccd.Scene(world.meshes, torch.arange(len(world.position)) % len(world.meshes), world.position.device)
        options = distributed.WorldOptions(initial=initial, nonzero_toi=True)
        given: dict[str, Any] = {"payload": world.payload, "options": options}
        bodies = distributed.World.create(scene, world.position, low, high, **given)
        loop = distributed.CapturedWorld(
            bodies, world.motion, world.response, way == "graph", resolve=True, tally=_stopped
        )
        loop.run(arguments.steps_before)
        steps, seconds = timed(lambda loop=loop: loop.run(arguments.steps))  # type: ignore[misc]
        made.append({
            "world": name, "bodies": len(world.position), "initial": initial, "way": way,
            "step_ms": round(1e3 * seconds / len(steps), 3),
            "replayed": sum(step.replayed for step in steps),
            "stopped": round(sum(step.tally[0] for step in steps) / len(steps) / len(world.position), 4),
            "rounds": round(sum(step.rounds for step in steps) / len(steps), 1),
            "state_hash": state_hash(bodies.id, bodies.position, bodies.payload),
        })  # fmt: skip
    made.append(measure_resolve(name, world, initial, arguments))
    if len({row["state_hash"] for row in made}) > 1:
        raise SystemExit("the ways end in different states")
    return made


def measure_resolve(name: str, world: Boxes | Robots, initial: Any, arguments: argparse.Namespace) -> dict[str, Any]:
    """The same loop by `pgccd.resolve`."""
    count, device = len(world.position), world.position.device
    id, payload = torch.arange(count, device=device), dict(world.payload)
    meshes = pgccd.Scene(world.meshes, torch.arange(count) % len(world.meshes), device=device)
    position, index = world.position.clone(), torch.zeros(1, dtype=torch.int64, device=device)
    stopped, rounds = torch.zeros(1, device=device), 0

    def run(steps: int) -> None:
        nonlocal position, payload, stopped, rounds
        for _ in range(steps):
            bodies = distributed.Bodies(id, position, meshes.mesh_index, payload, index)
            motion, planned = world.motion(bodies)
            payload |= planned
            resolved = pgccd.resolve(meshes, motion, initial=initial)
            bodies = distributed.Bodies(id, position, meshes.mesh_index, payload, index)
            new = world.response(bodies, resolved.motion, resolved.fraction)
            position, payload = new.pop("position"), payload | new
            index.add_(1)
            stopped, rounds = stopped + (resolved.fraction < 1.0).sum(), rounds + resolved.rounds

    run(arguments.steps_before)
    stopped.zero_()
    rounds = 0
    _, seconds = timed(lambda: run(arguments.steps))
    return {
        "world": name, "bodies": count, "initial": initial, "way": "resolve",
        "step_ms": round(1e3 * seconds / arguments.steps, 3), "replayed": 0,
        "stopped": round(float(stopped) / arguments.steps / count, 4),
        "rounds": round(rounds / arguments.steps, 1),
        "state_hash": state_hash(id, position, payload),
    }  # fmt: skip


def measure_own_step(count: int, device: torch.device, arguments: argparse.Namespace) -> dict[str, Any]:
    """The nanorobots' own step."""
    simulation = sim.Simulation.create(distributed.Alone(), sim.Model(sim.ModelConfig(robots=count), device=device))
    before, steps = arguments.steps_before, arguments.steps
    for index in range(before):
        simulation.step(index, more=before - 1 - index)
    made, seconds = timed(lambda: [simulation.step(before + k, more=steps - 1 - k) for k in range(steps)])
    records = [step.record for step in made]
    return {
        "world": "robots", "bodies": count, "initial": "assume_free", "way": "their own step",
        "step_ms": round(1e3 * seconds / steps, 3),
        "replayed": sum(not isinstance(step, sim.Step) for step in made),
        "stopped": round(sum(record["stopped"] for record in records) / steps / count, 4),
        "rounds": round(sum(record["resolution_rounds"] for record in records) / steps, 1),
        "state_hash": None,
    }  # fmt: skip


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What `call` returns, and its seconds."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    began = time.perf_counter()
    made = call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return made, time.perf_counter() - began


def state_hash(id: Tensor, position: Tensor, payload: dict[str, Tensor]) -> int:
    """Hash of the final state."""
    columns = [id, position, *(payload[name] for name in sorted(payload))]
    return row_hash([column.contiguous() for column in columns]) % 2**64


def _stopped(
    bodies: distributed.Bodies, _motion: pgccd.RigidMotion, fraction: Tensor, _pairs: Tensor, _toi: Tensor
) -> Tensor:
    return ((fraction < 1.0) & (bodies.id >= 0)).sum()[None]


if __name__ == "__main__":
    main()
