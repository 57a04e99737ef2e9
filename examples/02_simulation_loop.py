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

dt, time = 0.1, 0.0
for step in range(20):
    motion = pgccd.RigidMotion.from_velocity(position, orientation, velocity, spin, dt)
    # nonzero_toi: of bodies that come very close, too, the toi is not 0, so that the loop goes on.
    hits = pgccd.detect(scene, motion, nonzero_toi=True)
    # All bodies move by the same fraction of the step: until just before the first contact of the scene. A body that
    # stopped at its own toi, while others went on, would be in the way of some of them.
    first = hits.first_toi("body")
    fraction = (0.9 * first.min()).clamp(max=1.0)
    position, orientation = motion.at(fraction)
    # Bodies that would touch soon go back the way they came: their gap grows at first.
    sign = torch.where(first < 2.0 * fraction, -1.0, 1.0)[:, None]
    velocity, spin = sign * velocity, sign * spin
    time += dt * float(fraction)
    turned = int((sign < 0.0).sum())
    print(f"step {step:2d}: {hits.stats.pcs} pairs, {len(hits)} contacts, {turned} bodies turn; time {time:.4f}")
