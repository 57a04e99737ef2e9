"""A torch loop: a thousand tumbling boxes that reverse where they meet. Pass "cuda" to run it on a GPU."""

import sys

import torch
import trimesh

import pgccd

device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
box = pgccd.Mesh.from_trimesh(trimesh.creation.box((1.0, 0.6, 0.3)).subdivide())
count = 1000
scene = pgccd.Scene([box], torch.zeros(count, dtype=torch.int32), device=device)

torch.manual_seed(0)
grid = torch.cartesian_prod(*[torch.arange(10.0)] * 3)
position = (1.5 * grid).to(device, torch.float64)
orientation = torch.nn.functional.normalize(torch.randn(count, 4, dtype=torch.float64)).to(device)
velocity = torch.randn(count, 3, dtype=torch.float64).to(device)
spin = torch.randn(count, 3, dtype=torch.float64).to(device)

dt = 0.1
for step in range(20):
    motion = pgccd.RigidMotion.from_velocity(position, orientation, velocity, spin, dt)
    # The fraction of its path that each body can move such that no two touch. (A body that stopped at its own toi,
    # while others went on, could be hit by some of them.)
    resolved = pgccd.resolve(scene, motion)
    position, orientation = resolved.motion.at(1.0)
    # The velocity of a stopped body is reversed, so that its gap grows at first.
    stopped = resolved.fraction < 1.0
    sign = torch.where(stopped, -1.0, 1.0)[:, None]
    velocity, spin = sign * velocity, sign * spin
    moved = float(resolved.fraction.mean())
    print(f"step {step:2d}: {int(stopped.sum())} bodies turn, {resolved.rounds} rounds; {moved:.1%} of all paths")
