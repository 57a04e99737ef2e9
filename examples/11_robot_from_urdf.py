"""
A robot arm from a URDF file
============================

Is a plan of a robot arm free of contact, between its waypoints too? `pgccd.robots` reads URDF and MJCF files
(``pip install 'pgccd[robots]'``) and answers for many plans in one call: free for certain, or the first time, the links
and the point. Samples between waypoints cannot answer that; here they miss some collisions.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

import pgccd
from pgccd.robots import Obstacles, Verdict, load_urdf

# %%
# **A robot.** Usually a file from a package; this one is written here: five beams and a ball as a tool, on joints about
# z and y in turn.

LENGTH, JOINTS = 0.35, 6
beam = f'<origin xyz="{LENGTH / 2} 0 0"/><geometry><box size="{LENGTH - 0.06} 0.05 0.05"/></geometry>'
ball = f'<origin xyz="{LENGTH / 2} 0 0"/><geometry><sphere radius="0.04"/></geometry>'
text = ['<robot name="arm"><link name="base"/>']
for k in range(JOINTS):
    parent, start, axis = (f"link{k - 1}", LENGTH, "0 1 0") if k else ("base", 0.0, "0 0 1")
    text += [
        f'<link name="link{k}"><collision>{ball if k == JOINTS - 1 else beam}</collision></link>',
        f'<joint name="joint{k}" type="revolute"><parent link="{parent}"/><child link="link{k}"/>',
        f'<origin xyz="{start} 0 0"/><axis xyz="{"0 0 1" if k % 2 == 0 else axis}"/>',
        '<limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>',
    ]
temporary = tempfile.TemporaryDirectory()
file = Path(temporary.name) / "arm.urdf"
file.write_text("\n".join([*text, "</robot>"]))

robot = load_urdf(file)
print(robot, "joints:", ", ".join(robot.joint_names))

# %%
# **Obstacles**, and 200 random plans of five waypoints each. One of them is broken, and says so of itself alone.

posts = Obstacles(
    [pgccd.Mesh.box([0.02, 0.02, 1.4])],
    torch.tensor([[0.9, 0.9, 0.0], [1.2, -0.8, 0.0], [-0.6, 1.1, 0.0], [0.3, -1.3, 0.0]]),
    mesh_index=[0] * 4,
)
rng = np.random.default_rng(2)
ends = rng.uniform(-0.9, 0.9, (2, 200, 1, JOINTS))
q = torch.tensor(ends[0] + np.linspace(0.0, 1.0, 5)[:, None] * (ends[1] - ends[0]))  # (B, T, J)
q[17, 3, 2] = float("nan")

result = robot.certify(q, posts)
for verdict in Verdict:
    print(f"{int((result.verdict == verdict).sum()):4} {verdict.name}")
first = next(b for b in range(len(q)) if result.verdict[b] == Verdict.COLLISION)
a, b = result.names(first)
print(f"plan {first}: {a} and {b} may touch from {100 * float(result.time[first]):.1f} % of the path on, not before")
print(f"pairs of bodies were tested over {result.steps} parts of segments")

# %%
# **Samples.** The usual check tests configurations; with two a segment it finds fewer collisions, whatever the program.

halves = torch.stack([q[:, :-1], 0.5 * (q[:, :-1] + q[:, 1:])], dim=2).flatten(1, 2)  # (B, 8, J)
still = halves.reshape(-1, 1, JOINTS).expand(-1, 2, -1).nan_to_num()
touches = (robot.certify(still, posts).verdict == Verdict.START).view(len(q), -1).any(dim=1)
collides = (result.verdict == Verdict.COLLISION) | (result.verdict == Verdict.START)
print(f"of {int(collides.sum())} plans that collide, samples find {int((touches & collides).sum())}")
assert not bool((touches & result.free).any())

# %%
# The plan, with the last waypoint that is certainly free in blue, and where the first contact is.

figure = plt.figure(figsize=(7.5, 5.5))
axes = figure.add_subplot(projection="3d")
positions, _ = robot.poses(q[first])
for k, joints in enumerate(positions.numpy()):
    is_free = k / 4 <= float(result.time[first])
    axes.plot(*joints.T, "o-", ms=3, lw=2, color="tab:blue" if is_free else "tab:red", alpha=0.8)
post = posts.meshes[0]
for place in posts.position:
    axes.plot_trisurf(*(post.vertices + place).numpy().T, triangles=post.faces.numpy(), color="0.6", alpha=0.6)
axes.scatter(*result.point[first].numpy(), color="black", s=60, marker="x")
axes.set(xlabel="x", ylabel="y", zlabel="z", title=f"{a} meets {b} at {100 * float(result.time[first]):.1f} %")
axes.set_aspect("equal")
axes.view_init(elev=45.0, azim=-70.0)
plt.show()

# %%
# In a planner: a function of two configurations, as OMPL and MoveIt ask for.

is_valid = robot.motion_validator(posts)
print("first motion of the plan:", is_valid(q[first, 0], q[first, 1]))
print("whole plan in one motion:", is_valid(q[first, 0], q[first, -1]))

# %%
# All of it on a page, with the contacts of its margins:

path = q[first]
hits = pgccd.detect(robot.scene(posts), robot.trajectory(path, posts))
pgccd.show(robot.scene(posts), robot.trajectory(path, posts), hits)
