"""Derivatives of contacts against central differences of detection, on random pairs of bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

import pgccd

#: Kinds of motion.
MOTIONS = ("arcs", "linear", "vertices", "trajectory")
#: Of both sides of the comparison.
TOLERANCE = 1e-12
_STEP = 5e-4  # of the differences; its fourth power is their error
_COLUMNS = ("toi", "point", "coordinates", "normal", "approach")

Inputs = dict[str, Tensor]


@cache
def meshes() -> list[pgccd.Mesh]:
    """A tetrahedron, a box and a sphere, of similar size."""
    corners = [[-0.5, -0.4, -0.3], [1.0, -0.2, 0.1], [-0.3, 0.9, 0.0], [0.0, 0.1, 1.1]]
    tetrahedron = pgccd.Mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return [tetrahedron, pgccd.Mesh.box([1.4, 1.0, 0.8]), pgccd.Mesh.icosphere(0.8, subdivisions=1)]


@dataclass
class Case:
    """Pairs of bodies, each in a world of its own: derivatives of one do not depend on the others.

    Args:
        inputs: float64, what is differentiated: columns of the motion, margins and the separation.
        detect: contacts of these inputs, of each pair the first.
        rates: `pgccd.approach_rates` of these inputs and contacts.
        world: of each row of each input.
    """

    inputs: Inputs
    detect: Callable[[Inputs], pgccd.Contacts]
    rates: Callable[[Inputs, pgccd.Contacts], Tensor]
    world: dict[str, Tensor]

    def column(self, name: str, given: Inputs, hits: pgccd.Contacts) -> Tensor:
        """(K, n): a column of contacts of these inputs, or their rates."""
        values: Tensor = self.rates(given, hits) if name == "approach" else getattr(hits, name)
        return values.reshape(len(hits), -1)


def random_case(motion: str, count: int, separated: bool, seed: int, device: torch.device) -> Case:
    """`count` pairs, most of which collide.

    Args:
        motion: one of `MOTIONS`.
        separated: whether bodies have margins and there is a separation.
    """
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=random)

    index = torch.randint(0, 3, (2 * count,), generator=random)
    world = torch.arange(count).repeat_interleave(2)
    away = torch.nn.functional.normalize(normal(count, 3), dim=1)
    x0, x1 = 0.1 * normal(2 * count, 3), 0.2 * normal(2 * count, 3)
    x0[1::2] += 3.0 * away
    x1[1::2] -= 0.5 * away
    q0 = torch.nn.functional.normalize(normal(2 * count, 4), dim=1)
    turn = 0.8 * normal(2 * count, 3)
    margin = 0.1 * torch.rand(2 * count, dtype=torch.float64, generator=random) + 0.05
    more: Inputs = {"margin": margin, "separation": torch.tensor(0.03, dtype=torch.float64)} if separated else {}
    rows = {name: world for name in ("x0", "q0", "x1", "turn", "margin", "q1")}
    inputs: Inputs = {"x0": x0, "q0": q0, "x1": x1, "turn": turn}
    set_of_meshes = pgccd.MeshSet(meshes(), device)
    index, world_on_device = index.to(device), world.to(device)

    def scene(given: Inputs) -> pgccd.Scene:
        return pgccd.Scene(set_of_meshes, index, world=world_on_device, margin=given.get("margin"))

    if motion == "vertices":
        at_rest = pgccd.RigidMotion.from_rotation(x0, q0, x1, turn)
        ends = [
            torch.cat([x + _turned(q, m) for x, q, m in zip(*at_rest.at(t), index.tolist(), strict=True)])
            for t in (0.0, 1.0)
        ]
        own = world.repeat_interleave(torch.tensor([len(meshes()[m].vertices) for m in index.tolist()]))
        wobble = 0.02 * normal(*ends[1].shape)
        inputs, rows = {"x0": ends[0], "x1": ends[1] + wobble}, rows | {"x0": own, "x1": own}
    if motion == "trajectory":
        inputs = {
            "x0": x0,
            "q0": q0,
            "x1": x1,
            "q1": torch.nn.functional.normalize(q0 + 0.4 * normal(2 * count, 4), dim=1),
        }

    def path(given: Inputs) -> pgccd.RigidMotion | pgccd.VertexMotion | pgccd.Trajectory:
        if motion == "vertices":
            return pgccd.VertexMotion(given["x0"], given["x1"])
        if motion == "trajectory":
            # Through the middle of the positions and of the orientations.
            unit = [q / q.norm(dim=1, keepdim=True) for q in (given["q0"], given["q0"] + given["q1"], given["q1"])]
            position = torch.stack([given["x0"], 0.5 * (given["x0"] + given["x1"]), given["x1"]])
            return pgccd.Trajectory(position, torch.stack(unit))
        kind = "linear" if motion == "linear" else "rigid"
        turned = given["q0"] / given["q0"].norm(dim=1, keepdim=True)
        return pgccd.RigidMotion.from_rotation(given["x0"], turned, given["x1"], given["turn"], kind)

    def detect(given: Inputs) -> pgccd.Contacts:
        separation = given.get("separation", 0.0)
        return pgccd.detect(scene(given), path(given), min_separation=separation, tolerance=TOLERANCE)

    def rates(given: Inputs, hits: pgccd.Contacts) -> Tensor:
        return pgccd.approach_rates(scene(given), path(given), hits)

    inputs = {name: values.to(device) for name, values in (inputs | more).items()}
    return Case(inputs, detect, rates, {name: row.to(device) for name, row in rows.items() if name in inputs})


def _turned(orientation: Tensor, mesh: int) -> Tensor:
    vertices = meshes()[mesh].vertices
    axis = orientation[1:].expand_as(vertices)
    twice = 2.0 * torch.linalg.cross(axis, vertices)
    return vertices + orientation[0] * twice + torch.linalg.cross(axis, twice)


def errors(case: Case, seed: int = 0) -> dict[str, Tensor]:
    """Errors of derivatives in a random direction, by column (K,), relative to the differences (or a tenth of their
    median, if that is more), of contacts that are differentiable and keep their features.
    """
    random = torch.Generator().manual_seed(seed)
    along = {
        name: torch.randn(x.shape, dtype=torch.float64, generator=random).to(x.device)
        for name, x in case.inputs.items()
    }
    wanting = {name: values.clone().requires_grad_() for name, values in case.inputs.items()}
    hits = case.detect(wanting)
    count = int(hits.pairs.max()) // 2 + 1
    places = [{name: x + k * _STEP * along[name] for name, x in case.inputs.items()} for k in (-2, -1, 1, 2)]
    moved = [case.detect(place) for place in places]
    row, kept = torch.full((count,), -1, device=hits.pairs.device), hits.differentiable
    for other in moved:
        row = torch.full_like(row, -1)
        row[other.pairs[:, 0] // 2] = torch.arange(len(other), device=row.device)
        mine = row[hits.pairs[:, 0] // 2]
        same = (other.kind[mine] == hits.kind) & (other.features[mine] == hits.features).all(1) & (mine >= 0)
        if isinstance(other, pgccd.TrajectoryContacts) and isinstance(hits, pgccd.TrajectoryContacts):
            same &= other.segment[mine] == hits.segment
        limits = (0.0, 1.0)
        for limit in limits:  # the same coordinates at a limit: as many as move by an edge or a corner
            same &= ((other.coordinates[mine] == limit) == (hits.coordinates == limit)).all(1)
        on_third = [(c.coordinates.sum(1) > 1.0 - 1e-15) & (c.kind != pgccd.Kind.EE) for c in (other, hits)]
        kept = kept & same & (on_third[0][mine] == on_third[1])
    found = {}
    for name in _COLUMNS:
        column = case.column(name, wanting, hits)
        weights = torch.randn(column.shape[1], dtype=torch.float64, generator=random).to(column.device)
        grads = torch.autograd.grad((column @ weights).sum(), list(wanting.values()), retain_graph=True)
        derivative = torch.zeros(count, dtype=torch.float64, device=column.device)
        for key, gradient in zip(wanting, grads, strict=True):
            if key != "separation":
                terms = (gradient * along[key]).reshape(len(gradient), -1).sum(1)
                derivative = derivative.index_add(0, case.world[key], terms)
        values = []
        for place, other in zip(places, moved, strict=True):
            row[other.pairs[:, 0] // 2] = torch.arange(len(other), device=row.device)
            values.append(case.column(name, place, other)[row[hits.pairs[:, 0] // 2]] @ weights)
        differences = (values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / (12.0 * _STEP)
        by_row = derivative[hits.pairs[:, 0] // 2]
        if "separation" in wanting:  # that of all pairs is one number: each row's own is found by its own backward
            by_row = by_row + _of_separation(case, name, weights, hits) * along["separation"]
        scale = differences[kept].abs()
        scale = scale.clamp(min=0.1 * float(scale.median()))
        found[name] = (by_row - differences)[kept].abs() / scale
    return found


def _of_separation(case: Case, name: str, weights: Tensor, hits: pgccd.Contacts) -> Tensor:
    """(K,): derivatives by the separation, as those by a margin of one body of each pair."""
    plain = {key: values.detach() for key, values in case.inputs.items()}
    margin = plain["margin"].clone().requires_grad_()
    given = plain | {"margin": margin}
    column = case.column(name, given, case.detect(given))
    (gradient,) = torch.autograd.grad((column @ weights).sum(), margin)
    return gradient[hits.pairs[:, 0]]
