"""The list of mutants: every text to be replaced occurs exactly once, so that the list matches the code."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mutants
import pytest
from mutants import ROOT, StaleMutantError, batches, span, with_mutant, with_switches
from mutants_of import MUTANTS, Mutant

TESTS = ROOT / "tests"


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: m.name)
def test_the_text_occurs_once(mutant: Mutant) -> None:
    text = (ROOT / mutant.file).read_text()
    begin, end = span(mutant, text)
    assert text[begin:end] == mutant.old != mutant.new
    assert all((TESTS / target.split("::")[0]).exists() for target in mutant.killed_by) and mutant.killed_by


def test_names_are_unique() -> None:
    assert len({m.name for m in MUTANTS}) == len(MUTANTS) >= 60


def test_stale_texts_are_refused() -> None:
    mutant = Mutant("m", "f", "b", "c", ("test_mutants.py",))
    assert with_mutant(mutant, "abd") == "acd"
    for text in ("ad", "abbd"):
        with pytest.raises(StaleMutantError, match="m: f holds"):
            span(mutant, text)
    narrowed = Mutant("m", "f", "b", "c", ("test_mutants.py",), within="bd")
    assert with_mutant(narrowed, "ab bd") == "ab cd"


@pytest.mark.parametrize("switched", [False, True])
def test_a_test_that_always_fails_kills_no_mutant(
    switched: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Failing(mutants.Copy):
        def __init__(self, folder: Path) -> None:
            self._originals = {}

        def _put(self, name: str, text: str) -> None:
            pass

        def build(self) -> None:
            pass

        def test(self, targets: Iterable[str], number: int = 0, slow: bool = False) -> tuple[bool, str]:
            return False, "test_mutants.py::test_m"

    monkeypatch.setattr(mutants, "Copy", Failing)
    mutant = Mutant("m", "tests/mutants.py", "SECONDS = 900", "SECONDS = 0", ("test_mutants.py",), switched=switched)
    with pytest.raises(SystemExit, match="^without any mutant: test_mutants.py::test_m fails"):
        mutants.run([mutant], tmp_path, 1, False)


@pytest.mark.parametrize("fails_always", [False, True])
def test_slow_tests_run_on_what_others_leave(fails_always: bool) -> None:
    class Slow:
        def __init__(self) -> None:
            self.ran: list[tuple[int, bool]] = []

        def test(self, targets: Iterable[str], number: int = 0, slow: bool = False) -> tuple[bool, str]:
            self.ran.append((number, slow))
            return not slow or (number == 0 and not fails_always), "test_mutants.py::test_m"

    copy: Any = Slow()
    mutant = Mutant("m", "f", "b", "c", ("test_mutants.py",))
    if fails_always:
        with pytest.raises(SystemExit, match="^without any mutant: test_mutants.py::test_m fails"):
            mutants.verdict(copy, mutant, 3, False)
    else:
        assert mutants.verdict(copy, mutant, 3, False) == "killed by test_mutants.py::test_m"
    assert copy.ran == [(3, False), (3, True), (0, True)]


def test_mutants_compiled_together_do_not_overlap() -> None:
    def mutant(old: str, new: str) -> Mutant:
        return Mutant(old + new, "f", old, new, ("test_mutants.py",))

    first, second, wider, other = mutant("b", "1"), mutant("b", "2"), mutant("abd", "3"), mutant("e", "4")
    assert batches([first, second, wider, other], {"f": "abde"}) == [[first, second, other], [wider]]
    switched = with_switches([(1, first), (2, second)], "abd")
    assert switched == "a(::pgccd::selected_mutant == 1 ? (1) : ::pgccd::selected_mutant == 2 ? (2) : (b))d"
