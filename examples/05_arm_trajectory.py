"""
A robot arm's trajectory
========================

An arm of four links follows joint angles through waypoints; up to where is it certainly free of contact? All segments
are tested in one call, and the answer holds for the true path of the arm, not for an approximation of it.

The links do not follow the tested arcs: joints turn at constant rates between waypoints, so the origin of each link
moves along a curve and its rotation is a product of several. But both paths have the same poses at the waypoints, and
differ little in between. With s in [0, 1] along a segment and a point's positions x(s) on the true path and y(s) on the
arc, x - y is zero at both ends, so::

    |x - y| <= max |x'' - y''| / 8 <= (max |x''| + max |y''|) / 8

*True path.* Joint k turns by d_k at a constant rate, so a link turns at the rate w(s), the sum of d_k a_k(s) over its
joints, where a_k is the axis, rotated by the joints before it. Joints j and k contribute an acceleration of at most
``|d_j| |d_k|`` times the point's distance from the later of the two; in sum at most ``(sum of |d_k|)^2 L``, with L the
link's reach from the first joint.

*Arc.* The origin moves along a straight line, and the link turns about it by at most the sum of ``|d_k|``, so
``|y''| <= (sum of |d_k|)^2 r``, with r the link's reach from its origin.

The sum of both, divided by 8, is the link's margin. It is quadratic in the step: doubling the waypoints quarters it.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

import pgccd

LINKS, LENGTH, WIDTH, WAYPOINTS = 4, 1.0, 0.12, 40
AXES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])


# %%
# Forward kinematics, in NumPy: quaternions are (w, x, y, z), body to world.


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions (w, x, y, z)."""
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def forward(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles (LINKS,), radians -> positions of the joints (LINKS, 3) and orientations of the links (LINKS, 4)."""
    position, orientation = [np.zeros(3)], [np.array([1.0, 0.0, 0.0, 0.0])]
    for axis, angle in zip(AXES, angles, strict=True):
        orientation.append(product(orientation[-1], np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])))
        position.append(tip_of(position[-1], orientation[-1]))
    return np.array(position[:-1]), np.array(orientation[1:])


def tip_of(position: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Far end (3,) of a link at a position (3,) with orientation q (4,): the position of the next joint."""
    along = np.array([LENGTH, 0.0, 0.0])
    return position + along + 2 * np.cross(q[1:], np.cross(q[1:], along) + q[0] * along)


# %%
# A link is a beam whose origin is at its joint: a pose says where the joint is, and the link turns about it.

beam = pgccd.Mesh.box([LENGTH - 0.1, WIDTH, WIDTH])
link = pgccd.Mesh(beam.vertices, beam.faces, origin=(-LENGTH / 2, 0.0, 0.0))
obstacle = pgccd.Mesh.box([0.4, 0.4, 0.4])

# %%
# A path in joint space; the obstacle is a body at rest.

start, goal = np.array([-0.8, 0.3, -0.5, 0.2]), np.array([0.9, -0.4, 0.6, 0.5])
joints = start + np.linspace(0.0, 1.0, WAYPOINTS)[:, None] * (goal - start)
poses = [forward(angles) for angles in joints]
place, upright = np.array([2.4, 1.2, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
position = torch.tensor(np.array([[*x, place] for x, _ in poses]))  # (T, N, 3)
orientation = torch.tensor(np.array([[*q, upright] for _, q in poses]))  # (T, N, 4)

# %%
# The margins, from the bound above.

turn = np.abs(np.diff(joints, axis=0)).cumsum(axis=1).max(axis=0)  # (LINKS,): sum over the joints up to each link
reach = LENGTH * np.arange(LINKS) + link.reach  # farthest point of the link from the first joint
margin = (turn**2 * reach + turn**2 * link.reach) / 8.0
print("margins:", ", ".join(f"{m:.2g}" for m in margin))

# %%
# Neighbouring links are joined, so links are not tested against each other; the arm (bit 1) is tested against the
# obstacle (bit 2).

scene = pgccd.Scene(
    [link, obstacle],
    [0] * LINKS + [1],
    group=[1] * LINKS + [2],
    mask=[2] * LINKS + [1],
    margin=[*margin, 0.0],
)
trajectory = pgccd.Trajectory(position, orientation)
hits = pgccd.detect(scene, trajectory)
for (i, _), segment, toi in zip(hits.pairs.tolist(), hits.segment.tolist(), hits.toi.tolist(), strict=True):
    print(f"link {i} may touch the obstacle in segment {segment}, from toi {toi:.6f} on")
free = float(hits.first_toi().clamp(max=1.0))
print(f"free for certain: the first {100 * free:.2f} % of the path")

# %%
# The bound, checked: deviation of the true path from the arcs, half-way along each segment at the tip of the last link.

strays = 0.0
for k in range(WAYPOINTS - 1):
    x, q = (pose.numpy()[:LINKS] for pose in trajectory.segment(k).at(0.5))
    true_x, true_q = forward(0.5 * (joints[k] + joints[k + 1]))
    tips = tip_of(x[-1], q[-1]), tip_of(true_x[-1], true_q[-1])
    strays = max(strays, float(np.linalg.norm(tips[0] - tips[1])))
print(f"the tip strays from its arc by {strays:.2g}, within its margin {margin[-1]:.2g}")
assert strays <= margin[-1]

# %%
# The arm at every fourth waypoint; red from the first waypoint that is no longer certain.

figure = plt.figure(figsize=(7.5, 6.0))
axes = figure.add_subplot(projection="3d")
for k in range(0, WAYPOINTS, 4):
    x, q = poses[k]
    joints_and_tip = np.array([*x, tip_of(x[-1], q[-1])])
    axes.plot(*joints_and_tip.T, "o-", ms=3, lw=3, color="tab:red" if k / (WAYPOINTS - 1) > free else "tab:blue")
axes.plot_trisurf(*(obstacle.vertices.numpy() + place).T, triangles=obstacle.faces.numpy(), color="0.5", alpha=0.8)
axes.set(xlabel="x", ylabel="y", zticks=[], title=f"free of contact: the first {100 * free:.1f} % of the path")
axes.set_aspect("equal")
axes.view_init(elev=65.0, azim=-90.0)
plt.show()

# %%
# All of it, with the contacts:

pgccd.show(scene, trajectory, hits)
