"""
What a simulator tunnelled through
==================================

A simulator that looks for contacts at its time steps alone misses what happens between them: fast and thin bodies pass
through each other, and no frame shows it. `pgccd.audit` takes the frames of any simulator and lists every such passage,
certified; and a rollout guarded by `pgccd.detect` has none. The simulator of this page is a few lines; for frames of
MuJoCo, Newton and PyBullet see :doc:`/how-to/audit`. Pass "cuda" to run it on a GPU.
"""

import sys
from collections.abc import Iterator

import matplotlib.pyplot as plt
import torch

import pgccd

DARTS, PLATES, STEP, STEPS = 10, 4, 1.0 / 30.0, 30
device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
torch.manual_seed(1)

# %%
# Darts fall through a rack of thin plates. Plates are static: they are not tested against each other.

plate, dart = pgccd.Mesh.box([8.0, 1.0, 0.01]), pgccd.Mesh.box([0.15, 0.1, 0.01])
scene = pgccd.Scene([plate, dart], [0] * PLATES + [1] * DARTS, device, static=[True] * PLATES + [False] * DARTS)
falls = torch.tensor([0.0] * PLATES + [1.0] * DARTS, dtype=torch.float64)
gravity = -9.81 * falls[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

position = torch.zeros((PLATES + DARTS, 3), dtype=torch.float64)
position[:PLATES, 2] = torch.arange(PLATES)
position[PLATES:, 0] = torch.linspace(-3.5, 3.5, DARTS)
position[PLATES:, 2] = 3.5 + torch.rand(DARTS)
orientation = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(len(position), 1)
velocity = gravity * torch.rand(len(position), 1)
spin = 8.0 * falls[:, None] * torch.randn(len(position), 3)
position, orientation, velocity, spin, gravity = (
    column.to(device) for column in (position, orientation, velocity, spin, gravity)
)

# %%
# **Frames alone.** The simulator moves everything by a step, looks which bodies overlap then, and turns these round.


def turned_round(velocity: torch.Tensor, pairs: torch.Tensor, away: torch.Tensor) -> torch.Tensor:
    """Darts of pairs (P, 2) move upwards where `away` (P,) is positive, else downwards."""
    changed = velocity.clone()
    changed[pairs[:, 1], 2] = velocity[pairs[:, 1], 2].abs() * away.sign()
    return changed


def frames_alone() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    x, q, v = position, orientation, velocity
    for _ in range(STEPS):
        yield x, q
        v = v + STEP * gravity
        x, q = x + STEP * v, pgccd.integrate_orientation(q, STEP * spin)
        pairs = pgccd.collide(scene, pgccd.RigidMotion.at_rest(x, q)).pairs
        v = turned_round(v, pairs, x[pairs[:, 1], 2] - x[pairs[:, 0], 2])


# %%
# The audit takes the frames as they come, so that a rollout may be of any length. A passage is a pair that touches at
# neither frame and touches in between. Its measure, ``(1 - toi) * approach``, is how deep the two would be in each
# other at the next frame if they kept the rate at which they approach.

found = pgccd.audit(scene, frames_alone())
print(found)
passages = found.passages
for (i, j), segment, toi, measure in zip(
    passages.pairs.tolist(), passages.segment.tolist(), passages.toi.tolist(), passages.measure.tolist(), strict=True
):
    print(f"dart {j - PLATES} passes plate {i} after frame {segment}, at toi {toi:.3f}; measure {measure:.3f}")
assert len(passages) > 0

# %%
# **Guarded.** Each step ends where the first contact of the scene would be: *all* bodies stop there, 1 % before it, and
# those that would touch turn round. (A body that stopped alone would be hit by others on their way: see
# :doc:`/how-to/resolve`.) The frames are then closer where something happens.

times = [0.0]


def guarded() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    x, q, v = position, orientation, velocity
    while times[-1] < STEP * (STEPS - 1):
        yield x, q
        motion = pgccd.RigidMotion.from_velocity(x, q, v + STEP * gravity, spin, STEP)
        hits = pgccd.detect(scene, motion)
        fraction = float((0.99 * hits.first_toi()).clamp(max=1.0))
        x, q = motion.at(fraction)
        v = v + fraction * STEP * gravity
        first = hits[hits.toi <= hits.first_toi()]
        v = turned_round(v, first.pairs, first.normal[:, 2])
        times.append(times[-1] + fraction * STEP)
    yield x, q


safe_frames = list(guarded())
safe = pgccd.audit(scene, safe_frames)
print(f"guarded: {safe}")
assert len(safe.passages) == len(safe.touching) == 0

# %%
# Heights of the darts over time; lines are the plates, and crosses the passages.

figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.5), sharey=True)
alone = torch.stack([x for x, _ in frames_alone()]).cpu()
axes[0].plot(STEP * torch.arange(STEPS), alone[:, PLATES:, 2], ".-", ms=3, lw=0.8)
passed = (STEP * (passages.segment + passages.toi)).cpu(), passages.point[:, 2].cpu()
axes[0].plot(*passed, "x", color="black", ms=8, mew=2)
axes[0].set_title(f"contacts at frames alone: {len(passages)} passages")
axes[1].plot(times, torch.stack([x for x, _ in safe_frames])[:, PLATES:, 2].cpu(), ".-", ms=3, lw=0.8)
axes[1].set_title(f"guarded: {len(safe.passages)} passages, {len(times) - 1} steps")
for each in axes:
    for height in range(PLATES):
        each.axhline(height, color="0.3", lw=2)
    each.set(xlabel="time, s", ylabel="height")
plt.show()

# %%
# The segments with the deepest passages:

pgccd.show(scene, *found.steps())
