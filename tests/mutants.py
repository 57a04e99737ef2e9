"""Mutation testing: every margin and error bound is removed or made too small, one at a time.

python tests/mutants.py [--only NAME ...] [--list] [--jobs N] [--rest] [--equivalents] [--folder PATH]

For each mutant of `mutants_of` the test modules it names must fail ("killed"; their slow tests are run if the others
pass), or it must be marked as equivalent, with the reason. Works on a copy of the project with its own build folder,
for the CPU only. Mutants that replace one expression by another are compiled together and selected by an environment
variable; the others one by one. Prints a table, and exits with 1 if a mutant survived or if the unchanged copy fails
its tests.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mutants_of import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = "PGCCD_MUTANT"
# A mutant whose tests take longer counts as an endless loop.
SECONDS = 900
SLOW_SECONDS = 7200
_LEFT_OUT = {".git", ".venv", "build", "out", "results", "__pycache__", ".mypy_cache", ".ruff_cache", ".pytest_cache"}
_SWITCH = f"""
#include <cstdlib>
namespace pgccd {{
inline const int selected_mutant = std::getenv("{VARIABLE}") ? std::atoi(std::getenv("{VARIABLE}")) : 0;
}}
"""


class StaleMutantError(Exception):
    """The text that a mutant replaces does not occur exactly once."""


def span(mutant: Mutant, text: str) -> tuple[int, int]:
    """The range of the replaced text in a file's text.

    Raises:
        StaleMutantError: it does not occur exactly once.
    """
    around = mutant.within or mutant.old
    if text.count(around) != 1 or around.count(mutant.old) != 1:
        found = text.count(around), around.count(mutant.old)
        raise StaleMutantError(
            f"{mutant.name}: {mutant.file} holds the text {found[0]} times, {found[1]} times the part"
        )
    begin = text.index(around) + around.index(mutant.old)
    return begin, begin + len(mutant.old)


def with_mutant(mutant: Mutant, text: str) -> str:
    """The file's text with the part replaced."""
    begin, end = span(mutant, text)
    return text[:begin] + mutant.new + text[end:]


def with_switches(numbered: Iterable[tuple[int, Mutant]], text: str) -> str:
    """The file's text with every mutant in it as an expression switched by the selected number."""
    by_span: dict[tuple[int, int], list[tuple[int, Mutant]]] = {}
    for number, mutant in numbered:
        by_span.setdefault(span(mutant, text), []).append((number, mutant))
    for (begin, end), here in sorted(by_span.items(), reverse=True):
        choices = "".join(f"::pgccd::selected_mutant == {number} ? ({m.new}) : " for number, m in here)
        text = f"{text[:begin]}({choices}({text[begin:end]})){text[end:]}"
    return text


def overlaps(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two different ranges overlap."""
    return a != b and a[0] < b[1] and b[0] < a[1]


def batches(mutants: list[Mutant], texts: dict[str, str]) -> list[list[Mutant]]:
    """Groups of mutants that can be compiled together."""
    found: list[list[Mutant]] = []
    for mutant in mutants:
        here = span(mutant, texts[mutant.file])
        for batch in found:
            others = (span(m, texts[m.file]) for m in batch if m.file == mutant.file)
            if not any(overlaps(here, other) for other in others):
                batch.append(mutant)
                break
        else:
            found.append([mutant])
    return found


class Copy:
    """A copy of the project that is built and tested."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._originals: dict[str, str] = {}
        for source in sorted(ROOT.rglob("*")):
            name = source.relative_to(ROOT)
            if _LEFT_OUT.intersection(name.parts) or source.suffix in (".so", ".pyc") or not source.is_file():
                continue
            target = folder / name
            # Unchanged files keep their times, for the build; files changed by an earlier run get new ones.
            if not target.exists() or target.read_bytes() != source.read_bytes():
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())

    def write(self, texts: dict[str, str]) -> None:
        """Writes files with these texts, and restores all others; unchanged files are not touched."""
        for name in self._originals.keys() - texts.keys():
            self._put(name, self._originals[name])
        for name, text in texts.items():
            self._originals.setdefault(name, (ROOT / name).read_text())
            self._put(name, text)

    def _put(self, name: str, text: str) -> None:
        path = self.folder / name
        if path.read_text() != text:
            path.write_text(text)

    def build(self) -> None:
        """Compiles what changed."""
        command = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
        environment = {**os.environ, "PGCCD_CUDA": "0", "PYTHONPATH": ""}
        done = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"the copy does not compile:\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")

    def test(self, targets: Iterable[str], number: int = 0, slow: bool = False) -> tuple[bool, str]:
        """Whether the tests pass, and the first that fails. With `slow`, only the slow tests."""
        names = [f"tests/{t}" for t in targets]
        command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "-p", "no:cacheprovider", *names]
        command += ["-m", "slow" if slow else "not slow"]
        seconds = SLOW_SECONDS if slow else SECONDS
        environment = {**os.environ, VARIABLE: str(number), "PYTHONPATH": str(self.folder), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=seconds
            )
        except subprocess.TimeoutExpired:
            return False, "time-out"
        if done.returncode == 5 and slow:  # there are none
            return True, ""
        if done.returncode in (2, 3, 4, 5):  # no test was run
            raise SystemExit(f"pytest {' '.join(names)}:\n{done.stdout[-4000:]}\n{done.stderr[-2000:]}")
        failed = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
        return done.returncode == 0, failed[1] if failed else f"exit status {done.returncode}"


def verdict(copy: Copy, mutant: Mutant, number: int, rest: bool) -> str:
    """The verdict on the mutant compiled in as `number`."""
    passed, by = copy.test(mutant.killed_by, number)
    if passed and not mutant.equivalent:
        passed, by = copy.test(mutant.killed_by, number, slow=True)
        if not passed and "::" in by:
            if not mutant.switched:
                copy.write({})
                copy.build()
            require_unchanged_passes(copy, [by], slow=True)
    if passed and rest and not mutant.equivalent:
        passed, by = copy.test([""], number)
    if passed:
        return "equivalent" if mutant.equivalent else "SURVIVED"
    return f"{'NOT EQUIVALENT: ' if mutant.equivalent else ''}killed by {by}"


def require_unchanged_passes(copy: Copy, targets: Iterable[str], slow: bool = False) -> None:
    """Ends the program if one of these tests fails without any mutant: it would seem to kill them all."""
    passed, by = copy.test(sorted(set(targets)), slow=slow)
    if not passed:
        raise SystemExit(f"without any mutant: {by} fails")


def targets_of(mutants: Iterable[Mutant]) -> list[str]:
    """The tests that must fail for these mutants."""
    return [target for mutant in mutants for target in mutant.killed_by]


def run(mutants: list[Mutant], folder: Path, jobs: int, rest: bool) -> dict[str, str]:
    """The verdicts by name; printed as they become available."""
    copy, verdicts = Copy(folder), dict[str, str]()
    texts = {m.file: (ROOT / m.file).read_text() for m in mutants}

    def judge(numbered: tuple[int, Mutant]) -> None:
        number, mutant = numbered
        began = time.monotonic()
        verdicts[mutant.name] = verdict(copy, mutant, number, rest)
        print(f"{mutant.name:34} {verdicts[mutant.name]} ({time.monotonic() - began:.0f} s)", flush=True)

    for batch in batches([m for m in mutants if m.switched], texts):
        numbered = list(enumerate(batch, 1))
        written = {
            name: with_switches((n for n in numbered if n[1].file == name), texts[name])
            for name in {m.file for m in batch}
        }
        platform = "csrc/core/platform.h"
        written[platform] = (ROOT / platform).read_text() + _SWITCH
        copy.write(written)
        copy.build()
        require_unchanged_passes(copy, targets_of(batch))
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(judge, numbered))
    one_by_one = [m for m in mutants if not m.switched]
    if one_by_one:
        copy.write({})
        copy.build()
        require_unchanged_passes(copy, targets_of(one_by_one))
    for mutant in one_by_one:
        copy.write({mutant.file: with_mutant(mutant, texts[mutant.file])})
        if mutant.file.startswith("csrc"):
            copy.build()
        judge((0, mutant))
    return verdicts


def main() -> int:
    """Runs the requested mutants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these, or all whose names begin so")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    parser.add_argument("--jobs", type=int, default=1, help="how many are tested at a time")
    parser.add_argument("--rest", action="store_true", help="run the whole suite on those that survive their own tests")
    parser.add_argument("--equivalents", action="store_true", help="run those marked as equivalent too")
    parser.add_argument("--folder", type=Path, help="where the copy is made, and kept for the next run")
    arguments = parser.parse_args()

    chosen = [m for m in MUTANTS if not arguments.only or any(m.name.startswith(name) for name in arguments.only)]
    for mutant in chosen:
        span(mutant, (ROOT / mutant.file).read_text())
    if arguments.list:
        for m in chosen:
            print(f"{m.name:34} {m.file}: {m.equivalent and 'equivalent: ' + m.equivalent or ' '.join(m.killed_by)}")
        return 0
    asked = [m for m in chosen if arguments.equivalents or not m.equivalent]
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        verdicts = run(asked, arguments.folder.resolve(), arguments.jobs, arguments.rest)
    else:
        with tempfile.TemporaryDirectory(prefix="pgccd-mutants-") as folder:
            verdicts = run(asked, Path(folder), arguments.jobs, arguments.rest)
    print()
    for m in chosen:
        print(f"{m.name:34} {verdicts.get(m.name, 'equivalent: ' + m.equivalent)}")
    wrong = [name for name, found in verdicts.items() if found.startswith(("SURVIVED", "NOT EQUIVALENT"))]
    print(f"{len(verdicts)} run, {len(wrong)} not as expected: {' '.join(wrong)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
