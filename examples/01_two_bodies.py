"""
Two bodies: when and where do they touch?
=========================================

A box is thrown past another one and turns on its way. At both ends of the step the two are apart, so a test of the
poses at the ends finds nothing. `pgccd.detect` finds the contact in between: when, where, and which features touch.
"""

import matplotlib.pyplot as plt
import torch

import pgccd

# %%
# **A scene** lists meshes and says which mesh each body has. It has no positions. Here two bodies share one mesh, a box
# with sides 2, 1 and 0.5 in any unit of length; `pgccd.Mesh.load` reads files.

box = pgccd.Mesh.box([2.0, 1.0, 0.5])
scene = pgccd.Scene([box], mesh_index=[0, 0])

# %%
# **A motion** says where the bodies are during the step, for t from 0 to 1: positions of the meshes' origins in the
# world frame, and orientations as unit quaternions (w, x, y, z). Body 0 is at rest. Body 1 moves from x = -3 to x = 3
# and turns about its y axis by 2 radians.

position = torch.tensor([[0.0, 0.0, 0.0], [-3.0, 0.4, 1.0]])
upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
velocity = torch.tensor([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
spin = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
motion = pgccd.RigidMotion.from_velocity(position, upright, velocity, spin, dt=1.0)

# %%
# **Detection.** The result has one row for each pair of bodies that collides; its columns are tensors.

hits = pgccd.detect(scene, motion)
print(f"{len(hits)} contact: {hits.pairs.tolist()}")
print(f"toi      {float(hits.toi[0]):.6f}  (fraction of the step; never late)")
print(f"point    {[round(x, 6) for x in hits.point[0].tolist()]}")
print(f"normal   {[round(x, 6) for x in hits.normal[0].tolist()]}  (from body 0 to body 1)")
print(f"features {pgccd.Kind.names()[int(hits.kind[0])]} {hits.features[0].tolist()}")

# %%
# `VF_BA` means: a face of body 0 and a vertex of body 1, whose numbers are in `Contacts.features`; `EE` means two
# edges, which are rows of `Mesh.edges`. The picture shows the bodies at the start, at the time of impact and where body
# 1 would be at the end. `RigidMotion.at` gives poses on the path by the same arithmetic as detection.


def placed(mesh: pgccd.Mesh, position: torch.Tensor, orientation: torch.Tensor) -> torch.Tensor:
    """Vertices (V, 3) in the world: position + R v."""
    w, axis = orientation[0], orientation[1:].expand(len(mesh.vertices), 3)
    turned = torch.linalg.cross(axis, mesh.vertices)
    return position + mesh.vertices + 2.0 * (w * turned + torch.linalg.cross(axis, turned))


figure = plt.figure(figsize=(9.0, 5.0))
axes = figure.add_subplot(projection="3d")
for time, colour, alpha in ((0.0, "tab:blue", 0.25), (1.0, "tab:blue", 0.25), (float(hits.toi[0]), "tab:orange", 0.9)):
    for at, turn, shade in zip(*motion.at(time), ("0.75", colour), strict=True):
        x, y, z = placed(box, at, turn).T.numpy()
        axes.plot_trisurf(x, y, z, triangles=box.faces.numpy(), color=shade, alpha=alpha, edgecolor="0.3", lw=0.3)
point, normal = hits.point[0].numpy(), hits.normal[0].numpy()
axes.quiver(*point, *normal, color="black", lw=2.0)
axes.scatter(*point, color="black", s=30, depthshade=False)
axes.set(xlabel="x", zlabel="z", xlim=(-4.2, 4.2), ylim=(-1.5, 1.5), zlim=(-1.5, 2.0), yticks=[])
axes.set_box_aspect((8.4, 3.0, 3.5), zoom=1.4)
axes.view_init(elev=12.0, azim=-75.0)
axes.set_title(f"first contact at t = {float(hits.toi[0]):.4f}; arrow: normal")
plt.show()

# %%
# `pgccd.show` makes an interactive page of any scene: drag to turn it, move the slider, go to the next collision.

pgccd.show(scene, motion, hits)

# %%
# What is promised: if the two surfaces have a common point at any time of the step, a contact is reported, and its toi
# is not later than that time. The features come within `min_separation + tolerance` at the toi; the default tolerance
# is a millionth of the smaller body's radius.
