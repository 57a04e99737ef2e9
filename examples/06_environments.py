"""
A thousand environments at once
===============================

Robot learning runs many copies of a small scene. Here each of a thousand environments has a flyer and twelve obstacles
at random places. One call tests all of them; bodies of different environments never meet. Pass "cuda" to run it on a
GPU, where a loop of `pgccd.CapturedDetection` is one CUDA graph a step.
"""

import sys

import matplotlib.pyplot as plt
import torch

import pgccd

device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
ENVIRONMENTS, OBSTACLES, SIZE, STEPS, DT = 1000, 12, 4.0, 25, 0.15

# %%
# **One scene for all.** Body rows are those of environment 0, then of environment 1, and so on. The column `world` says
# which environment a body belongs to. Obstacles are `static`: they are not tested against each other.

flyer = pgccd.Mesh.icosphere(0.2, subdivisions=2)
pillar, block = pgccd.Mesh.cylinder(0.15, 3.0), pgccd.Mesh.box([0.6] * 3)
each = [0] + [1] * (OBSTACLES // 2) + [2] * (OBSTACLES // 2)
rows = len(each)
scene = pgccd.Scene(
    [flyer, pillar, block],
    mesh_index=torch.tensor(each, dtype=torch.int32).repeat(ENVIRONMENTS),
    device=device,
    world=torch.arange(ENVIRONMENTS).repeat_interleave(rows),
    static=torch.tensor([False] + [True] * OBSTACLES).repeat(ENVIRONMENTS),
)

torch.manual_seed(0)
position = torch.rand(ENVIRONMENTS, rows, 3, dtype=torch.float64) * torch.tensor([2 * SIZE, 2 * SIZE, 2.0])
position[..., :2] += torch.tensor([1.0, -SIZE])  # obstacles stand at x > 1
position[:, 0] = torch.tensor([0.0, 0.0, 1.0])  # the flyer starts at x = 0
orientation = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(ENVIRONMENTS, rows, 1)
position, orientation = position.to(device), orientation.to(device)
still = torch.zeros_like(position).view(-1, 3)

# %%
# **A step.** A policy gives each flyer a velocity; here it is random with a drift along x. `hits.first_toi("world")` is
# the time of the first contact of each environment, inf without one. In each environment all bodies move until just
# before it; other environments do not matter. A flyer that hits something ends its episode.
#
# `pgccd.CapturedDetection` has the arguments of `pgccd.detect`. On a GPU it replays a graph and returns without waiting
# for it; the result has a fixed number of rows and is read by the same methods.

flying = torch.ones(ENVIRONMENTS, dtype=torch.bool, device=device)
velocity = torch.zeros_like(position)
captured = pgccd.CapturedDetection(
    scene, pgccd.RigidMotion.at_rest(position.view(-1, 3), orientation.view(-1, 4)), nonzero_toi=True
)
path, alive = [position[:, 0].clone()], []
FEW = 12  # environments to be shown
frames = [(position[:FEW], orientation[:FEW])]
generator = torch.Generator().manual_seed(1)
for step in range(STEPS):
    action = torch.randn(ENVIRONMENTS, 3, dtype=torch.float64, generator=generator).to(device)
    velocity[:, 0] = flying[:, None] * (action * 2.0 + torch.tensor([3.0, 0.0, 0.0], device=device))
    motion = pgccd.RigidMotion.from_velocity(
        position.view(-1, 3), orientation.view(-1, 4), velocity.view(-1, 3), still, dt=DT
    )
    first = captured(motion).first_toi("world")  # (ENVIRONMENTS,)
    fraction = (0.99 * first).clamp(max=1.0)
    position, orientation = (
        column.view(ENVIRONMENTS, rows, -1) for column in motion.at(fraction.repeat_interleave(rows))
    )
    flying = flying & (first == torch.inf)
    path.append(position[:, 0].clone())
    frames.append((position[:FEW], orientation[:FEW]))
    alive.append(int(flying.sum()))
    if step % 5 == 4:
        print(f"step {step + 1}: {alive[-1]} of {ENVIRONMENTS} flyers have met nothing")

# %%
# **Check.** No flyer is inside an obstacle, although none was ever tested at the end of a step alone. Contacts at rest
# are those with toi 0.

end = pgccd.RigidMotion.at_rest(position.view(-1, 3), orientation.view(-1, 4))
touching = pgccd.collide(scene, end)
print(f"pairs in contact at the end: {len(touching)}")
assert len(touching) == 0

figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.0), layout="constrained")
ways = torch.stack(path).cpu()  # (STEPS + 1, ENVIRONMENTS, 3)
left.plot(ways[..., 0], ways[..., 1], color="tab:blue", lw=0.4, alpha=0.2)
left.scatter(*ways[-1, ~flying.cpu(), :2].T, color="tab:red", s=3, zorder=3)
left.set(xlabel="x", ylabel="y", title="all flyers from above; red: where they met something", aspect="equal")
right.plot(range(1, STEPS + 1), alive)
right.set(xlabel="step", ylabel="flyers that have met nothing", ylim=(0, ENVIRONMENTS))
plt.show()

# %%
# The paths of the first twelve environments on a page, which shows one environment at a time.

few = pgccd.Scene(scene.meshes, scene.mesh_index[: FEW * rows], world=torch.arange(FEW).repeat_interleave(rows))
places, turns = (torch.stack(column).view(STEPS + 1, FEW * rows, -1) for column in zip(*frames, strict=True))
pgccd.show(few, pgccd.Trajectory(places, turns))

# %%
# Many policies need only who collides: `pgccd.collide` is the cheapest, and `may_collide("world")` of its result the
# answer.
# Environments that are reset write new rows into `position`. Which mesh a body has may change too: `Scene.mesh_index`,
# `Scene.world` and the other columns may be written between steps.
