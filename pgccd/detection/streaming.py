"""Detection in pieces: the PCS is streamed in chunks, each traversed and solved before the next."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.capacity import Capacity
from pgccd.detection.contacts import Contacts, Stats
from pgccd.detection.memory import estimate_of, pairs_a_chunk
from pgccd.detection.query import Query

_COLUMNS = ("pairs", "toi", "kind", "features", "coordinates", "point", "normal", "status")
_SUMS = ("pcs", "node_tests", "candidates", "contacts", "unresolved", "chunks", "waits")

#: Finds the contacts of given pairs (P, 2); None if they need more memory than there may be.
SolvePairs = Callable[[Tensor], Contacts | None]


def stream(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase,
    pairs: Tensor | None,
    memory_budget: int | None,
    solve: SolvePairs,
    solve_at_any_price: Callable[[Tensor], Contacts],
) -> Contacts:
    """What `pgccd.detect` does in little memory; on a CPU also with given pairs, and with bodies that deform.

    Args:
        bodies: the scene in motion.
        query: what is asked.
        broad_phase, pairs, memory_budget: as for `detect`.
        solve: of a chunk; where that is too much, its halves are tried.
        solve_at_any_price: of a single pair that is too much.
    """
    start = time.perf_counter()
    chosen = broad.choose(bodies, broad_phase) if pairs is None else "given"
    if pairs is None:
        if not bodies.checked:
            bodies.raise_faults(bodies.first_faults().tolist())
        pairs = broad.find_pairs_of_checked(bodies, query.min_separation, chosen, query.tolerance)
    seconds = time.perf_counter() - start
    parts: list[Contacts] = []
    # A list of chunks to come, the next one last.
    length = pairs_a_chunk(bodies.scene, estimate_of(bodies.scene, query, None), memory_budget, pairs.shape[0])
    chunks = [pairs] if pairs.shape[0] <= length else list(pairs.split(length))[::-1]
    while chunks:
        chunk = chunks.pop()
        found = solve(chunk)
        if found is None and len(chunk) > 1:
            half = len(chunk) // 2
            chunks += [chunk[half:], chunk[:half]]
            continue
        parts.append(solve_at_any_price(chunk) if found is None else found)
    contacts = parts[0] if len(parts) == 1 else join_contacts(parts, [part.pairs for part in parts])
    if len(parts) > 1 and query.report == "earliest":
        contacts = contacts.earliest()
    contacts.stats.broad_phase = chosen
    contacts.stats.seconds = {"broad": seconds} | {
        stage: spent for stage, spent in contacts.stats.seconds.items() if stage != "broad"
    }
    return contacts


def join_contacts(parts: Sequence[Contacts], pairs: Sequence[Tensor]) -> Contacts:
    """The contacts of all parts, one part after the other.

    Args:
        parts: of the same report.
        pairs: (K, 2), to take the place of each part's own.
    """
    given = [replace(part, pairs=column) for part, column in zip(parts, pairs, strict=True)]
    columns = [torch.cat(values) for values in zip(*map(_columns, given), strict=True)]
    stats = Stats(bodies=parts[0].stats.bodies, broad_phase=parts[0].stats.broad_phase)
    for part in parts:
        for name in _SUMS:
            setattr(stats, name, getattr(stats, name) + getattr(part.stats, name))
        for stage, spent in part.stats.seconds.items():
            stats.seconds[stage] = stats.seconds.get(stage, 0.0) + spent
    stats.contacts = len(columns[0])
    stats.scratch_bytes = max(part.stats.scratch_bytes for part in parts)
    if columns[0].device.type == "cpu":
        stats.needed = Capacity(pairs=stats.pcs, contacts=stats.contacts, candidates=stats.candidates)
    named: dict[str, Any] = dict.fromkeys(_COLUMNS)
    named |= zip(_COLUMNS, columns, strict=False)  # report="any" has only the first
    return Contacts(**named, stats=stats)


def _columns(part: Contacts) -> list[Tensor]:
    return [column for column in (getattr(part, name) for name in _COLUMNS) if column is not None]
