"""Detection in chunks: the PCS is streamed, each chunk traversed and solved before the next."""

import sys
import time
from collections.abc import Callable
from typing import Any

from torch import Tensor

from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.memory import estimate_of, pairs_a_chunk
from pgccd.search.query import Query

#: Finds the contacts of given pairs (P, 2); None if they need more memory than a budget.
SolvePairs = Callable[[Tensor, int | None], Contacts | CollidingPairs | None]


def stream(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase,
    pairs: Tensor | None,
    memory_budget: int | None,
    solve: SolvePairs,
) -> Contacts | CollidingPairs:
    """`pgccd.detect` in limited memory; on a CPU also with given pairs, and for deforming bodies.

    Args:
        bodies: the scene in motion.
        query: options of the search.
        broad_phase, pairs, memory_budget: as for `detect`.
        solve: solves a chunk; if that needs too much memory, its halves are solved, and a single pair without a limit.
    """
    start = time.perf_counter()
    chosen = broad.choose(bodies, broad_phase) if pairs is None else "given"
    if pairs is None:
        bodies._raise_invalid(bodies._first_invalid_rows().tolist())
        pairs = broad.find_pairs_of_checked(bodies, query.min_separation, chosen, query.tolerance)
    seconds = time.perf_counter() - start
    parts: list[Any] = []
    # Stack of remaining chunks, the next one last.
    length = pairs_a_chunk(bodies.scene, estimate_of(bodies.scene, query, None), memory_budget, pairs.shape[0])
    chunks = [pairs] if pairs.shape[0] <= length else list(pairs.split(length))[::-1]
    while chunks:
        chunk = chunks.pop()
        found = solve(chunk, memory_budget)
        if found is None and len(chunk) > 1:
            half = len(chunk) // 2
            chunks += [chunk[half:], chunk[:half]]
            continue
        if found is None:
            found = solve(chunk, sys.maxsize)
        if found is None:
            raise RuntimeError("memory: a single pair of bodies needs more rows than can be numbered")
        parts.append(found)
    contacts: Contacts | CollidingPairs = parts[0] if len(parts) == 1 else type(parts[0]).cat(parts)
    if len(parts) > 1 and query.report == "earliest" and isinstance(contacts, Contacts):
        contacts = contacts.earliest()
    contacts.stats.broad_phase = chosen
    contacts.stats.seconds = {"broad": seconds} | {
        stage: spent for stage, spent in contacts.stats.seconds.items() if stage != "broad"
    }
    return contacts
