"""Long run of the elementary tests and of joint paths: random and adversarial queries against an oracle.

python tests/nightly.py --queries 10000000 --seed 1 [--path linear|rigid|joints] [--dtype float64|float32]
                        [--device cpu|cuda]

`--path joints` certifies paths of random robots, and compares them with samples.

Prints a table by family, and examples of failures. Exits with 1 if a contact was missed, late or false, or if more than
the usual number were unresolved or undecided.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator

import torch
from support import bulk, bulk_arcs, bulk_joints
from support.bulk import Tally

COLUMNS = ("queries", "true", "missed", "late", "invented", "misplaced", "near", "unresolved", "undecided")


def stream(arguments: argparse.Namespace) -> Iterator[tuple[str, Tally]]:
    """An endless stream of rounds."""
    if arguments.path == "rigid":
        return bulk_arcs.arcs_checked(arguments.seed, itertools.count(), arguments.device)
    if arguments.path == "joints":
        return bulk_joints.joint_paths_checked(arguments.seed, itertools.count())
    return bulk.straight(arguments.seed, itertools.count(), getattr(torch, arguments.dtype), arguments.device)


def table(tallies: dict[str, Tally]) -> str:
    """One line per family, and their sum."""
    total = Tally()
    for tally in tallies.values():
        total.add(tally)
    lines = ["family".ljust(18) + "".join(c.rjust(12) for c in COLUMNS) + "undecided %".rjust(13) + "seconds".rjust(10)]
    for name, tally in [*tallies.items(), ("all", total)]:
        numbers = "".join(str(getattr(tally, c)).rjust(12) for c in COLUMNS)
        lines.append(f"{name:18}{numbers}{100 * tally.share('undecided'):13.4f}{tally.seconds:10.1f}")
    return "\n".join(lines)


def main() -> int:
    """Runs rounds until there are enough queries."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--path", choices=("linear", "rigid", "joints"), default="linear")
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64", help="of straight paths")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    arguments = parser.parse_args()
    if arguments.path == "linear" and not bulk.accepts(getattr(torch, arguments.dtype)):
        parser.error(f"--dtype: the elementary tests do not take {arguments.dtype}")
    torch.set_num_threads(1)

    tallies: dict[str, Tally] = {}
    began, count = time.monotonic(), 0
    for name, tally in stream(arguments):
        tallies.setdefault(name, Tally()).add(tally)
        count += tally.queries
        if count >= arguments.queries or time.monotonic() - began > 60 * arguments.minutes:
            break
    print(table(tallies))
    faults = [line for name, tally in tallies.items() for line in tally.complaints(name)]
    print("\n".join(faults))
    seconds = time.monotonic() - began
    settings = f"seed {arguments.seed}, {arguments.path} paths, {arguments.dtype}, {arguments.device}"
    print(f"{count} queries in {seconds:.0f} s ({count / seconds:.0f}/s); {settings}: {len(faults)} complaints")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
