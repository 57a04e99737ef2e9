"""Numbers shared by Python and C++: enumerations and columns of counts, in the same order on both sides."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.shapes import approaching

import pgccd
from pgccd import broad, narrow, sim
from pgccd.contacts.kinds import FEATURES
from pgccd.motion.validation import CHECK_NUMBERS, LARGEST_COORDINATE, LARGEST_TURN, UNIT_TOLERANCE
from pgccd.runtime.sizes import COUNTS_OF_PAIRS, Counts
from pgccd.search.detect import detect_moving
from pgccd.search.query import Query
from pgccd.sim import model

CSRC = Path(__file__).resolve().parents[2] / "csrc"


def enumerators(header: str, name: str) -> dict[str, int]:
    """Names (snake case, without their k) and values of an enumeration."""
    text = (CSRC / header).read_text()
    found = re.search(rf"enum (?:class )?{name} : \w+ {{(.*?)}}", text, re.DOTALL)
    assert found is not None, f"{header}: no enum {name}"
    body = re.sub(r"//[^\n]*", "", found.group(1))
    values: dict[str, int] = {}
    for entry in filter(None, (part.strip() for part in body.split(","))):
        word, _, value = entry.partition("=")
        snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", word.strip().removeprefix("k")).lower()
        values[snake] = int(value) if value else len(values)
    return values


@pytest.mark.parametrize(
    ("header", "name", "expected"),
    [
        ("kernels/broad/broad.h", "BroadPhase", broad.BROAD_PHASE_NUMBERS),
        ("kernels/narrow/narrow.h", "Report", narrow.REPORTS),
        ("kernels/bounds/validation.h", "RowCheck", CHECK_NUMBERS),
        (
            "kernels/narrow/search_state.h",
            "Status",
            {name.lower(): value for value, name in narrow.Status.names().items()},
        ),
        (
            "core/candidate.h",
            "FeatureKind",
            {
                "vertex_face": narrow.Kind.VF_AB,
                "face_vertex": narrow.Kind.VF_BA,
                "edge_edge": narrow.Kind.EE,
                "edge_face": narrow.Kind.EF_AB,
                "face_edge": narrow.Kind.EF_BA,
            },
        ),
        ("kernels/simulate/world.h", "MovementPattern", {name: k for k, name in enumerate(sim.PATTERNS)}),
    ],
)
def test_enumerations(header: str, name: str, expected: dict[str, int]) -> None:
    written = enumerators(header, name)
    assert {key: written.get(key) for key in expected} == expected


@pytest.mark.parametrize(
    ("header", "constant", "names"),
    [
        ("kernels/broad/broad.h", "kBroadPhases", broad.BROAD_PHASE_NUMBERS),
        ("kernels/narrow/narrow.h", "kReports", narrow.REPORTS),
        ("core/candidate.h", "kFeatureKinds", FEATURES),
    ],
)
def test_numbers_of_enumerators(header: str, constant: str, names: Any) -> None:
    """Operators refuse numbers from this on."""
    found = re.search(rf"\b{constant} = (\d+);", (CSRC / header).read_text())
    assert found is not None and int(found[1]) == len(names)


@pytest.mark.parametrize(
    ("header", "constant", "value"),
    [
        ("core/paths.h", "kLargestCoordinate", LARGEST_COORDINATE),
        ("kernels/bounds/validation.h", "kUnitTolerance", UNIT_TOLERANCE),
        ("kernels/bounds/validation.h", "kLargestTurn", LARGEST_TURN),
    ],
)
def test_limits_of_columns(header: str, constant: str, value: float) -> None:
    found = re.search(rf"\b{constant} = ([\d.e-]+);", (CSRC / header).read_text())
    assert found is not None and float(found[1]) == value


def test_a_report_without_an_enumerator_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(narrow.REPORTS, "unknown", len(narrow.REPORTS))
    given = approaching(np.random.default_rng(0))
    scene, motion = given.scene(), given.motion()
    count = len(narrow.REPORTS) - 1
    with pytest.raises(RuntimeError, match=f"report: expected a number below {count}, got {count}"):
        detect_moving(pgccd.MovingBodies.of(scene, motion), Query("unknown", 0.0, None, False))  # type: ignore[arg-type]


def test_columns_of_counts() -> None:
    """They follow the order of `Counts`: broad phase, traversal, narrow phase."""
    stages = [
        enumerators("kernels/padded_pairs.h", "PairCount"),
        enumerators("kernels/traverse/traverse.h", "TraverseCount"),
        enumerators("kernels/narrow/narrow.h", "ContactCount"),
    ]
    names = []
    for stage in stages:
        *columns, total = stage  # the last enumerator is the number of columns
        assert total.endswith("_counts") and list(stage.values()) == list(range(len(stage)))
        names += columns
    expected = [re.sub("_needed$", "", name).replace("unresolved_written", "unresolved") for name in names]
    assert list(Counts._fields) == expected
    assert len(stages[0]) - 1 == COUNTS_OF_PAIRS


@pytest.mark.parametrize("fields", [model.WorldIntegers, model.WorldScales])
def test_numbers_of_a_world(fields: Any) -> None:
    text = (CSRC / "kernels/simulate/world.h").read_text()
    found = re.search(rf"struct {fields.__name__} {{(.*?)}};", text, re.DOTALL)
    assert found is not None
    declared = re.findall(r"(?:int64_t|double) ([\w, ]+);", found.group(1))
    assert [name.strip() for names in declared for name in names.split(",")] == list(fields._fields)


def test_options_of_a_query() -> None:
    text = (CSRC / "bind/padded_ops.h").read_text()
    assert "struct QueryOptions {\n  int64_t nonzero_toi, tests_start, report;\n};" in text
    for options in ((False, True, "all"), (True, False, "any")):
        query = Query(options[2], 0.0, None, options[0], "report" if options[1] else "assume_free")  # type: ignore[arg-type]
        assert query.options == [options[0], options[1], narrow.REPORTS[options[2]]]
