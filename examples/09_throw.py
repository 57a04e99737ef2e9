"""
Gradients: a throw past moving gates
====================================

Contacts carry gradients: where a ball hits a wall, and when it hits a gate, as functions of how it is thrown. Here a
throw is tuned by gradient descent to hit a target behind two gates that are still in the way when it is thrown.
"""

import matplotlib.pyplot as plt
import torch

import pgccd

# %%
# **The scene**: a ball, two gates and a wall. The gates slide out of the way, one to each side. The ball flies on a
# parabola, of which a `pgccd.Trajectory` takes some points; between them it is straight.

ball, gate, wall = pgccd.Mesh.icosphere(0.15, 2), pgccd.Mesh.box([0.1, 1.6, 3.0]), pgccd.Mesh.box([0.1, 4.0, 4.0])
scene = pgccd.Scene([ball, gate, wall], mesh_index=[0, 1, 1, 2], mask=[-2, 1, 1, 1], group=[1, -2, -2, -2])
BALL, GATES, WALL = 0, (1, 2), 3

DURATION, TARGET = 1.2, torch.tensor([6.0 - 0.05, 0.3, 1.6], dtype=torch.float64)
time = torch.linspace(0.0, DURATION, 25, dtype=torch.float64)[:, None]
gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(len(time), 4, 4)


def thrown(velocity: torch.Tensor) -> pgccd.Trajectory:
    """The paths of all bodies, if the ball is thrown from (0, 0, 1) at this velocity (3,)."""
    origin = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    of_ball = origin + time * velocity + 0.5 * time**2 * gravity
    level, fixed = 1.5 * torch.ones_like(time), torch.zeros_like(time)
    first = torch.cat([fixed + 2.0, -0.4 - 2.0 * time, level], dim=1)
    second = torch.cat([fixed + 4.0, 0.6 + 1.3 * time, level], dim=1)
    behind = torch.cat([fixed + 6.0, fixed, level], dim=1)
    return pgccd.Trajectory(torch.stack([of_ball, first, second, behind], dim=1), upright)


# %%
# **What is minimised**: the distance between the point of contact on the wall and the target; and for each gate that is
# hit, how early that happens: a later contact is nearer to none. `Contacts.point` and the `time` of a trajectory's
# contacts require grad, because the positions do.


def loss_of(velocity: torch.Tensor) -> tuple[torch.Tensor, pgccd.TrajectoryContacts]:
    """The loss, and each pair's first contact."""
    hits = pgccd.detect(scene, thrown(velocity))
    partner = hits.pairs[:, 1]
    miss = ((hits.point[partner == WALL] - TARGET) ** 2).sum()
    early = (1.0 - hits.time[partner < WALL]).sum()
    return miss + early, hits


velocity = torch.tensor([11.0, -0.4, 2.0], dtype=torch.float64, requires_grad=True)
optimizer = torch.optim.Adam([velocity], lr=0.1)
throws = []
for step in range(160):
    optimizer.zero_grad()
    loss, hits = loss_of(velocity)
    loss.backward()
    throws.append((velocity.detach().clone(), hits.pairs[:, 1].tolist()))
    if step % 20 == 0 or step == 159:
        met = [f"gate {body}" for body in hits.pairs[:, 1].tolist() if body in GATES] or ["no gate"]
        place = hits.point[hits.pairs[:, 1] == WALL].detach()
        miss = float((place - TARGET).norm()) if len(place) else float("inf")
        rounded = [round(v, 3) for v in velocity.tolist()]
        print(f"{step:3d}: velocity {rounded}, meets {' and '.join(met)}, misses by {miss:.4f}")
    optimizer.step()

# %%
# The last throw passes both gates, and hits the target. That is not a matter of sampling: `pgccd.detect` finds every
# contact on the path between the points.

assert throws[-1][1] == [WALL] and miss < 1e-2

figure, axes = plt.subplots(2, 1, figsize=(8.0, 6.5), sharex=True)
for number, (thrown_at, met_bodies) in enumerate(throws[::6]):
    path = thrown(thrown_at).position[:, BALL].numpy()
    path = path[path[:, 0] < 6.0]
    colour = "tab:orange" if set(met_bodies) & set(GATES) else "tab:blue"
    for axis, column in zip(axes, (2, 1), strict=True):
        axis.plot(path[:, 0], path[:, column], color=colour, alpha=0.25 + 0.6 * number / len(throws[::6]), lw=1.0)
final = thrown(throws[-1][0]).position
for body, colour in ((1, "0.4"), (2, "0.4")):
    passing = int((final[:, BALL, 0] - final[:, body, 0]).abs().argmin())
    x, y, z = final[passing, body].tolist()
    axes[0].add_patch(plt.Rectangle((x - 0.05, z - 1.5), 0.1, 3.0, color=colour, alpha=0.3))
    axes[1].add_patch(plt.Rectangle((x - 0.05, y - 0.8), 0.1, 1.6, color=colour))
for axis, column in zip(axes, (2, 1), strict=True):
    axis.plot(TARGET[0], TARGET[column], "r*", markersize=14)
    axis.axvline(5.95, color="0.4", lw=3.0)
axes[0].set(ylabel="z", ylim=(-0.5, 3.2), title="orange: throws that meet a gate; blue: those that meet none")
axes[1].set(xlabel="x", ylabel="y, gates as the last throw passes them", ylim=(-3.2, 3.2))
plt.show()

# %%
# A contact appears or disappears when the path only just touches: there the loss jumps, and the gradient of the time of
# contact grows without bound on the one side. `Contacts.differentiable` is False where there is no derivative, and the
# gradient is zero there. `docs/how-to/gradients.md` lists these cases.
