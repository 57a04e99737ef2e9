"""
Cloth: a sheet that drapes over a ball and never freezes
========================================================

A sheet of 1,600 vertices falls onto a ball, folds and meets itself. Each step has three parts: position-based dynamics
proposes a motion; the contacts of the proposal push the vertices of their features apart, several times; and
`pgccd.resolve` lets the sheet move as far as is certified. Without the second part the sheet freezes: `resolve` stops a
body as a whole, so that a single vertex on the ball stops all vertices.
"""

import matplotlib.pyplot as plt
import torch

import pgccd

# %%
# **The scene.** The sheet has `self_collision`: it is tested against itself too. The ball is `static`.

side, dt, steps = 40, 0.01, 80
grid = torch.cartesian_prod(*[torch.linspace(-1.0, 1.0, side, dtype=torch.float64)] * 2)
flat = torch.cat([grid, torch.full((side**2, 1), 0.55)], dim=1)
corner = torch.arange(side**2).view(side, side)
a, b, c, d = (part.reshape(-1) for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
sheet = pgccd.Mesh(flat, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]))
ball = pgccd.Mesh.icosphere(0.5, 3)
scene = pgccd.Scene([sheet, ball], static=[False, True], self_collision=[True, False])
count = len(flat)
x = torch.cat([flat, ball.vertices])
can_move = (torch.arange(len(x)) < count).double()

# %%
# **The proposal.** Springs along edges, and softer ones between vertices two apart, which resist bending.

edges = sheet.edges.long()
along = torch.stack([corner[:-2].reshape(-1), corner[2:].reshape(-1)], dim=1)
across = torch.stack([corner[:, :-2].reshape(-1), corner[:, 2:].reshape(-1)], dim=1)
springs = torch.cat([edges, along, across])
stiffness = torch.where(torch.arange(len(springs)) < len(edges), 1.0, 0.1).double()
rest = (flat[springs[:, 0]] - flat[springs[:, 1]]).norm(dim=1)
valence = torch.zeros(count).double().index_add_(0, springs.reshape(-1), torch.ones(2 * len(springs)).double())


def proposed(y: torch.Tensor) -> torch.Tensor:
    """The vertices of the sheet with its springs nearly at rest."""
    for _ in range(20):
        way = y[springs[:, 1]] - y[springs[:, 0]]
        change = (0.5 * stiffness * (1.0 - rest / way.norm(dim=1)))[:, None] * way
        moved = torch.zeros_like(y).index_add_(0, springs[:, 0], change).index_add_(0, springs[:, 1], -change)
        y = y + 1.2 * moved / valence[:, None]
    return y


# %%
# **The push.** `stencils` writes the gap of each contact as a weighted sum of four vertices. Where the gap at the end
# of the proposal is less than wanted, the vertices move along the normal, each by the mean of what its contacts ask
# for. The pushed vertices may meet others, so the search is repeated. If meshes have a thickness, or the scene has
# margins, those of both bodies are to be subtracted from the gap: see the guide on cloth.

THICKNESS, REACH = 2e-3, 4e-3


def pushed(x: torch.Tensor, goal: torch.Tensor) -> tuple[torch.Tensor, int]:
    """`goal` (X, 3) with features pushed apart, and the number of contacts of the proposal."""
    found = 0
    for attempt in range(8):
        hits = pgccd.detect(scene, pgccd.VertexMotion(x, goal), "all", min_separation=REACH)
        found = found if attempt else len(hits)
        if len(hits) == 0:
            break
        vertices, weights = hits.stencils(scene)
        gap = ((weights[..., None] * goal[vertices]).sum(dim=1) * hits.normal).sum(dim=1)
        gives = weights * can_move[vertices]
        push = (1.2 * REACH - gap).clamp(min=0.0) / (weights * gives).sum(dim=1).clamp(min=1e-9)
        moves = (push[:, None] * gives)[..., None] * hits.normal[:, None]
        is_pushed = ((push[:, None] > 0.0) & (gives.abs() > 1e-6)).double()
        pushes = torch.zeros(len(x)).double().index_add_(0, vertices.reshape(-1), is_pushed.reshape(-1))
        moved = torch.zeros_like(x).index_add_(0, vertices.reshape(-1), moves.reshape(-1, 3))
        goal = goal + moved / pushes.clamp(min=1.0)[:, None]
    return goal, found


# %%
# **The step.** `resolve` keeps a smaller distance than the push makes, so that it rarely has to stop the sheet. What it
# returns is certified: nothing meets on the way, the sheet itself included. `initial="assume_free"` leaves out the test
# of starts, since each step starts where a certified one ended.

velocity = torch.zeros_like(flat)
fractions, frames = [], [x]
for step in range(steps):
    velocity[:, 2] -= 9.81 * dt
    goal = torch.cat([proposed(x[:count] + dt * velocity), x[count:]])
    goal, contacts = pushed(x, goal)
    step_motion = pgccd.VertexMotion(x, goal)
    resolved = pgccd.resolve(scene, step_motion, min_separation=THICKNESS, initial="assume_free")
    fractions.append(float(resolved.fraction[0]))
    velocity = 0.99 * (resolved.motion.x_t1 - x)[:count] / dt
    x = resolved.motion.x_t1
    frames.append(x)
    if step % 20 == 19:
        print(
            f"step {step + 1:2d}: lowest z {float(x[:count, 2].min()):6.3f}; {contacts:4d} contacts were pushed apart; "
            f"least fraction {min(fractions):.2f}"
        )

# %%
# The sheet has fallen around the ball, no step was cut to nothing, and nothing touches:

assert min(fractions) > 0.1 and sum(fractions) > 0.98 * steps and float(x[:count, 2].min()) < -0.8
assert len(pgccd.collide(scene, pgccd.VertexMotion(x, x))) == 0

figure = plt.figure(figsize=(7.0, 5.5))
axes = figure.add_subplot(projection="3d")
for mesh, at, colour in ((sheet, x[:count], "tab:orange"), (ball, x[count:], "0.6")):
    axes.plot_trisurf(*at.T.numpy(), triangles=mesh.faces.numpy(), color=colour, edgecolor="0.3", lw=0.2)
axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1.3, 0.7))
axes.set_box_aspect((2.0, 2.0, 2.0), zoom=1.3)
axes.view_init(elev=10.0)
axes.set_axis_off()
plt.show()

# %%
# The whole fall.

pgccd.show(scene, pgccd.Trajectory(torch.stack(frames)))
