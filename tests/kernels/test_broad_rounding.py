"""Spheres that touch exactly where world coordinates are rounded coarsely: no broad phase may miss a pair."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest
import torch
from support.broad_phases import agreed, check

# Directions with integer coordinates and integer length: touching is then decided in integers.
TRIPLES = ((0, 0, 1), (1, 2, 2), (2, 3, 6), (1, 4, 8), (4, 4, 7))


def directions_and_lengths() -> tuple[np.ndarray, np.ndarray]:
    rows = [np.array(order) for triple in TRIPLES for order in sorted(set(permutations(triple)))]
    rows = [
        row * np.array(signs) for row in rows for signs in np.ndindex(2, 2, 2) for signs in [1 - 2 * np.array(signs)]
    ]
    table = np.unique(np.array(rows), axis=0)
    return table, np.sqrt((table**2).sum(axis=1)).astype(np.int64)


def touching_across(exponent: int, seed: int, count: int = 300, largest: int = 6) -> dict[str, Any]:
    """Pairs of spheres, each in its own world, that touch exactly near the corner 2^exponent (1, 1, 1) of the octant,
    where the spacing of doubles doubles. Radii are of the order of that spacing.
    """
    rng = np.random.default_rng(seed)
    unit = 2.0 ** (exponent - 52)  # spacing just above the corner
    table, lengths = directions_and_lengths()
    chosen = rng.integers(len(table), size=count)
    times = rng.integers(1, largest + 1, count)
    first = rng.integers(-8, 9, (count, 3))
    offset, length = table[chosen] * times[:, None], lengths[chosen] * times
    # Half units, so that the bounds of boxes are rounded.
    halves = rng.integers(1, 2 * length)
    corner = rng.choice([-1.0, 1.0], 3) * 2.0**exponent  # the same for all, so that the middle of the scene is there
    sign = np.sign(corner)
    ends = [corner + sign * unit * first, corner + sign * unit * (first + offset)]
    radius = [0.5 * unit * halves, 0.5 * unit * (2 * length - halves)]
    position = np.stack(ends, axis=1).reshape(-1, 3)
    return {
        "start": position,
        "end": position,
        "radius": np.stack(radius, axis=1).reshape(-1),
        "world": np.repeat(np.arange(count), 2),
    }


@pytest.mark.parametrize("exponent", [0, 27, -40, 100, 300])
@pytest.mark.parametrize("largest", [1, 6, 1000])
def test_touching_across_a_power_of_two(device: torch.device, exponent: int, largest: int) -> None:
    scene = touching_across(exponent, abs(exponent) + largest, largest=largest)
    pairs = check(**scene, device=device)
    assert len(pairs) == len(scene["radius"]) // 2


def shifts(positions: np.ndarray, reach: float, corner: float) -> np.ndarray:
    """Shift of the middle of the interval position -/+ reach due to rounding its ends."""
    return 0.5 * ((positions - reach - corner) + (positions + reach - corner)) - (positions - corner)


def worst_pair(triple: tuple[int, int, int], length: int, exponent: int, seed: int) -> dict[str, Any]:
    """Two spheres that touch exactly along the direction, and whose computed boxes lie as far apart as possible."""
    rng = np.random.default_rng(seed)
    unit, corner = 2.0 ** (exponent - 52), 2.0**exponent
    best, found = 0.0, {}
    for numerator in rng.integers(1, 64 * length, 100):
        first = numerator / 64.0 * unit
        radii, chosen, apart = (first, length * unit - first), [], 0.0
        for component in triple:
            steps = 0.5 * np.arange(-2 * length, 2 * length)
            here, there = corner + steps * unit, corner + steps * unit + component * unit
            exact = ((here - corner) / unit == steps) & ((there - corner) / unit == steps + component)
            here, there = here[exact], there[exact]
            # Boxes grow the radii a little.
            moved = shifts(there, radii[1] * (1 + 2.0**-40), corner) - shifts(here, radii[0] * (1 + 2.0**-40), corner)
            k = int(np.argmax(moved))
            apart += moved[k] * component / length
            chosen.append((here[k], there[k]))
        if apart > best:
            centres = np.array(chosen).T.copy()
            best, found = apart, {"start": centres, "end": centres, "radius": np.array(radii)}
    return found


@pytest.mark.parametrize("exponent", [0, 27, -40, 100])
def test_boxes_rounded_apart(device: torch.device, exponent: int) -> None:
    """Spheres whose boxes are rounded apart still meet. The last direction comes within 0.0002 of the bound."""
    for triple, length in (((1, 2, 2), 3), ((6, 6, 7), 11), ((23, 24, 24), 41)):
        for seed in range(3):
            assert check(**worst_pair(triple, length, exponent, seed), device=device).tolist() == [[0, 1]]


def test_each_touching_pair_in_a_scene_of_its_own(device: torch.device) -> None:
    """Then the origin of the filter's boxes is next to the spheres."""
    scene = touching_across(27, 5, count=150)
    for k in range(0, 300, 2):
        one = {name: scene[name][k : k + 2] for name in ("start", "end", "radius")}
        assert agreed(**one, device=device).tolist() == [[0, 1]], k
