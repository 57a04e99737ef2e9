"""
Mesh files and their troubles
=============================

Files of meshes are cut along seams, come in millimetres, hold far coordinates in float32, have holes or end too early.
This page makes one file of each kind and shows what pgccd says, and what to do. It needs trimesh, which reads the
files: ``pip install trimesh``.
"""

import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import torch
import trimesh

import pgccd

temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)

# %%
# **Seams.** Formats that store one texture coordinate or normal per vertex, such as glTF, and STL, which has no shared
# vertices at all, repeat a vertex for each side of a seam. If such a mesh deforms it opens there. So `pgccd.Mesh.load`
# welds vertices at the same position. Contacts count the welded vertices; `Mesh.source_vertex` and `Mesh.source_face`
# give their rows in the file.

ball = trimesh.creation.icosphere(subdivisions=2)
ball.export(folder / "ball.stl")
welded = pgccd.Mesh.load(folder / "ball.stl")
cut = pgccd.Mesh.load(folder / "ball.stl", weld=False)
print(welded)
print(cut)
assert welded.source_vertex is not None  # it is from a file
print(f"vertex 5 is row {int(welded.source_vertex[5])} of the file")

# %%
# **Units.** A file does not say its unit, or says it where no reader looks. `Mesh.radius` shows at once what came:
# about 35 for a bolt in millimetres where metres were meant. Scale the coordinates before you make the mesh.

cylinder = trimesh.creation.cylinder(radius=4.0, height=70.0)
cylinder.apply_translation([0.0, 0.0, 35.0])  # it stands on z = 0
cylinder.export(folder / "bolt.ply")
bolt = pgccd.Mesh.load(folder / "bolt.ply")
print(f"as in the file: radius {bolt.radius:.3f}")
in_metres = pgccd.Mesh(0.001 * bolt.vertices, bolt.faces)
print(f"scaled:         radius {in_metres.radius:.6f}")

# %%
# **float32 far from the origin.** A part of a city model is a million metres from the zero of its coordinates. There
# float32 has steps of 6 cm: vertices move, and small faces lose their area. What the file has lost cannot be restored,
# but a warning names the first face. Move the part to the origin before it is written in float32, and give its place by
# the pose.

sphere = pgccd.Mesh.icosphere(0.3, subdivisions=3)
far = (sphere.vertices + torch.tensor([1.0e6, 0.0, 0.0])).to(torch.float32)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    rounded = pgccd.Mesh(far, sphere.faces)
print(f"UserWarning: {caught[0].message}")

# %%
# Poses should be float64 for the same reason; `pgccd.RigidMotion` takes both, and widens float32 exactly.
#
# **Origins.** A pose refers to the zero of the file's coordinates, which may be anywhere. With ``origin=`` a mesh has
# it in its centre of mass, or at any point such as a joint.

centred = pgccd.Mesh.load(folder / "bolt.ply", origin="center_of_mass")
print(f"centre of mass in the file's coordinates: {[round(x, 6) for x in centred.origin.tolist()]}")

# %%
# **Holes.** Detection needs no closed surfaces: it finds surfaces that meet, whatever they bound. Only questions about
# solids need them: the centre of mass, and `pgccd.enclosed`. Their errors name an open edge.

open_ball = trimesh.Trimesh(ball.vertices, ball.faces[:-10])
open_ball.export(folder / "open.ply")
print(pgccd.Mesh.load(folder / "open.ply"))
try:
    pgccd.Mesh.load(folder / "open.ply", origin="center_of_mass")
except ValueError as error:
    print(f"ValueError: {str(error).replace(str(folder), '...')}")

# %%
# **Broken files.** A file that holds less than it declares, or no mesh, is an error that names the file. Faces that
# repeat a vertex are dropped and counted in `Mesh.dropped_faces`; nothing else is changed silently.

content = (folder / "ball.stl").read_bytes()
(folder / "half.stl").write_bytes(content[: len(content) // 2])
(folder / "text.obj").write_text("this is no mesh")
for name in ("half.stl", "text.obj", "lost.ply"):
    try:
        pgccd.Mesh.load(folder / name)
    except (ValueError, FileNotFoundError) as error:
        print(f"{type(error).__name__}: {str(error).replace(str(folder), '...')}")

# %%
# **Files of many objects.** `Mesh.load` joins all objects of a file to one mesh; `Mesh.load_all` gives one mesh each,
# with their names, in the frame of the file.

trimesh.Scene({"ball": ball, "bolt": trimesh.creation.cylinder(radius=0.2, height=3.0)}).export(folder / "parts.glb")
for part in pgccd.Mesh.load_all(folder / "parts.glb"):
    print(part)

# %%
# A whole folder, with what is wrong in it:

for path in sorted(folder.iterdir()):
    try:
        mesh = pgccd.Mesh.load(path)
        print(f"{path.name:10s} {len(mesh.faces):5d} faces, radius {mesh.radius:9.4f}, welded {mesh.welded_vertices}")
    except ValueError as error:
        print(f"{path.name:10s} {type(error).__name__}: {str(error).replace(str(folder), '...')[:60]}...")

figure = plt.figure(figsize=(10.0, 4.5))
opened, corners = cut.vertices.clone(), cut.faces.long()
opened[corners] += 0.12 * cut.vertices[corners].mean(dim=1, keepdim=True)  # each face moves outwards on its own
pictures = {
    "unwelded: faces part when vertices move": (opened, cut.faces),
    "float32, a million units from the origin": (far.double() - torch.tensor([1.0e6, 0.0, 0.0]), sphere.faces),
}
for number, (title, (vertices, faces)) in enumerate(pictures.items(), 1):
    axes = figure.add_subplot(1, 2, number, projection="3d")
    axes.plot_trisurf(*vertices.T.numpy(), triangles=faces.numpy(), color="0.8", edgecolor="0.2", lw=0.3)
    axes.set_title(title)
    axes.set_aspect("equal")
    axes.set_axis_off()
plt.show()
