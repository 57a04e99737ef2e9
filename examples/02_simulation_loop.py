"""
A torch loop with response
==========================

A thousand tumbling boxes; those that would collide stop before they do and turn round. The loop is plain torch. It
never lets two bodies overlap. Pass "cuda" to run it on a GPU.
"""

import sys

import matplotlib.pyplot as plt
import torch

import pgccd

device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
box = pgccd.Mesh.box([1.0, 0.6, 0.3])
count = 1000
scene = pgccd.Scene([box], torch.zeros(count, dtype=torch.int32), device=device)

# %%
# The state is four tensors. Positions and velocities are in the world frame, in any units of length and time; spins are
# in radians per time unit.

torch.manual_seed(0)
grid = torch.cartesian_prod(*[torch.arange(10.0)] * 3)
position = (1.5 * grid).to(device, torch.float64)
orientation = torch.nn.functional.normalize(torch.randn(count, 4, dtype=torch.float64)).to(device)
velocity = torch.randn(count, 3, dtype=torch.float64).to(device)
spin = torch.randn(count, 3, dtype=torch.float64).to(device)

# %%
# It is wrong to stop each body at its own time of impact while others go on: they were tested against its whole path,
# and may collide with it where it stops. `pgccd.resolve` finds the fraction of its path that each body can move such
# that no two touch, and tests the shortened motion once more. The velocity of a stopped body is reversed, so that its
# gap grows at first.

dt = 0.1
turning, motions, fractions = [], [], []
for step in range(20):
    motion = pgccd.RigidMotion.from_velocity(position, orientation, velocity, spin, dt)
    resolved = pgccd.resolve(scene, motion)
    position, orientation = resolved.motion.at(1.0)  # where the bodies are after the step
    motions.append(motion)
    fractions.append(resolved.fraction)
    stopped = resolved.fraction < 1.0
    sign = torch.where(stopped, -1.0, 1.0)[:, None]
    velocity, spin = sign * velocity, sign * spin
    moved = float(resolved.fraction.mean())
    turning.append(int(stopped.sum()))
    print(f"step {step:2d}: {turning[-1]} bodies turn, {resolved.rounds} rounds; {moved:.1%} of all paths")

# %%
# `Resolution.stopped_by` says which body stopped each one, and `Resolution.touching_at_start` lists pairs that were in
# contact before the step; here there are none, because every step ends without contact.

figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.2), layout="constrained")
left.bar(range(len(turning)), turning, color="tab:orange")
left.set(xlabel="step", ylabel="bodies that turn round", xticks=range(0, len(turning), 5))
x, y, _ = position.cpu().T
right.scatter(x, y, c=resolved.fraction.cpu(), cmap="viridis", s=14)
right.set(xlabel="x", ylabel="y", title="fraction of the last step that each body moved", aspect="equal")
figure.colorbar(right.collections[0], ax=right)
plt.show()

# %%
# The last five steps on a page, played one after another: on whole paths bodies would meet; on their shortened paths
# none does.

found = [pgccd.detect(scene, motion) for motion in motions[-5:]]
pgccd.show(scene, motions[-5:], found, fraction=fractions[-5:])

# %%
# What the response should be is for your simulation to decide; `pgccd.resolve` only says how far bodies can go. See
# :doc:`/how-to/resolve` for the rule and for what is certain, and :doc:`/how-to/cuda_graphs` for loops that do not wait
# for the GPU.
