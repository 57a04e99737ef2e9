"""Cases that every run tests, and the rest, which only slow runs test."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def few_and_many(name: str, few: int, many: int) -> pytest.MarkDecorator:
    """The number `name` of examples: few of them in every run, many in slow runs."""
    return pytest.mark.parametrize(name, [few, pytest.param(many, marks=pytest.mark.slow)])


#: Parts of `torch.library.opcheck`: the last two, which trace the operators, in slow runs.
OPCHECK = ("test_schema", "test_faketensor"), ("test_autograd_registration", "test_aot_dispatch_dynamic")
checked_as = pytest.mark.parametrize("utilities", [OPCHECK[0], pytest.param(OPCHECK[1], marks=pytest.mark.slow)])


def mostly_slow(cases: Iterable[Any], quick: Collection[Any]) -> list[Any]:
    """The cases as parameters, of which all but the `quick` ones are slow tests. A tuple has a case's parameters."""
    return [
        case if case in quick else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]
