"""Motions along the first part of each path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.shapes import unit_quaternions

import pgccd


def rigid(device: torch.device, path: Any = "rigid") -> pgccd.RigidMotion:
    rng = np.random.default_rng(5)
    columns = (
        rng.normal(size=(20, 3)),
        unit_quaternions(rng, 20),
        rng.normal(size=(20, 3)),
        4.0 * rng.normal(size=(20, 3)),
    )
    return pgccd.RigidMotion.from_velocity(*(torch.tensor(c, device=device) for c in columns), dt=1.0, path=path)


def test_poses_on_arcs(device: torch.device) -> None:
    motion, t = rigid(device), torch.linspace(0, 1, 7, dtype=torch.float64, device=device)[:, None]
    fraction = torch.linspace(0, 1, 20, dtype=torch.float64, device=device)
    for given in (fraction, 0.3):
        for found, expected in zip(motion.shortened(given).at(t), motion.at(t * given), strict=True):
            assert torch.allclose(found, expected, rtol=0, atol=1e-14)
    assert motion.shortened(0.25).rotation.equal(0.25 * motion.rotation)


def test_same_bits_where_gradients_are_wanted(device: torch.device) -> None:
    motion, fraction = rigid(device), torch.linspace(0, 1, 20, dtype=torch.float64, device=device)
    plain = motion.shortened(fraction)
    motion.position_t0.requires_grad_(True)
    shorter = motion.shortened(fraction)
    assert torch.equal(shorter.position_t1, plain.position_t1) and torch.equal(shorter.rotation, plain.rotation)
    (gradient,) = torch.autograd.grad(shorter.position_t1.sum(), motion.position_t0)
    assert torch.allclose(gradient, (1.0 - fraction)[:, None].expand(-1, 3), rtol=0, atol=1e-15)


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_all_and_nothing_of_a_path(path: str, device: torch.device) -> None:
    motion = rigid(device, path)
    motion.position_t1[0] = motion.position_t0[0] + torch.tensor(
        [1e-17, 1 / 3, 1e10], dtype=torch.float64, device=device
    )
    whole, none = motion.shortened(1.0), motion.shortened(torch.zeros(20, device=device))
    for name, column in motion.columns().items():
        assert torch.equal(whole.columns()[name], column)
    assert torch.equal(none.position_t1, motion.position_t0) and not bool(none.rotation.any())
    assert whole.path == none.path == path
    motion.position_t1[0] = motion.rotation[1] = torch.nan
    none = motion.shortened(0.0)
    assert torch.equal(none.position_t1, motion.position_t0) and not bool(none.rotation.any())


def test_straight_paths_of_poses_end_on_the_arc(device: torch.device) -> None:
    motion, arc = rigid(device, "linear"), rigid(device)
    shorter, (position, orientation) = motion.shortened(0.4), arc.at(0.4)
    turned = pgccd.integrate_orientation(shorter.orientation_t0, shorter.rotation)
    assert torch.allclose(shorter.position_t1, position, rtol=0, atol=1e-14)
    assert torch.allclose(turned, orientation, rtol=0, atol=1e-14)


def test_vertices(device: torch.device) -> None:
    start, end = torch.rand(2, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(device)
    motion, fraction = pgccd.VertexMotion(start, end), torch.linspace(0, 1, 9, dtype=torch.float64, device=device)
    shorter = motion.shortened(fraction)
    assert torch.allclose(shorter.x_t1, motion.at(fraction), rtol=0, atol=1e-15)
    assert torch.equal(shorter.x_t1[0], start[0]) and torch.equal(shorter.x_t1[-1], end[-1])


@pytest.mark.parametrize(
    ("fraction", "message"),
    [
        (1.5, r"fraction: expected times in \[0, 1\], got 1.5"),
        (torch.tensor([0.5] * 19 + [torch.nan]), "fraction: expected times"),
        (torch.ones(3), r"fraction: expected a number, \(20,\)"),
        (torch.ones(2, 20), r"fraction: expected a number or \(20,\), got \(2, 20\)"),
    ],
)
def test_wrong_fractions(fraction: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rigid(torch.device("cpu")).shortened(fraction)


def test_later_writes_are_checked(device: torch.device) -> None:
    shorter = rigid(device).shortened(0.5)
    shorter.rotation[3, 0] = torch.nan
    with pytest.raises(ValueError, match="rotation: body 3"):
        shorter.check()
