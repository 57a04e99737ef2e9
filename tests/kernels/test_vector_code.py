"""The compiled traversal: loops over lanes are vectorised only where everything that they call is inlined."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from functools import cache
from typing import NamedTuple

import pytest

from pgccd.ops.library import _C

# Of the built library: a part of a function's name, and at least how many of its instructions are arithmetic on eight
# floats. Without the loop over a block's children the first one has about 110, without the test of supports 100.
VECTOR_FUNCTIONS = {
    "::children_meeting<pgccd::RigidBodies>(": 150,
    "::leaves_stay_apart<float __vector(8), pgccd::RigidBodies>(": 16,
    "pgccd::FeatureTests<pgccd::visit_leaves<pgccd::RigidBodies": 90,
}
ARITHMETIC = re.compile(r"v(fn?m\w*|add|sub|mul|div|min|max|sqrt)ps\s.*%ymm")
#: Part of the name of a lambda that tests a direction in every lane.
LANES = "{lambda(pgccd::Vec3<float __vector(8)>)"


class Function(NamedTuple):
    name: str
    instructions: list[str]


def output_of(tool: str, *arguments: str) -> str:
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool}")
    return subprocess.run([tool, *arguments], capture_output=True, text=True, check=True).stdout


@cache
def symbols() -> list[tuple[int, int, str]]:
    if platform.machine() != "x86_64":
        pytest.skip("the instructions of x86-64")
    rows = re.findall(
        r"^([0-9a-f]+) ([0-9a-f]+) [tTwW] (.*)$", output_of("nm", "-CS", "--defined-only", _C.__file__), re.M
    )
    if not rows:
        pytest.skip("the library has no symbols, as in wheels")
    return [(int(begin, 16), int(size, 16), name) for begin, size, name in rows]


def functions(part: str) -> list[Function]:
    found = []
    for begin, size, name in symbols():
        # Lambdas within the function are functions of their own.
        if part not in name or "walk_spans" in name or "_Function_handler" in name:
            continue
        text = output_of(
            "objdump",
            "-dC",
            "--no-show-raw-insn",
            f"--start-address={begin}",
            f"--stop-address={begin + size}",
            _C.__file__,
        )
        found.append(Function(name, re.findall(r"^ +[0-9a-f]+:\t(.*)$", text, re.M)))
    return found


@pytest.mark.parametrize("part", VECTOR_FUNCTIONS)
def test_loops_over_lanes_are_vectorised(part: str) -> None:
    found = functions(part)
    assert found, "no such function: was it renamed, or inlined?"
    for function in found:
        arithmetic = [line for line in function.instructions if ARITHMETIC.match(line)]
        assert len(arithmetic) >= VECTOR_FUNCTIONS[part], function.name


@pytest.mark.parametrize("part", VECTOR_FUNCTIONS)
def test_they_call_nothing_but_code_of_lanes(part: str) -> None:
    for function in functions(part):
        calls = [line for line in function.instructions if line.startswith("call") and LANES not in line]
        assert not calls, function.name
