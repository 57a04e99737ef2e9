"""Description of a program in a comparison."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from typing import Any

from support import timing

import pgccd


@dataclass(frozen=True)
class Program:
    """A program as used for one question."""

    name: str
    package: str  #: on PyPI
    answers: str  #: its result, and for which shapes
    cannot: str = ""  #: the parts of the question that it cannot answer
    device: str = "CPU, 1 thread"


def row(question: str, program: Program, seconds: list[float], **counts: Any) -> dict[str, Any]:
    """One row of the comparison. `seconds` are per call (or per pair)."""
    return {
        "question": question,
        "program": program.name,
        "version": version(program.package),
        "device": program.device,
        "answers": program.answers,
        "cannot": program.cannot,
        "ms": timing.summary(seconds),
        **counts,
    }


def version(package: str) -> str:
    """The installed version."""
    return pgccd.__version__ if package == "pgccd" else importlib.metadata.version(package)
