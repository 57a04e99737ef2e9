"""
Gradients: the play of a gear pair
==================================

Two gears mesh. How far can the second one turn before a tooth touches, while the first one is held: its play? A turn
tested by `pgccd.detect` gives it, as a time of impact, for many positions of the teeth at once; and its derivative with
respect to the distance of the axes, by which the play is tuned.
"""

import math

import matplotlib.pyplot as plt
import torch

import pgccd

# %%
# **Involute gears** of module 1 with 12 and 20 teeth and a pressure angle of 20 degrees. Without play their axes are 16
# apart. The first one is wider, as pinions are.

MODULE, TEETH, PRESSURE = 1.0, (12, 20), math.radians(20.0)


def gear(teeth: int, width: float, points: int = 8) -> pgccd.Mesh:
    """A gear about the z axis, with a tooth on the x axis."""
    pitch, pi = 0.5 * MODULE * teeth, torch.pi
    base = pitch * math.cos(PRESSURE)
    root, tip = max(pitch - 1.2 * MODULE, 0.0), pitch + 0.9 * MODULE
    radius = torch.linspace(max(root, base), tip, points, dtype=torch.float64)
    pressure = torch.arccos((base / radius).clamp(max=1.0))
    half = pi / (2.0 * teeth) + (math.tan(PRESSURE) - PRESSURE) - (pressure.tan() - pressure)
    radius = torch.cat([torch.tensor([root], dtype=torch.float64), radius])
    half = torch.cat([half[:1], half])
    tooth_radius, tooth_angle = torch.cat([radius, radius.flip(0)]), torch.cat([-half, half.flip(0)])
    angle = (tooth_angle + 2.0 * pi / teeth * torch.arange(teeth, dtype=torch.float64)[:, None]).reshape(-1)
    ring = tooth_radius.repeat(teeth)[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
    count = len(ring)
    corners = torch.zeros(2 * count + 2, 3, dtype=torch.float64)
    corners[:count, :2], corners[count : 2 * count, :2] = ring, ring
    corners[:count, 2], corners[count : 2 * count, 2] = -0.5 * width, 0.5 * width
    corners[-2:, 2] = torch.tensor([-0.5, 0.5]) * width
    a = torch.arange(count)
    b, last = a.roll(-1), torch.full_like(a, 2 * count)
    faces = [[b, a, last], [a + count, b + count, last + 1], [a, b, b + count], [a, b + count, a + count]]
    return pgccd.Mesh(corners, torch.cat([torch.stack(face, 1) for face in faces]))


meshes = [gear(TEETH[0], 3.0), gear(TEETH[1], 2.0)]

# %%
# **All positions of the teeth in one call.** Each `world` holds a pair of gears in another position, twice: in one the
# second gear turns to the left, in the other to the right. It starts with its tooth in the middle of the gap.

POSITIONS, TURN = 24, 0.05
worlds = torch.arange(2 * POSITIONS)
mesh_index = torch.tensor([0, 1]).repeat(len(worlds))
phase = (worlds % POSITIONS).double() / POSITIONS * 2.0 * torch.pi / TEETH[0]
side = torch.where(worlds < POSITIONS, 1.0, -1.0).double()


def about_z(angle: torch.Tensor) -> torch.Tensor:
    """Unit quaternions (n, 4) of turns (n,) about z."""
    zero = torch.zeros_like(angle)
    return torch.stack([(0.5 * angle).cos(), zero, zero, (0.5 * angle).sin()], dim=1)


def play_of(distance: torch.Tensor, coating: torch.Tensor) -> tuple[torch.Tensor, pgccd.Contacts]:
    """The play in each position (POSITIONS,), as a length on the pitch circle of the second gear.

    Args:
        distance: () of the axes.
        coating: () thickness of a coating of all teeth, a margin.
    """
    scene = pgccd.Scene(meshes, mesh_index, world=worlds.repeat_interleave(2), margin=coating.expand(len(mesh_index)))
    zero = torch.zeros(len(worlds), dtype=torch.float64)
    places = torch.stack([zero, zero, zero, distance + zero, zero, zero], dim=1).view(-1, 3)
    against = torch.pi + torch.pi / TEETH[1] - phase * TEETH[0] / TEETH[1]
    orientation = torch.stack([about_z(phase), about_z(against)], dim=1).view(-1, 4)
    rotation = torch.stack([zero, zero, zero, zero, zero, side * TURN], dim=1).view(-1, 3)
    motion = pgccd.RigidMotion.from_rotation(places, orientation, places, rotation)
    hits = pgccd.detect(scene, motion)
    turn = hits.first_toi("world") * TURN
    return (turn[:POSITIONS] + turn[POSITIONS:]) * 0.5 * MODULE * TEETH[1], hits


# %%
# **Tuning** the distance by Newton's method, such that the least play of all positions is 0.1. From theory the
# derivative of the play is 2 tan 20° = 0.728 by the distance, and -4 / cos 20° = -4.26 by a coating of both gears;
# flanks of a few straight pieces come near.

distance = torch.tensor(16.6, dtype=torch.float64, requires_grad=True)
coating = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
curves = []
for _ in range(5):
    play, hits = play_of(distance, coating)
    curves.append((float(distance.detach()), play.detach()))
    least = play.min()
    by_distance, by_coating = torch.autograd.grad(least, (distance, coating))
    print(
        f"distance {float(distance.detach()):.6f}: least play {float(least.detach()):.6f}; derivatives: by distance "
        f"{float(by_distance):.3f}, by coating {float(by_coating):.2f}"
    )
    with torch.no_grad():
        distance -= (least - 0.1) / by_distance

assert abs(float(curves[-1][1].min()) - 0.1) < 1e-6

# %%
# The gears as tuned, with the contacts of one position, and the play of all of them before and after.

figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 5.0), width_ratios=(3, 2))
for mesh, centre, turn, colour in (
    (meshes[0], 0.0, float(phase[3]), "tab:orange"),
    (meshes[1], curves[-1][0], math.pi * (1.0 + 1.0 / TEETH[1]) - float(phase[3]) * TEETH[0] / TEETH[1], "tab:blue"),
):
    ring = mesh.vertices[: (len(mesh.vertices) - 2) // 2, :2]
    turned = ring @ torch.tensor([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]).double()
    left.fill(turned[:, 0] + centre, turned[:, 1], color=colour, alpha=0.5, ec="0.2", lw=0.8)
of_position = worlds[hits.pairs[:, 0] // 2] % POSITIONS == 3
left.plot(*hits.point[of_position, :2].detach().T.numpy(), "k.", markersize=9)
left.set(xlim=(3.0, 11.0), ylim=(-4.0, 4.0), aspect="equal", title="contacts when the right gear turns either way")
for value, play in (curves[0], curves[-1]):
    right.plot(torch.arange(POSITIONS) / POSITIONS, play, "o-", ms=3, label=f"distance {value:.3f}")
right.axhline(0.1, color="0.5", lw=0.8)
right.set(xlabel="position of the teeth (pitches)", ylabel="play on the pitch circle", ylim=(0.0, None))
right.legend()
figure.tight_layout()
plt.show()

# %%
# The distance, through the positions of the bodies, and the coating, through `Scene.margin`, are inputs like any other
# tensor of torch: `Contacts.toi` requires grad if one of them does.
