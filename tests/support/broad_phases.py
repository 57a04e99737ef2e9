"""All broad phases on one scene: against each other and against the exact pairs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from oracle.broad import sphere_pairs, spheres_meet

import pgccd
from pgccd import ops
from support.shapes import tensors

AXES = (-1, 0, 1, 2)
NUMBERS = pgccd.broad.BROAD_PHASE_NUMBERS
# Each broad phase, and the sweep along each axis.
WAYS: tuple[tuple[Callable[..., torch.Tensor], tuple[int, ...]], ...] = (
    *((ops.broad_pairs, (NUMBERS["sweep"], axis)) for axis in AXES),
    *((ops.broad_pairs, (number, -1)) for name, number in NUMBERS.items() if name != "sweep"),
)
ROUNDING = 1e-12


def found_by(way: Any, start: Any, end: Any, radius: Any, separation: float = 0.0, **filters: Any) -> torch.Tensor:
    """Runs the operator on arrays (on the device of `filters["device"]`)."""
    operator, settings = way
    device, tolerance = filters.pop("device", "cpu"), filters.pop("tolerance", 0.0)
    at_any_times = filters.pop("at_any_times", False)
    columns = tensors(*(np.asarray(a, dtype=np.float64) for a in (start, end, radius)), device=device)
    types = {"group": torch.int64, "mask": torch.int64, "world": torch.int32, "static": torch.uint8}
    bits = [
        torch.as_tensor(filters[k], dtype=t, device=device) if filters.get(k) is not None else None
        for k, t in types.items()
    ]
    return operator((*columns, *bits), separation, tolerance, *settings, at_any_times).cpu()


def check(start: Any, end: Any, radius: Any, separation: float = 0.0, **filters: Any) -> np.ndarray:
    """Compares all broad phases with the oracle; returns the pairs."""
    device = filters.pop("device", "cpu")
    start, end, radius = (np.asarray(a, dtype=np.float64) for a in (start, end, radius))
    found = agreed(start, end, radius, separation, device=device, **filters)
    pairs = [tuple(p) for p in found.tolist()]
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs), "not sorted, or listed twice"
    truth = {tuple(p) for p in sphere_pairs(start, end, radius, separation, **filters).tolist()}
    assert truth - set(pairs) == set(), "missed"
    for i, j in set(pairs) - truth:
        both = [i, j]
        size = np.abs(start[j] - start[i]).max() + np.abs(end[j] - end[i]).max() + radius[i] + radius[j] + separation
        assert spheres_meet(start[both], end[both], radius[i], radius[j], separation + ROUNDING * size), "invented"
        assert tuple(both) in {tuple(p) for p in sphere_pairs(start, end, 1e300 + 0 * radius, **filters).tolist()}
    return found.numpy()


def agreed(start: Any, end: Any, radius: Any, separation: float = 0.0, **options: Any) -> torch.Tensor:
    """The pairs found by all broad phases, which must agree."""
    found = [found_by(way, start, end, radius, separation, **options) for way in WAYS]
    names = [f"{operator.__name__}{settings}" for operator, settings in WAYS]
    different = [name for name, pairs in zip(names, found, strict=True) if not torch.equal(pairs, found[0])]
    assert different == [], "these differ from the sweep"
    return found[0]


def scattered(rng: np.random.Generator, count: int, spread: float, step: float = 0.3) -> tuple[np.ndarray, ...]:
    """Centres at both ends, and radii around 1."""
    start = spread * rng.uniform(-1, 1, (count, 3))
    return start, start + step * rng.normal(size=(count, 3)), rng.uniform(0.2, 1.5, count)
