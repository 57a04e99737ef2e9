"""Detection in pieces: the PCS is streamed in chunks, each traversed and solved before the next."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from pgccd import broad, narrow, ops, traverse
from pgccd.bodies import MovingBodies
from pgccd.capacity import Capacity
from pgccd.contacts import ContactRows, Contacts, Stats
from pgccd.memory import pairs_a_chunk
from pgccd.query import Query


def stream(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase,
    pairs: Tensor | None,
    memory_budget: int | None,
) -> Contacts:
    """What `pgccd.detect` does in little memory, and on a CPU always. Buffers have the sizes needed.

    Args:
        bodies: the scene in motion.
        query: what is asked.
        broad_phase, pairs, memory_budget: as for `detect`.
    """
    stats = Stats(bodies=bodies.scene.body_count)
    if bodies.device.type != "cpu":
        bodies.raise_faults(bodies.first_faults().tolist())
    ops.take_scratch_peak()
    with _timed(stats, "broad"):
        stats.broad_phase = broad.choose(bodies, broad_phase) if pairs is None else "given"
        if pairs is None:
            pairs = broad.find_pairs(bodies, query.min_separation, broad_phase)
    stats.pcs = pairs.shape[0]

    node_tests: list[Tensor] = []
    found = []
    for chunk in pairs.split(pairs_a_chunk(bodies.scene, query, memory_budget, len(pairs))):
        stats.chunks += 1
        horizon = None
        if query.report in ("first", "earliest") and bodies.device.type == "cpu":
            # A good guess at each pair's first contact bounds how far the search for an earlier one need look. A GPU
            # has searched all of it sooner than it has found the guess.
            candidates, tests = _traverse(stats, bodies, query, chunk, None, leading=True)
            node_tests.append(tests)
            rows = _narrow(stats, bodies, query, chunk, candidates, "first")
            horizon = torch.ones(len(chunk), dtype=torch.float64, device=bodies.device)
            horizon[rows[0].long()] = rows[4]
            if query.report == "earliest" and len(horizon):
                horizon = horizon.min().expand_as(horizon).contiguous()
        candidates, tests = _traverse(stats, bodies, query, chunk, horizon, leading=False)
        node_tests.append(tests)
        rows = _narrow(stats, bodies, query, chunk, candidates, query.report)
        found.append((chunk[rows[0].long()], *rows[1:]))
    rows = found[0] if len(found) == 1 else tuple(torch.cat(column) for column in zip(*found, strict=True))  # type: ignore[assignment]
    if query.report == "earliest":  # of the chunks' earliest ones
        rows = narrow.keep_earliest(rows)
    pair, kind, features, status, toi, coordinates, point, normal = rows
    stats.contacts = pair.shape[0]
    # Read together: on a GPU every look at a number waits for it.
    unresolved = (status == narrow.Status.UNRESOLVED).sum().reshape(1)
    stats.unresolved, *tests_made = torch.cat([unresolved, *node_tests]).tolist()
    stats.node_tests = sum(tests_made)
    if bodies.device.type == "cpu":
        stats.needed = Capacity(pairs=stats.pcs, contacts=stats.contacts, candidates=stats.candidates)
    else:
        stats.waits = 3 + 2 * stats.chunks  # faults, pairs, counts; candidates and contacts of each chunk
        stats.scratch_bytes = pairs.nbytes + ops.take_scratch_peak()
    if query.report == "any":
        return Contacts(pair, None, None, None, None, None, None, None, stats)
    return Contacts(pair, toi, kind, features, coordinates, point, normal, status, stats)


def _traverse(
    stats: Stats, bodies: MovingBodies, query: Query, pairs: Tensor, horizon: Tensor | None, leading: bool
) -> tuple[Tensor, Tensor]:
    with _timed(stats, "traverse"):
        candidates, node_tests = traverse.search(bodies, pairs, query.min_separation, query.tolerance, horizon, leading)
        stats.candidates += candidates.shape[0]
    return candidates, node_tests


def _narrow(
    stats: Stats, bodies: MovingBodies, query: Query, pairs: Tensor, candidates: Tensor, report: narrow.Report
) -> ContactRows:
    with _timed(stats, "narrow"):
        return narrow.solve(bodies, pairs, candidates, report, query.min_separation, query.tolerance, query.nonzero_toi)


@contextmanager
def _timed(stats: Stats, stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    stats.seconds[stage] = stats.seconds.get(stage, 0.0) + time.perf_counter() - start
