"""
Cloth: a line search that no contact escapes
============================================

A sheet falls onto a ball. Each time step minimises an energy: springs, gravity and inertia, and a repulsion of features
closer than a distance. The minimiser may never step through a contact, so before each of its steps `pgccd.detect` says
how far all vertices can go. This is the line search of incremental potential contact (IPC) and of other implicit
solvers. If `ipctk` is installed, its collision-free step is printed beside ours.
"""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch

import pgccd

# %%
# **The scene.** Bodies that deform are given by their vertices, one body after the other. The sheet has
# `self_collision`: it is tested against itself too. The ball does not move; `static` bodies are not tested against
# other static ones.

side = 15
grid = torch.cartesian_prod(*[torch.linspace(-1.0, 1.0, side, dtype=torch.float64)] * 2)
flat = torch.cat([grid, torch.full((side**2, 1), 0.62)], dim=1)
corner = torch.arange(side * side).view(side, side)
a, b, c, d = (part.reshape(-1) for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
sheet = pgccd.Mesh(flat, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]))
ball = pgccd.Mesh.icosphere(0.5, subdivisions=2)
scene = pgccd.Scene([sheet, ball], static=[False, True], self_collision=[True, False])

count = len(sheet.vertices)
x = torch.cat([flat, ball.vertices])

# %%
# **How far can all vertices go along a direction?** ``report="earliest"`` asks for the first contact of the scene
# alone, which is cheaper than all of them. No pair of features comes closer than `min_separation`, the thickness of the
# cloth; ``nonzero_toi=True`` keeps the answer above zero for features that are near each other but further apart than
# that.

THICKNESS, REACH = 1e-3, 0.02


def free_step(x: torch.Tensor, direction: torch.Tensor) -> float:
    """The fraction of `direction` (X, 3) that is free of contact from `x` (X, 3), less a tenth."""
    motion = pgccd.VertexMotion(x, x + direction)
    hits = pgccd.detect(scene, motion, "earliest", min_separation=THICKNESS, nonzero_toi=True)
    return min(1.0, 0.9 * float(hits.first_toi()))


# %%
# **Which features are near?** A motion at rest and `min_separation` set to the reach of the repulsion give all pairs of
# features closer than that. Each contact says where on its two features the nearest points are: the gap is a weighted
# sum of four vertices.


def near(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices (K, 4) and weights (K, 4) of the gap vectors between features closer than REACH."""
    hits = pgccd.detect(scene, pgccd.VertexMotion(x, x), "all", min_separation=REACH)
    return hits.stencils(scene)


# %%
# **The energy**, its gradient by autograd, and a matrix that turns the gradient into a direction: inertia and springs
# without their rotation (as in fast mass-spring solvers), and on its diagonal the repulsion of features that are near.

STIFFNESS, REPULSION, MASS, DT = 6.0, 400.0, 1.0 / count, 0.1
springs = torch.cat([sheet.edges.long(), torch.stack([corner[:-2].reshape(-1), corner[2:].reshape(-1)], 1)])
springs = torch.cat([springs, torch.stack([corner[:, :-2].reshape(-1), corner[:, 2:].reshape(-1)], 1)])
rest = (flat[springs[:, 0]] - flat[springs[:, 1]]).norm(dim=1)
incidence = torch.zeros(len(springs), count, dtype=torch.float64)
incidence[torch.arange(len(springs)), springs[:, 0]], incidence[torch.arange(len(springs)), springs[:, 1]] = 1.0, -1.0
stiff = MASS / DT**2 * torch.eye(count, dtype=torch.float64) + STIFFNESS * incidence.T @ incidence
gravity = torch.tensor([0.0, 0.0, -3.0], dtype=torch.float64)


def energy_at(rows: torch.Tensor, weights: torch.Tensor, aim: torch.Tensor) -> Callable[[torch.Tensor], torch.Tensor]:
    """The energy as a function of all vertices; `aim` is where inertia would take the sheet."""

    def energy(x: torch.Tensor) -> torch.Tensor:
        stretch = (x[springs[:, 0]] - x[springs[:, 1]]).norm(dim=1) - rest
        gap = (weights[..., None] * x[rows]).sum(dim=1).norm(dim=1)
        inertia = 0.5 * MASS / DT**2 * ((x[:count] - aim) ** 2).sum()
        repulsion = 0.5 * REPULSION * ((REACH - gap).clamp(min=0.0) ** 2).sum()
        return inertia + 0.5 * STIFFNESS * (stretch**2).sum() + repulsion

    return energy


# %%
# **The minimiser.** The step along the direction starts at the fraction that is free of contact, and is halved until
# the energy decreases. All positions that it tries lie on a path that has been tested.

ipctk = importlib.import_module("ipctk") if importlib.util.find_spec("ipctk") else None


def step_of_ipctk(ipctk: Any, x: torch.Tensor, direction: torch.Tensor) -> float:
    """The same question to IPC Toolkit: the step along `direction` that keeps THICKNESS."""
    edges = torch.cat([sheet.edges, ball.edges + count]).numpy()
    faces = torch.cat([sheet.faces, ball.faces + count]).numpy()
    ends = [np.asfortranarray(each.numpy()) for each in (x, x + direction)]
    return ipctk.compute_collision_free_stepsize(ipctk.CollisionMesh(ends[0], edges, faces), *ends, THICKNESS)


velocity = torch.zeros_like(flat)
fractions: list[float] = []
frames = [x]
for step in range(12):
    start, aim = x[:count], x[:count] + DT * velocity + DT**2 * gravity
    for _ in range(6):
        rows, weights = near(x)
        energy = energy_at(rows, weights, aim)
        variable = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(energy(variable), variable)
        direction = torch.zeros_like(x)
        near_each = torch.zeros(len(x), dtype=torch.float64).index_add_(0, rows.reshape(-1), (weights**2).reshape(-1))
        matrix = stiff + REPULSION * near_each[:count].diag()
        direction[:count] = torch.linalg.solve(matrix, -gradient[:count])
        if float(direction.norm(dim=1).max()) < 1e-4:
            break
        fraction = free_step(x, direction)
        fractions.append(fraction)
        if ipctk is not None and fraction < min(fractions[:-1], default=1.0):
            print(f"         free of contact: {fraction / 0.9:.4f}; ipctk: {step_of_ipctk(ipctk, x, direction):.4f}")
        before = energy(x)
        while fraction > 1e-6 and energy(x + fraction * direction) > before:
            fraction *= 0.5
        x = x + fraction * direction
    frames.append(x)
    velocity = 0.98 * (x[:count] - start) / DT
    if step % 2 == 1:
        shorter = sum(fraction < 1.0 for fraction in fractions)
        print(
            f"step {step + 1:2d}: lowest z {float(x[:count, 2].min()):6.3f}, {len(rows):2d} pairs of features near; "
            f"{shorter} of {len(fractions)} directions were cut, to {min(fractions):.2f} at least"
        )

# %%
# Nothing overlaps at the end, of course, and nothing did on the way:

still = pgccd.collide(scene, pgccd.VertexMotion(x, x))
print(f"pairs that touch: {still.pairs.tolist()}")

figure = plt.figure(figsize=(7.0, 5.5))
axes = figure.add_subplot(projection="3d")
for mesh, at, colour in ((sheet, x[:count], "tab:orange"), (ball, x[count:], "0.6")):
    axes.plot_trisurf(*at.T.numpy(), triangles=mesh.faces.numpy(), color=colour, edgecolor="0.3", lw=0.2)
axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-0.6, 0.7))
axes.set_box_aspect((2.0, 2.0, 1.3), zoom=1.4)
axes.view_init(elev=12.0)
axes.set_axis_off()
plt.show()

# %%
# The whole fall; the sheet is drawn on straight lines from one time step to the next.

pgccd.show(scene, pgccd.Trajectory(torch.stack(frames)))
