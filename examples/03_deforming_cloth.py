"""A sheet that sags onto a ball: vertex streams instead of poses, and every touching feature pair."""

import numpy as np
import torch
import trimesh

import pgccd

side = 20
x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
corner = np.arange(side * side).reshape(side, side)
quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
flat = np.stack([x, y, np.full_like(x, 1.05)], axis=-1).reshape(-1, 3)
sagging = flat - 0.15 * np.stack([0 * x, 0 * x, np.exp(-3 * (x**2 + y**2))], axis=-1).reshape(-1, 3)

ball = trimesh.creation.icosphere(subdivisions=3)
scene = pgccd.Scene([pgccd.Mesh(flat, faces), pgccd.Mesh.from_trimesh(ball)])
at_t0 = torch.from_numpy(np.concatenate([flat, ball.vertices]))
at_t1 = torch.from_numpy(np.concatenate([sagging, ball.vertices]))

hits = pgccd.detect(scene, pgccd.VertexMotion(at_t0, at_t1), report="all", min_separation=1e-3)
first = float(hits.toi.min()) if len(hits) else float("inf")
print(f"{len(hits)} feature pairs come within 1e-3; the first at t = {first:.6f}")
print({pgccd.Kind.names()[kind]: int((hits.kind == kind).sum()) for kind in hits.kind.unique().tolist()})
