"""Mutants of the rounds of resolution: lists of pairs, shortened paths, ghosts, and rounds in graphs."""

from __future__ import annotations

from mutants_of.mutant import Mutant

BODIES = "pgccd/search/bodies.py"
LISTED = "pgccd/resolution/listed.py"
PATHS = "csrc/core/paths.h"
ITEM = "csrc/kernels/resolve/pair_motion_item.h"
RESOLVE = "pgccd/distributed/world/resolve.py"
GRAPHS = "pgccd/distributed/world/world_graphs.py"
ON_LISTED = ("resolution/test_listed.py",)
ON_RESOLVE = ("distributed/world/test_resolve.py",)
ON_INCOMPLETE = ("distributed/world/test_captured_incomplete.py",)
ON_GRAPHS = ("distributed/world/test_captured_resolving.py",)


def _mutant(name: str, file: str, old: str, new: str, within: str = "") -> Mutant:
    killed_by = {RESOLVE: ON_RESOLVE, GRAPHS: ON_GRAPHS}.get(file, ON_LISTED)
    return Mutant(name, file, old, new, killed_by, within, switched=file == ITEM)


MUTANTS = [
    _mutant("rounds-stopped-origin", BODIES, "2.0**-48 * furthest", "0.999 * 2.0**-48 * furthest"),
    _mutant("rounds-stopped-turn", BODIES, "2.0**-51 * turn", "0.999 * 2.0**-51 * turn"),
    _mutant("rounds-stopped-turn-about-the-centre", BODIES, "turn * (self.reach + arm)", "turn * self.reach"),
    _mutant(
        "rounds-stopped-at-the-start", BODIES, "torch.maximum(start.abs(), end.abs()).amax(1)", "start.abs().amax(1)"
    ),
    _mutant("rounds-boxes-of-stopped-bodies", BODIES, "growth + stray / unit", "growth + 0.999 * stray / unit"),
    _mutant("rounds-list-however-far", LISTED, "travel <= _FARTHEST * reach", "travel >= 0.0"),
    _mutant("rounds-first-part-of-the-list", LISTED, "pairs.tensor_split(pieces)", "pairs.tensor_split(pieces)[:1]"),
    _mutant(
        "rounds-list-of-too-few-pairs",
        LISTED,
        "self._is_listed = False",
        "pass",
        'def look_again(self) -> None:\n        """As of `RoundSearch`."""\n        self._is_listed = False',
    ),
    _mutant("rounds-list-however-long", LISTED, "listed <= _LONGEST * max(pcs, 1)", "listed >= 0"),
    _mutant("rounds-skip-faster-bodies", ITEM, "fraction[i] == fraction[j]", "fraction[i] >= fraction[j]"),
    _mutant("rounds-never-skip", ITEM, "skips_equal && fraction[i] == fraction[j]", "false"),
    _mutant("rounds-first-body-changed", ITEM, "(changed[i] | changed[j]) != 0", "changed[i] != 0"),
    _mutant("rounds-end-is-rounded", PATHS, "fraction == 1.0", "false"),
    _mutant("rounds-start-is-rounded", PATHS, "fraction == 0.0", "false"),
    _mutant("rounds-displacement-is-an-end", ITEM, "start + part * end", "start + part * (end - start)"),
    _mutant("rounds-stopped-by-of-one-rank", RESOLVE, '.scatter_reduce(0, rows, answer, "amin")', ""),
    _mutant(
        "rounds-fixed-ghosts-stop",
        RESOLVE,
        'torch.cat([fixed, held.ghosts["fixed"]])',
        'torch.cat([fixed, held.ghosts["fixed"] & False])',
    ),
    Mutant(
        "rounds-list-again-however-long",
        RESOLVE,
        "plan.lists = is_short(*resolved.counts.listed)",
        "pass",
        ON_GRAPHS,
        switched=False,
    ),
    _mutant(
        "rounds-fixed-ghosts-stop-in-graphs",
        GRAPHS,
        'torch.cat([fixed, share.held.ghosts["fixed"]])',
        'torch.cat([fixed, share.held.ghosts["fixed"] & False])',
    ),
    _mutant("rounds-incomplete-elsewhere", GRAPHS, "exchange.gather(incomplete).amax(dim=0)", "incomplete"),
    _mutant(
        "rounds-incomplete-and-moves",
        GRAPHS,
        "attempt.fraction[: share.held.own_count].masked_fill(incomplete != 0, 0.0)",
        "attempt.fraction[: share.held.own_count]",
    ),
    Mutant(
        "graph-incomplete-elsewhere",
        GRAPHS,
        "comm.all_gather(incomplete).amax(dim=0).clamp(max=1)",
        "incomplete.clamp(max=1)",
        ON_INCOMPLETE,
        switched=False,
    ),
    Mutant(
        "graph-incomplete-and-free",
        GRAPHS,
        "first[:own_count].masked_fill(anywhere != 0, 0.0)",
        "first[:own_count]",
        ON_INCOMPLETE,
        switched=False,
    ),
    _mutant("rounds-more-than-captured", GRAPHS, ".overflow(), changes[-1:]]", ".overflow()]"),
    _mutant("rounds-messages-do-not-fit", GRAPHS, "flags.append(exchange.overflow())", "pass"),
]
