"""One step of continuous collision detection, from poses to contacts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from pgccd import broad, narrow, traverse
from pgccd.bodies import MovingBodies
from pgccd.contacts import ContactRows, Contacts, Stats
from pgccd.motion import RigidMotion, VertexMotion
from pgccd.scene import Scene

# What one pair of the PCS may need while it is traversed and solved, on the standard scene with room to spare.
_BYTES_PER_PAIR = 1536
_DEFAULT_BUDGET = 1 << 30


def detect(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    report: narrow.Report = "first",
    min_separation: float = 0.0,
    *,
    tolerance: float | None = None,
    nonzero_toi: bool = False,
    broad_phase: broad.BroadPhase = "auto",
    pairs: Tensor | None = None,
    memory_budget: int | None = None,
) -> Contacts:
    """Finds the collisions that happen during one step.

    Nothing is missed: if two primitives of different bodies touch (distance <= min_separation) at some t in [0, 1] on
    the paths the motion defines, a contact is reported, and its toi is not later than that t. The same holds within a
    body that deforms (`VertexMotion`) and has `self_collision` set in the scene, for primitives that share no vertex;
    such contacts are of a pair (i, i).

    Args:
        scene: the bodies.
        motion: where they go.
        report: "any": which body pairs collide (Alg. 2 of Du, Liu & Suzumura 2017). "first": the earliest contact of
            each pair (of equal toi the smallest kind and features). "all": every touching feature pair. "earliest":
            the one first contact of the scene; its toi is the largest collision-free fraction of the step.
        min_separation: length >= 0.
        tolerance: a reported contact comes within min_separation + tolerance (length). Default: 1e-6 of the smaller
            SBV radius of each pair.
        nonzero_toi: never report toi = 0 for a pair that starts further apart than min_separation (beyond rounding).
        broad_phase: how the PCS is found: "sweep", "grid", "lbvh", or "auto", which chooses one by the bodies' sizes
            and says so in `stats`. The result does not depend on it.
        pairs: (P, 2) int64, i < j (or i, i where a body collides with itself), sorted: test these body pairs and no
            others, without a broad phase (a part of an earlier step's, say). The scene's filters are not applied to
            them.
        memory_budget: bytes of scratch memory to aim at; the PCS is streamed in chunks to respect it. Default 1 GiB,
            or a quarter of what is free on a GPU if that is more. The result does not depend on it.

    Returns:
        Contacts, on the scene's device.

    Raises:
        ValueError, TypeError: naming the argument.

    Example:
        >>> hits = pgccd.detect(scene, pgccd.RigidMotion(x0, q0, x1, q1))
        >>> x0 + hits.toi.min() * (x1 - x0)
    """
    if report not in narrow.REPORTS:
        raise ValueError(f"report: expected one of {list(narrow.REPORTS)}, got {report!r}")
    broad.check_separation(min_separation)
    if memory_budget is not None and memory_budget <= 0:
        raise ValueError(f"memory_budget: expected a number of bytes > 0, got {memory_budget}")
    stats = Stats(bodies=scene.body_count)

    with _timed(stats, "bounds"):
        bodies = MovingBodies(scene, motion)
    with _timed(stats, "broad"):
        chosen = broad.choose(bodies, broad_phase)
        stats.broad_phase = chosen if pairs is None else "given"
        if pairs is None:
            pairs = broad.find_pairs(bodies, min_separation, chosen)
        else:
            pairs = traverse.check_pairs(pairs, bodies)
    stats.pcs = pairs.shape[0]

    node_tests: list[Tensor] = []
    found = []
    for chunk in pairs.split(max(1, _budget(memory_budget, len(pairs), bodies.device) // _BYTES_PER_PAIR)):
        stats.chunks += 1
        horizon = None
        if report in ("first", "earliest") and bodies.device.type == "cpu":
            # A good guess at each pair's first contact bounds how far the search for an earlier one need look. A GPU
            # has searched all of it sooner than it has found the guess.
            candidates, tests = _traverse(stats, bodies, chunk, min_separation, tolerance, None, leading=True)
            node_tests.append(tests)
            rows = _narrow(stats, bodies, chunk, candidates, "first", min_separation, tolerance, nonzero_toi)
            horizon = torch.ones(len(chunk), dtype=torch.float64, device=bodies.device)
            horizon[rows[0].long()] = rows[4]
            if report == "earliest" and len(horizon):
                horizon = horizon.min().expand_as(horizon).contiguous()
        candidates, tests = _traverse(stats, bodies, chunk, min_separation, tolerance, horizon, leading=False)
        node_tests.append(tests)
        rows = _narrow(stats, bodies, chunk, candidates, report, min_separation, tolerance, nonzero_toi)
        found.append((chunk[rows[0].long()], *rows[1:]))
    rows = found[0] if len(found) == 1 else tuple(torch.cat(column) for column in zip(*found, strict=True))  # type: ignore[assignment]
    if report == "earliest":  # of the chunks' earliest ones
        rows = narrow.keep_earliest(rows)
    pair, kind, features, status, toi, coordinates, point, normal = rows
    stats.contacts = pair.shape[0]
    # Read together: on a GPU every look at a number waits for it.
    unresolved = (status == narrow.Status.UNRESOLVED).sum().reshape(1)
    stats.unresolved, *tests_made = torch.cat([unresolved, *node_tests]).tolist()
    stats.node_tests = sum(tests_made)
    if report == "any":
        return Contacts(pair, None, None, None, None, None, None, None, stats)
    return Contacts(pair, toi, kind, features, coordinates, point, normal, status, stats)


def _budget(wanted: int | None, pair_count: int, device: torch.device) -> int:
    """Bytes of scratch memory to aim at. What a GPU has free is only asked where it matters: asking takes time."""
    if wanted is not None:
        return wanted
    if device.type != "cuda" or pair_count * _BYTES_PER_PAIR <= _DEFAULT_BUDGET:
        return _DEFAULT_BUDGET
    free, _ = torch.cuda.mem_get_info(device)
    return max(_DEFAULT_BUDGET, free // 4)


def _traverse(
    stats: Stats,
    bodies: MovingBodies,
    pairs: Tensor,
    min_separation: float,
    tolerance: float | None,
    horizon: Tensor | None,
    leading: bool,
) -> tuple[Tensor, Tensor]:
    with _timed(stats, "traverse"):
        candidates, node_tests = traverse.search(bodies, pairs, min_separation, tolerance, horizon, leading)
        stats.candidates += candidates.shape[0]
    return candidates, node_tests


def _narrow(
    stats: Stats,
    bodies: MovingBodies,
    pairs: Tensor,
    candidates: Tensor,
    report: narrow.Report,
    min_separation: float,
    tolerance: float | None,
    nonzero_toi: bool,
) -> ContactRows:
    with _timed(stats, "narrow"):
        return narrow.solve(bodies, pairs, candidates, report, min_separation, tolerance, nonzero_toi)


@contextmanager
def _timed(stats: Stats, stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    stats.seconds[stage] = stats.seconds.get(stage, 0.0) + time.perf_counter() - start
