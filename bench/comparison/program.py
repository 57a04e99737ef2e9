"""What is said of every program in a comparison."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from typing import Any

from support import timing

import pgccd


@dataclass(frozen=True)
class Program:
    """One way of answering a question."""

    name: str
    package: str  #: on PyPI
    answers: str  #: what comes out, and of which shapes
    cannot: str = ""  #: what of the question it leaves open
    device: str = "CPU, 1 thread"


def row(question: str, program: Program, seconds: list[float], **counts: Any) -> dict[str, Any]:
    """One line of the comparison. `seconds` are those of each call (or of each pair)."""
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
    """The one that is installed."""
    return pgccd.__version__ if package == "pgccd" else importlib.metadata.version(package)
