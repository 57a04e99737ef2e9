"""Two tetrahedra, one of them thrown at the other: when and where do they touch?"""

import torch

import pgccd

tetrahedron = pgccd.Mesh(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
)
scene = pgccd.Scene([tetrahedron], mesh_index=[0, 0])

position_t0 = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
position_t1 = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
turned = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.8, 0.0, 0.6, 0.0]])

hits = pgccd.detect(scene, pgccd.RigidMotion(position_t0, upright, position_t1, turned))
for pair, toi, kind, point in zip(hits.pairs.tolist(), hits.toi.tolist(), hits.kind.tolist(), hits.point, strict=True):
    print(f"bodies {pair} touch at t = {toi:.6f} ({pgccd.Kind.names()[kind]}) at {point.tolist()}")
