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

for step in range(20):
    motion = pgccd.RigidMotion.from_velocity(position, orientation, velocity, spin, dt=0.1)
    hits = pgccd.detect(scene, motion, nonzero_toi=True)
    # All bodies move until the first contact of the scene; those that touch then reverse.
    toi = hits.toi.min() if len(hits) else torch.ones((), dtype=torch.float64, device=device)
    position = position + toi * (motion.position_t1 - position)
    orientation = pgccd.integrate_orientation(orientation, toi * motion.rotation)
    touching = hits.pairs[hits.toi <= toi].flatten()
    velocity[touching] *= -1
    print(f"step {step:2d}: {hits.stats.pcs} pairs, {len(hits)} contacts, all free until t = {float(toi):.4f}")
