"""Worlds of robots so fast that some run into others which have stopped, without coming near at equal times."""

from __future__ import annotations

import functools
from typing import Any

from pgccd.sim import Model, ModelConfig
from support.resolution import plain_run

FAST: dict[str, dict[str, Any]] = {
    "random": {"robots": 150, "speed": 1.5, "spin": 0.5, "course_steps": 4.0, "seed": 3},
    "skewed": {"robots": 150, "pattern": "skewed", "speed": 1.5, "spin": 0.5, "course_steps": 4.0, "seed": 2},
}
STEPS = 8


@functools.cache
def follow_plainly(name: str) -> list[dict[str, Any]]:
    """Log lines of the reference."""
    return plain_run(Model(ModelConfig(**FAST[name])), STEPS)


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if "seconds" not in name}
