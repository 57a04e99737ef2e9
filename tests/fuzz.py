"""Long run of random scenes, whose contacts must have the same bits in all columns by every way to find them.

python tests/fuzz.py --scenes 2000 --seed 1 [--device cpu|cuda] [--ranks 3] [--only SEED]

Compares one thread of a CPU with several threads, every broad phase, chunks, given pairs, a fixed capacity and captured
steps, on the CPU and the device, and with 1 to 3 ranks. Prints the scenes that differ, and exits with 1 if any does.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
import warnings
from collections import Counter

from support.random_scenes import random_scene
from support.ranks import MOST_RANKS, RankPool
from support.ways import differences

# Ranks are asked for so many scenes at a time.
_BATCH = 25


def main(given: list[str] | None = None) -> int:
    """Compares scenes until there are enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the first scene; others follow")
    parser.add_argument("--only", type=int, metavar="SEED", help="compare this scene only")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="compared besides the CPU")
    parser.add_argument("--ranks", type=int, default=0, help=f"largest number of ranks, up to {MOST_RANKS}; 0 for none")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    arguments = parser.parse_args(given)
    if not 0 <= arguments.ranks <= MOST_RANKS:
        parser.error(f"--ranks: expected 0 to {MOST_RANKS}, got {arguments.ranks}")
    first, count = (arguments.seed, arguments.scenes) if arguments.only is None else (arguments.only, 1)
    warnings.filterwarnings("ignore", "scene: it has one body")
    devices = dict.fromkeys(("cpu", arguments.device))
    pool = RankPool() if arguments.ranks else None
    began, compared, different, kinds = time.monotonic(), 0, 0, Counter[str]()
    for begin in itertools.count(first, _BATCH):
        scenes = [random_scene(seed) for seed in range(begin, min(begin + _BATCH, first + count))]
        for difference in differences(scenes, devices, pool, arguments.ranks):
            different += 1
            print(f"{difference}\n  python tests/fuzz.py --only {difference.scene.seed}", flush=True)
        compared += len(scenes)
        kinds.update(scene.kind for scene in scenes)
        if compared >= count or time.monotonic() - began > 60 * arguments.minutes:
            break
    if pool is not None:
        pool.close()
    seconds = time.monotonic() - began
    counts = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items()))
    print(f"{compared} scenes ({counts}) in {seconds:.0f} s; {', '.join(devices)}, {arguments.ranks} ranks")
    print(f"{different} differences")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
