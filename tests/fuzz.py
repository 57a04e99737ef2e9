"""Long run of random scenes: every public call must give the same bits by every way to make it, on every device.

python tests/fuzz.py --scenes 3000 --seed 1 [--device cpu|cuda] [--jobs 16] [--ranks 3] [--only SEED]

Compares one thread of a CPU with the device: every call of `support.calls`. Without a GPU, with several threads, copies
of scene and motion, and all bodies in two worlds. Contacts are also found by every broad phase, in chunks, of given
pairs, in a fixed capacity and by captured steps, and with 1 to 3 ranks. A call that takes too long is a fault too.

Prints the scenes that differ, then a table of calls. Exits with 1 if any scene differs.
"""

from __future__ import annotations

import argparse
import multiprocessing
import multiprocessing.connection
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from support.hard_scenes import hard_scene
from support.ranks import MOST_RANKS, RankPool
from support.watched import Timed, compared
from support.ways import Difference, differences, of_ranks

# Ranks are asked for so many scenes at a time.
_BATCH = 25
# A process that says nothing for so long hangs in the call that it named last.
_HANGS = 240.0


@dataclass
class Tally:
    """What has been compared, by call."""

    compared: Counter[str] = field(default_factory=Counter)
    different: Counter[str] = field(default_factory=Counter)
    seconds: Counter[str] = field(default_factory=Counter)
    slowest: dict[str, tuple[float, int]] = field(default_factory=dict)
    scenes: Counter[str] = field(default_factory=Counter)
    of_scene: Counter[int] = field(default_factory=Counter)  #: seconds by seed

    def add(self, seed: int, call: str, seconds: float, said: str | None) -> None:
        """Adds a comparison."""
        self.compared[call] += 1
        self.seconds[call] += seconds
        self.of_scene[seed] += seconds  # type: ignore[assignment]
        self.slowest[call] = max(self.slowest.get(call, (0.0, seed)), (seconds, seed))
        if said is not None:
            self.different[call] += 1
            print(f"{said}\n  python tests/fuzz.py --only {seed}", flush=True)

    def __str__(self) -> str:
        lines = ["call".ljust(22) + "compared".rjust(10) + "differ".rjust(8) + "seconds".rjust(9) + "  slowest, seed"]
        for call, number in self.compared.items():
            seconds, seed = self.slowest[call]
            counts = f"{number:10}{self.different[call]:8}{self.seconds[call]:9.1f}"
            lines.append(f"{call:22}{counts}  {seconds:.2f}, {seed}")
        return "\n".join(lines)


Row = tuple[str, float, str | None]
Announce = Callable[[str], None]


def rows_of(seed: int, device: str, announce: Announce) -> Iterator[Row]:
    """All comparisons of a scene: the call, its seconds, and what differs."""
    scene = hard_scene(seed)
    for timed in compared(scene, device, announce):
        yield timed.call, timed.seconds, _words(timed)
    announce("ways to detect")
    began = time.process_time()
    found = differences([scene], [device], None, 0)
    yield "ways to detect", time.process_time() - began, "\n".join(map(str, found)) or None


def _words(timed: Timed) -> str | None:
    return None if timed.difference is None else str(timed.difference)


def _serve(pipe: multiprocessing.connection.Connection, device: str) -> None:
    """Compares the scenes whose seeds come through the pipe."""
    _settle()
    while (seed := pipe.recv()) is not None:
        try:
            rows = list(rows_of(seed, device, lambda call: pipe.send((call, None))))
        except Exception as error:
            cause = f"{type(error).__name__}: {error}" + (f": {error.__cause__}" if error.__cause__ else "")
            rows = [("scene", 0.0, f"seed {seed}: {cause}")]
        pipe.send((str(hard_scene(seed).kind), rows))


def _settle() -> None:
    warnings.filterwarnings("ignore", "scene: it has one body")
    torch.set_num_threads(1)


class _Worker:
    """A process that compares one scene at a time."""

    def __init__(self, device: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, device), daemon=True)
        self.process.start()
        theirs.close()
        self.seed, self.call, self.heard = -1, "start", time.monotonic()

    def begin(self, seed: int) -> None:
        """Sends a seed."""
        self.seed, self.call, self.heard = seed, "start", time.monotonic()
        self.pipe.send(seed)


def run_in_processes(seeds: Iterator[int], device: str, jobs: int, tally: Tally) -> None:
    """Compares the scenes of all seeds in so many processes. One that hangs or dies is a difference of its scene."""
    workers = [_Worker(device) for _ in range(jobs)]
    busy = []
    for worker in workers:
        if (seed := next(seeds, None)) is not None:
            worker.begin(seed)
            busy.append(worker)
    while busy:
        ready = multiprocessing.connection.wait([worker.pipe for worker in busy], timeout=5.0)
        for worker in list(busy):
            fault, is_done = None, False
            if worker.pipe in ready:
                worker.heard = time.monotonic()
                try:
                    what, rows = worker.pipe.recv()
                except EOFError:
                    fault = "the process died"
                else:
                    is_done = rows is not None
                    worker.call = what
                    if is_done:
                        tally.scenes[what] += 1
                        for row in rows:
                            tally.add(worker.seed, *row)
            elif time.monotonic() - worker.heard > _HANGS:
                fault = f"no end after {_HANGS:.0f} s"
            if fault is not None:
                tally.scenes["without end"] += 1
                tally.add(worker.seed, worker.call, 0.0, f"{hard_scene(worker.seed)}\n  {worker.call}: {fault}")
                worker.process.kill()
            if fault is None and not is_done:
                continue
            busy.remove(worker)
            if (seed := next(seeds, None)) is None:
                continue
            if fault is not None:
                worker = _Worker(device)
                workers.append(worker)
            worker.begin(seed)
            busy.append(worker)
    for worker in workers:
        worker.process.kill()


def run_ranks(seeds: list[int], devices: list[str], ranks: int, tally: Tally) -> None:
    """Compares the contacts of several ranks."""
    pool = RankPool()
    for begin in range(0, len(seeds), _BATCH):
        scenes = [hard_scene(seed) for seed in seeds[begin : begin + _BATCH]]
        began, faults = time.monotonic(), dict[int, Difference]()
        for difference in of_ranks(scenes, devices, pool, ranks):
            faults.setdefault(difference.scene.seed, difference)
        seconds = (time.monotonic() - began) / len(scenes)
        for scene in scenes:
            said = faults.get(scene.seed)
            tally.add(scene.seed, "ranks", seconds, None if said is None else str(said))
    pool.close()


def main(given: list[str] | None = None) -> int:
    """Compares scenes until there are enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the first scene; others follow")
    parser.add_argument("--only", type=int, metavar="SEED", help="compare this scene only")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="compared with one thread of a CPU")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes; with more than one a hang is seen")
    parser.add_argument("--ranks", type=int, default=0, help=f"largest number of ranks, up to {MOST_RANKS}; 0 for none")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    arguments = parser.parse_args(given)
    if not 0 <= arguments.ranks <= MOST_RANKS:
        parser.error(f"--ranks: expected 0 to {MOST_RANKS}, got {arguments.ranks}")
    if arguments.jobs < 1:
        parser.error(f"--jobs: expected a number of processes >= 1, got {arguments.jobs}")
    first, count = (arguments.seed, arguments.scenes) if arguments.only is None else (arguments.only, 1)
    began, tally, taken = time.monotonic(), Tally(), list[int]()

    def seeds() -> Iterator[int]:
        for seed in range(first, first + count):
            if time.monotonic() - began > 60 * arguments.minutes:
                return
            taken.append(seed)
            yield seed

    if arguments.jobs > 1:
        run_in_processes(seeds(), arguments.device, arguments.jobs, tally)
    else:
        threads = torch.get_num_threads()
        with warnings.catch_warnings():
            _settle()
            for seed in seeds():
                for row in rows_of(seed, arguments.device, lambda call: None):
                    tally.add(seed, *row)
                tally.scenes[hard_scene(seed).kind] += 1
        torch.set_num_threads(threads)
    if arguments.ranks:
        run_ranks(taken, list(dict.fromkeys(("cpu", arguments.device))), arguments.ranks, tally)
    seconds, compared_scenes = time.monotonic() - began, sum(tally.scenes.values())
    different = sum(tally.different.values())
    kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(tally.scenes.items()))
    print(tally)
    slowest = max(tally.of_scene, key=lambda seed: tally.of_scene[seed], default=first)
    call = max(tally.slowest, key=lambda name: tally.slowest[name], default="")
    print(f"{compared_scenes} scenes ({kinds}) in {seconds:.0f} s; {arguments.device}, {arguments.ranks} ranks")
    print(f"slowest scene: seed {slowest}, {tally.of_scene[slowest]:.1f} s", end="; ")
    print(
        "slowest call: "
        + ("none" if not call else f"{call}, {tally.slowest[call][0]:.1f} s, seed {tally.slowest[call][1]}")
    )
    print(f"{sum(tally.compared.values())} comparisons, {different} differences")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
