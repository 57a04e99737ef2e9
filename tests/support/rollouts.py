"""Rollouts of boxes: made by hand or at random, and the truth about them by separating axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from oracle.boxes import axes_of, gaps

import pgccd
from support.shapes import unit_quaternions

#: What happens between two frames: segment, and bodies i < j.
Rows = set[tuple[int, int, int]]


@dataclass
class Rollout:
    """N boxes at T frames.

    Attributes:
        half: (N, 3) half edges.
        position, orientation: (T, N, 3) and (T, N, 4).
    """

    half: np.ndarray
    position: np.ndarray
    orientation: np.ndarray

    def scene(self, device: torch.device | str = "cpu", **filters: object) -> pgccd.Scene:
        return pgccd.Scene([pgccd.Mesh.box(2.0 * h) for h in self.half], device=device, **filters)  # type: ignore[arg-type]

    def trajectory(self, device: torch.device | str = "cpu") -> pgccd.Trajectory:
        return pgccd.Trajectory(*(torch.tensor(c, device=device) for c in (self.position, self.orientation)))

    def at(self, segment: np.ndarray, time: np.ndarray, body: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres, axes and half edges of bodies (P,) at times (P,) of segments (P,)."""
        t = time[:, None]
        x = (1.0 - t) * self.position[segment, body] + t * self.position[segment + 1, body]
        p, q = self.orientation[segment, body], self.orientation[segment + 1, body]
        cosine = (p * q).sum(axis=1, keepdims=True)
        p, cosine = np.where(cosine < 0.0, -p, p), np.minimum(np.abs(cosine), 1.0)
        angle = np.arccos(cosine)  # half the turn
        is_small = angle < 1e-9
        sine = np.where(is_small, 1.0, np.sin(angle))
        a = np.where(is_small, 1.0 - t, np.sin((1.0 - t) * angle) / sine)
        b = np.where(is_small, t, np.sin(t * angle) / sine)
        turned = a * p + b * q
        return x, axes_of(turned / np.linalg.norm(turned, axis=1, keepdims=True)), self.half[body]

    def gap(self, segment: np.ndarray, time: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """(P,): gaps of pairs, negative where they overlap."""
        return gaps(self.at(segment, time, i), self.at(segment, time, j))

    def overlapping_between(self, depth: float, samples: int = 400) -> tuple[Rows, Rows]:
        """Pairs whose boxes, solids, overlap at neither frame, but at one of so many times in between: by more than
        `depth`, and at all.
        """
        count = len(self.half)
        i, j = np.triu_indices(count, 1)
        deep, any_at_all = set(), set()
        for segment in range(len(self.position) - 1):
            rows = np.full(len(i), segment)
            ends = [self.gap(rows, np.full(len(i), end), i, j) for end in (0.0, 1.0)]
            apart = np.flatnonzero((ends[0] > 0.0) & (ends[1] > 0.0))
            times = np.tile(np.linspace(0.0, 1.0, samples), len(apart))
            a, b = i[apart].repeat(samples), j[apart].repeat(samples)
            least = self.gap(np.full(len(a), segment), times, a, b).reshape(len(apart), samples).min(axis=1)
            for limit, found in ((-depth, deep), (0.0, any_at_all)):
                found |= {(segment, int(i[k]), int(j[k])) for k in apart[least < limit]}
        return deep, any_at_all


def rows_of(passages: pgccd.Passages) -> Rows:
    """Fails on duplicates."""
    rows = [(s, *pair) for s, pair in zip(passages.segment.tolist(), passages.pairs.tolist(), strict=True)]
    assert len(set(rows)) == len(rows)
    return set(rows)


def planted(rng: np.random.Generator, pairs: int, frames: int, passing: float = 0.7) -> tuple[Rollout, Rows]:
    """Pairs of a thin plate and a dart, each pair far from others. Darts hover on one side of their plate, tumbling;
    those that pass change to the other side in one segment, past the middle of the plate, or beside it. Returns also
    the passages.
    """
    half = np.concatenate([np.tile([[1.0, 1.0, 0.002]], (pairs, 1)), rng.uniform(0.01, 0.05, (pairs, 3))])
    corner = 10.0 * np.stack([np.arange(pairs) % 7, np.arange(pairs) // 7, np.zeros(pairs)], axis=1)
    turn = unit_quaternions(rng, pairs)
    axes = axes_of(turn)  # of the plates
    passes = rng.uniform(size=pairs) < passing
    beside = rng.uniform(size=pairs) < 0.2
    when = rng.integers(0, frames - 1, pairs)
    side = np.where(passes[None] & (np.arange(frames)[:, None] > when), -1.0, 1.0)
    across = rng.uniform(-0.5, 0.5, (frames, pairs, 2)) + np.where(beside, 3.0, 0.0)[None, :, None]
    height = side * rng.uniform(0.12, 2.0, (frames, pairs))
    local = np.concatenate([across, height[..., None]], axis=2)
    darts = corner + np.einsum("tpk,pkc->tpc", local, axes)
    position = np.concatenate([np.broadcast_to(corner, (frames, pairs, 3)), darts], axis=1)
    tumbling = np.stack([unit_quaternions(rng, pairs) for _ in range(frames)])
    orientation = np.concatenate([np.broadcast_to(turn, (frames, pairs, 4)), tumbling], axis=1)
    rows = {(int(when[k]), k, pairs + k) for k in np.flatnonzero(passes & ~beside)}
    return Rollout(half, position.copy(), orientation.copy()), rows


def tumbling(rng: np.random.Generator, bodies: int, frames: int, side: float) -> Rollout:
    """Boxes of different shapes that jump about in a cube."""
    half = rng.uniform(0.02, 0.5, (bodies, 3))
    position = rng.uniform(0.0, side, (frames, bodies, 3))
    orientation = np.stack([unit_quaternions(rng, bodies) for _ in range(frames)])
    return Rollout(half, position, orientation)
