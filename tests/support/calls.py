"""Every public call on a scene, as columns of its result: for comparisons of devices, threads, copies and worlds."""

from __future__ import annotations

import copy
import itertools
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd.robots import Obstacles
from support.arms import loaded, random_arm
from support.random_scenes import LAYOUTS, RandomScene
from support.reports import captured_loop, detected, trimmed
from support.shapes import unit_quaternions

Columns = dict[str, Tensor]
#: Largest difference of gradients, relative to the largest entry of each, for each radian of the fastest turn and one
#: more: sines of large angles are rounded in units of the angle.
OF_GRADIENTS = 1e-12
# Contacts whose derivatives are compared: the gap closes at least at this part of the speed of points.
_CLOSING = 1e-2
# The arms of one scene in so many.
_ARMS = 16


@dataclass
class Given:
    """A scene on a device."""

    scene: RandomScene
    bodies: pgccd.Scene
    motion: Any
    device: str

    @classmethod
    def of(cls, scene: RandomScene, device: str = "cpu") -> Given:
        return cls(scene, scene.scene(device), scene.motion(device), device)

    def copied(self, way: Callable[[Any], Any]) -> Given:
        return Given(self.scene, way(self.bodies), way(self.motion), self.device)

    @property
    def is_step(self) -> bool:
        return not isinstance(self.motion, pgccd.Trajectory)

    def detect(self, report: str, **more: Any) -> Any:
        return detected(self.bodies, self.motion, **(self.scene.arguments | {"report": report} | more))

    @property
    def length(self) -> float:
        """A small length of this scene."""
        return float(self.bodies.radius.min())


def through_states(value: Any) -> Any:
    """A copy by its `state_dict`."""
    state = value.state_dict()
    if isinstance(value, pgccd.Scene):
        return pgccd.Scene.from_state_dict(state, value.device)
    return type(value).from_state_dict(state)


#: Copies of scenes and motions.
COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "to": lambda value: value.to(value.device),
    "state_dict": through_states,
}


def _on_cpu(columns: dict[str, Any]) -> Columns:
    return {name: column.detach().cpu() for name, column in columns.items()}


def _detected(report: str, given: Given) -> Columns:
    hits = given.detect(report)
    columns = dict(hits.columns)
    if report in ("first", "all"):
        rates = pgccd.approach_rates(given.bodies, given.motion, hits)
        columns |= {"approach": rates, "starts_intersecting": hits.starts_intersecting}
        columns |= {f"first of {by}": hits.first_toi(by).reshape(-1) for by in ("scene", "world", "body")}
        columns |= {
            f"earliest by {by} {n}": c for by in ("scene", "world") for n, c in hits.earliest(by=by).columns.items()
        }
    columns |= {f"may_collide {by}": hits.may_collide(by).reshape(-1) for by in ("scene", "world", "body")}
    return _on_cpu(columns)


def _of_surfaces(given: Given) -> Columns:
    report = "all" if given.scene.layout in LAYOUTS else "first"  # hard scenes have very many contacts
    return _on_cpu(given.detect(report, normals="surface").columns)


def _approaching(given: Given) -> Columns:
    of_step = given.bodies, given.motion
    hits = pgccd.approaching(*of_step, given.detect("first"))
    return _on_cpu(hits.columns | {"approach": pgccd.approach_rates(*of_step, hits)})


def _copied_results(given: Given) -> Columns:
    """Of copies of results, which must be those that were copied."""
    found = {}
    for report in ("first", "any"):
        hits = given.detect(report)
        for name, way in (COPIES | {"to": lambda value: value.to(value.pairs.device)}).items():
            again = way(hits)
            if again != hits:
                raise AssertionError(f"{name} of contacts of report {report!r} differs")
            found |= {f"{report} {name} {key}": column for key, column in again.columns.items()}
    return _on_cpu(found)


def _movable(given: Given) -> Tensor:
    generator = torch.Generator().manual_seed(given.scene.seed)
    return (torch.rand(given.bodies.body_count, generator=generator) < 0.7).to(given.device)


def _options(given: Given) -> dict[str, Any]:
    names = ("min_separation", "tolerance", "initial")
    return {name: given.scene.arguments[name] for name in names}


def _resolved(given: Given, movable: bool = False) -> Columns:
    may = _movable(given) if movable else None
    found = pgccd.resolve(given.bodies, given.motion, may, **_options(given))
    motions = found.segments if isinstance(found, pgccd.TrajectoryResolution) else [found.motion]
    columns = {f"motion {k} {n}": c for k, m in enumerate(motions) for n, c in m.columns().items()}
    names = ("fraction", "stopped_by", "touching_at_start", "unresolved")
    return _on_cpu(columns | {n: getattr(found, n) for n in names} | {"rounds": torch.tensor([found.rounds])})


def _resolved_padded(given: Given) -> Columns:
    hits = given.detect("first", nonzero_toi=True)
    assert hits.stats.needed is not None
    capacity = hits.stats.needed.times(4.0)
    padded = pgccd.resolve(given.bodies, given.motion, capacity=capacity, rounds=6, **_options(given))
    names = ("fraction", "stopped_by", "incomplete", "rounds")
    lists = {name: getattr(padded, name) for name in ("touching_at_start", "unresolved")}
    trimmed = {name: pairs[pairs[:, 0] >= 0] for name, pairs in lists.items()}
    return _on_cpu({name: getattr(padded, name) for name in names} | trimmed | padded.motion.columns())


def _distances(given: Given, pairs: bool = False) -> Columns:
    tolerance = 1e-3 * given.length
    if not pairs:
        found = pgccd.distance(given.bodies, given.motion, cutoff=0.3 * given.length, tolerance=tolerance)
    else:
        generator = torch.Generator().manual_seed(given.scene.seed)
        every = list(itertools.combinations(range(given.bodies.body_count), 2))
        some = torch.tensor(every, dtype=torch.int64).reshape(-1, 2)
        some = some[torch.randperm(len(some), generator=generator)[:6]].to(given.device)
        found = pgccd.distance(given.bodies, given.motion, pairs=some, tolerance=tolerance)
    return _on_cpu(vars(found))


def _exit_distances(given: Given) -> Columns:
    """Of rigid and deforming bodies, along a direction that depends on the scene."""
    direction = torch.randn(3, dtype=torch.float64, generator=torch.Generator().manual_seed(given.scene.seed))
    options = {name: given.scene.arguments[name] for name in ("min_separation", "tolerance")}
    return _on_cpu(vars(pgccd.exit_distance(given.bodies, given.motion, direction.tolist(), **options)))


def _enclosed(given: Given) -> Columns:
    return _on_cpu({"pairs": pgccd.enclosed(given.bodies, given.motion)})


def _audited(given: Given) -> Columns:
    motion = given.motion
    if given.is_step:
        ends = motion.at(torch.tensor([[0.0], [1.0]], dtype=torch.float64))
        motion = pgccd.Trajectory(ends) if isinstance(ends, Tensor) else pgccd.Trajectory(*ends)
    options = {name: given.scene.arguments[name] for name in ("min_separation", "tolerance")}
    found = pgccd.audit(given.bodies, motion, **options)
    columns = {f"passages {n}": c for n, c in found.passages.columns.items()}
    columns |= {f"enclosed {n}": c for n, c in found.enclosed.columns.items()}
    columns |= {f"touching {n}": c for n, c in vars(found.touching).items()}
    return _on_cpu(columns)


def _captured(report: str, given: Given) -> Columns:
    loop = captured_loop(given.bodies, given.motion, **(given.scene.arguments | {"report": report}))
    loop(given.motion)
    return _on_cpu(trimmed(loop).columns)


def _padded(report: str, given: Given) -> Columns:
    needed = given.detect(report).stats.needed
    return _on_cpu(given.detect(report, capacity=needed.times(1.5)).trim().columns)


def _gradients(given: Given) -> Columns:
    poses = [column.to(given.device, copy=True).requires_grad_() for column in given.scene.poses]
    margin = None if given.bodies.margin is None else given.bodies.margin.clone().requires_grad_()
    bodies = given.bodies
    if margin is not None:
        bodies = replace_margin(bodies, margin)
    motion = replace(given.scene, poses=poses).motion(given.device)
    hits = pgccd.detect(bodies, motion, **(given.scene.arguments | {"report": "first"}))
    columns = {name: column.detach() for name, column in hits.columns.items()}
    rates = pgccd.approach_rates(bodies, motion, hits)
    approach = rates.detach()
    columns["approach"] = approach
    if not len(hits):
        return _on_cpu(columns)
    counts = hits.differentiable & (approach > _CLOSING * _speed(bodies, motion))
    columns["differentiable"], columns["turn"] = hits.differentiable, _largest_turn(motion)
    generator = torch.Generator().manual_seed(given.scene.seed)
    loss = torch.zeros((), dtype=torch.float64, device=given.device)
    for name in ("toi", "point", "normal", "coordinates", "approach"):
        column = (rates if name == "approach" else getattr(hits, name)).reshape(len(hits), -1)
        weights = torch.randn(column.shape, dtype=torch.float64, generator=generator).to(given.device)
        loss = loss + (column * weights)[counts].sum()
    wanted = [*poses, *([] if margin is None else [margin])]
    if loss.requires_grad:
        for k, gradient in enumerate(torch.autograd.grad(loss, wanted, allow_unused=True)):
            columns[f"gradient {k}"] = torch.zeros(0) if gradient is None else gradient
    return _on_cpu(columns)


def _largest_turn(motion: pgccd.RigidMotion | pgccd.VertexMotion | pgccd.Trajectory) -> Tensor:
    """(1,) radians of the fastest body in a step; 0 where bodies deform."""
    steps = motion.steps() if isinstance(motion, pgccd.Trajectory) else motion
    if isinstance(steps, pgccd.VertexMotion):
        return torch.zeros(1)
    return steps.rotation.detach().cpu().norm(dim=1).amax(dim=0, keepdim=True)


def _speed(bodies: pgccd.Scene, motion: pgccd.RigidMotion | pgccd.VertexMotion | pgccd.Trajectory) -> float:
    """An upper bound of the distance that a point moves in a step."""
    steps = motion.steps() if isinstance(motion, pgccd.Trajectory) else motion
    if isinstance(steps, pgccd.VertexMotion):
        return float((steps.x_t1 - steps.x_t0).detach().norm(dim=1).max())
    reach = max(float(mesh.vertices.norm(dim=1).max()) for mesh in bodies.meshes.meshes)
    travel, turn = steps.position_t1 - steps.position_t0, steps.rotation
    return float((travel.detach().norm(dim=1) + reach * turn.detach().norm(dim=1)).max())


def replace_margin(bodies: pgccd.Scene, margin: Tensor) -> pgccd.Scene:
    """The scene with these margins."""
    other = copy.copy(bodies)
    other.margin = margin
    return other


def _broad(given: Given) -> Columns:
    moving = pgccd.MovingBodies.of(given.bodies, given.motion)
    options = given.scene.arguments["min_separation"]
    return _on_cpu({name: pgccd.broad.find_pairs(moving, options, name) for name in ("sweep", "grid", "lbvh")})


def _certified(given: Given) -> Columns:
    rng = np.random.default_rng([given.scene.seed, 4])
    with tempfile.TemporaryDirectory() as folder:
        robot = loaded(random_arm(rng, 5), Path(folder))
    start = rng.uniform(-1.2, 1.2, (6, 1, robot.joint_count))
    q = start + np.concatenate([0 * start, rng.normal(size=(6, 2, robot.joint_count)).cumsum(axis=1)], axis=1)
    meshes = [pgccd.Mesh.box(2.0 * half) for half in rng.uniform(0.03, 0.15, (3, 3))]
    position = robot.reach * rng.uniform(-0.6, 0.6, (3, 3))
    obstacles = Obstacles(meshes, torch.tensor(position), torch.tensor(unit_quaternions(rng, 3)))
    curves = pgccd.Spline(torch.tensor(q[:, [0, 1, 1, 2, 2]], device=given.device).movedim(0, 1), 2)
    paths = torch.tensor(q, device=given.device)
    found = {"": robot.certify(paths, obstacles), "curve ": robot.certify(curves, obstacles)}
    named = {f"{of}{name}": column for of, each in found.items() for name, column in each.columns.items()}
    near = robot.clearance(curves, obstacles, tolerance=0.02 * robot.reach)
    return _on_cpu(named | {f"clearance {name}": column for name, column in near.columns.items()})


def _always(given: Given) -> bool:
    return True


def _of_steps(given: Given) -> bool:
    return given.is_step


def _without_offset(given: Given) -> bool:
    """Far from the origin derivatives by poses have fewer digits."""
    return float(given.scene.poses[0].abs().max()) < 1e3 and given.scene.arguments["tolerance"] is None


def _approaches(given: Given) -> bool:
    """One scene of two, of hundreds of contacts of a pair one of four: `approaching` takes longer than all others."""
    return given.scene.seed % (40 if given.scene.layout == "crossing" else 4) < 2


_REPORTS = ("first", "all", "any", "earliest")
#: By name: the call, and the scenes that it is made for.
CALLS: dict[str, tuple[Callable[[Given], Columns], Callable[[Given], bool]]] = {
    **{f"detect {report}": (partial(_detected, report), _always) for report in _REPORTS},
    "surface normals": (_of_surfaces, _always),
    "approaching": (_approaching, _approaches),
    "copies of contacts": (_copied_results, _always),
    "resolve": (_resolved, _always),
    "resolve movable": (partial(_resolved, movable=True), _always),
    "resolve padded": (_resolved_padded, _of_steps),
    "distance": (_distances, _always),
    "distance of pairs": (partial(_distances, pairs=True), _always),
    "exit distance": (_exit_distances, _of_steps),
    "enclosed": (_enclosed, _always),
    "audit": (_audited, lambda given: given.scene.kind != "linear"),
    **{f"captured {report}": (partial(_captured, report), _of_steps) for report in _REPORTS},
    **{f"padded {report}": (partial(_padded, report), _of_steps) for report in _REPORTS},
    "gradients": (_gradients, _without_offset),
    "broad": (_broad, _of_steps),
    "certify": (_certified, lambda given: given.scene.seed % _ARMS == 5),
}
# Those whose rows can be told apart by world.
_BY_WORLD = ("detect first", "detect all", "surface normals", "approaching", "resolve", "distance")


def made(name: str, given: Given) -> Columns | str:
    """The columns of a call, or its error."""
    try:
        return CALLS[name][0](given)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def twofold(scene: RandomScene) -> RandomScene:
    """All bodies twice, the second time in other worlds."""
    count = len(scene.mesh_index)
    world = scene.filters.get("world", torch.zeros(count, dtype=torch.int32))
    filters = {name: column.repeat(2) for name, column in scene.filters.items()}
    filters["world"] = torch.cat([world, world + int(world.max()) + 1])
    exclude = None if scene.exclude is None else torch.cat([scene.exclude, scene.exclude + count])
    poses = [torch.cat([column, column], dim=-2) for column in scene.poses]
    return replace(scene, mesh_index=scene.mesh_index.repeat(2), filters=filters, poses=poses, exclude=exclude)


def is_by_world(name: str) -> bool:
    return name in _BY_WORLD


def of_second_world(name: str, columns: Columns, count: int) -> Columns:
    """What a call found for the second half of `twofold` bodies, with numbers of the first half."""

    def lowered(pairs: Tensor) -> Tensor:
        return pairs[pairs[:, 0] >= count] - count

    if name == "resolve":
        by = columns["stopped_by"][count:]
        return {
            "fraction": columns["fraction"][..., count:],
            "stopped_by": torch.where(by >= 0, by - count, by),
            **{key: lowered(columns[key]) for key in ("touching_at_start", "unresolved")},
        }
    rows = columns["pairs"][:, 0] >= count
    some = {key: column[rows] for key, column in columns.items() if len(column) == len(rows) and is_row(key)}
    return some | {"pairs": some["pairs"] - count}


def is_row(key: str) -> bool:
    """Whether a column has a row for each contact or pair."""
    return not key.startswith(("first of", "may_collide", "earliest by"))
