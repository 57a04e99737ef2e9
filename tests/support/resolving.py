"""Reference of `pgccd.resolve`: every round detects among all bodies, and rows are processed one by one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from oracle.boxes import near_gaps

import pgccd
from pgccd.resolution.search import shortened

Motion = pgccd.RigidMotion | pgccd.VertexMotion


@dataclass
class Plain:
    """What `resolve` should find."""

    fraction: list[float]
    stopped_by: list[int]
    rounds: int


def plain_resolve(scene: pgccd.Scene, motion: Motion, movable: list[bool], **options: Any) -> Plain:
    """The rule, body by body; options as for `detect`."""
    count = scene.body_count
    fraction, stopped_by, rounds = [1.0] * count, [-1] * count, 0
    changed = set(range(count))
    while True:
        made = torch.tensor(fraction, dtype=torch.float64, device=scene.device)
        hits = pgccd.detect(scene, shortened(scene, motion, made), nonzero_toi=True, **options)
        assert hits.toi is not None
        first: dict[int, tuple[float, int]] = {}
        for (i, j), toi in zip(hits.pairs.tolist(), hits.toi.tolist(), strict=True):
            if i in changed or j in changed:
                for body, other in ((i, j), (j, i)):
                    first[body] = min(first.get(body, (np.inf, count)), (toi, other))
        changed = set()
        for body, (toi, other) in first.items():
            if movable[body] and fraction[body] > 0.0:
                allowed = fraction[body] * toi * 0.99
                fraction[body] = 0.0 if allowed < (0.01 if rounds < 4 else np.inf) else allowed
                stopped_by[body] = other
                changed.add(body)
        if not changed:
            return Plain(fraction, stopped_by, rounds)
        rounds += 1


def check_resolution(
    scene: pgccd.Scene, motion: Motion, resolved: pgccd.Resolution[Any], movable: list[bool], **options: Any
) -> None:
    """Asserts what `Resolution` promises, by detection on the motion as returned and at rest; options: of `detect`."""
    options |= {"nonzero_toi": True}
    count = scene.body_count
    fraction, by = resolved.fraction.tolist(), resolved.stopped_by.tolist()
    assert all(0.0 <= f <= 1.0 for f in fraction) and len(fraction) == len(by) == count
    assert [f < 1.0 for f in fraction] == [other >= 0 for other in by]
    assert all(f == 1.0 for f, may in zip(fraction, movable, strict=True) if not may)
    expected = shortened(scene, motion, resolved.fraction)
    for name, column in resolved.motion.columns().items():
        assert torch.equal(column, expected.columns()[name]), name
    lists = [sorted(map(tuple, pairs.tolist())) for pairs in (resolved.touching_at_start, resolved.unresolved)]
    touching, unresolved = lists
    assert [list(map(tuple, p.tolist())) for p in (resolved.touching_at_start, resolved.unresolved)] == lists
    # Nothing outside the lists touches on the motion as returned; and what is unresolved does.
    found = set(map(tuple, pgccd.detect(scene, resolved.motion, **options).pairs.tolist()))
    assert found <= {*touching, *unresolved} and set(unresolved) <= found
    for i, j in unresolved:
        assert not (movable[i] and movable[j]), "both could have been stopped"
    # At the start the listed pairs touch (or are within the tolerance), and no others do.
    still = shortened(scene, motion, torch.zeros_like(resolved.fraction))
    at_start = set(map(tuple, pgccd.detect(scene, still, **options).pairs.tolist()))
    assert set(touching) <= at_start
    hits = pgccd.detect(scene, motion, **options)
    assert hits.toi is not None
    assert set(map(tuple, hits.pairs[hits.toi == 0.0].tolist())) <= set(touching)
    for i, j in touching:
        assert all(fraction[body] == 0.0 or not movable[body] for body in (i, j))


def check_boxes(
    half: np.ndarray, motion: pgccd.RigidMotion, fraction: torch.Tensor, listed: set[tuple[int, int]], times: int = 40
) -> int:
    """Asserts that boxes about their origins do not overlap on x_i(f_i t), from the given motion alone: separating axes
    at some times. Pairs that are listed may. Returns how many pairs come near.
    """
    start, end = motion.position_t0.cpu().numpy(), motion.position_t1.cpu().numpy()
    turn, near = motion.rotation.cpu().numpy(), 0
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.where(angle > 0.0, angle, 1.0)
    for t in np.linspace(0.0, 1.0, times):
        made = t * fraction.cpu().numpy()[:, None]
        w, v = np.cos(0.5 * made * angle), np.sin(0.5 * made * angle) * axis
        q = motion.orientation_t0.cpu().numpy()
        turned = np.concatenate(
            [w * q[:, :1] - (v * q[:, 1:]).sum(1, keepdims=True), w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])],
            axis=1,
        )
        pairs, gaps = near_gaps(start + made * (end - start), turned, half)
        near += len(pairs)
        overlapping = {(min(p), max(p)) for p in pairs[gaps < -1e-12].tolist()}
        assert overlapping <= listed, f"at {t}: {overlapping - listed}"
    return near
