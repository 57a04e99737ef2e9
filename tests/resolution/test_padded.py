"""`pgccd.resolve` in a given capacity: the same bits, no synchronisation; fractions of incomplete results are 0."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from support.random_scenes import random_scene

import pgccd
from pgccd.runtime.graph import capture
from pgccd.runtime.sizes import BufferSizes

from .test_random_scenes import boxes, options_of, scenes
from .test_resolve import on_a_line

PLENTY = pgccd.Capacity.of(1000, self_vertex_count=500)
FIELDS = ("fraction", "stopped_by", "touching_at_start", "unresolved")


def assert_same(found: pgccd.Resolution[Any], expected: pgccd.Resolution[Any]) -> None:
    assert found.rounds == expected.rounds
    for name in FIELDS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    for name, column in expected.motion.columns().items():
        assert torch.equal(found.motion.columns()[name], column), name


def test_same_bits(device: torch.device) -> None:
    for made in scenes(40):
        scene, motion, options = made.scene(device), made.motion(device), options_of(made)
        movable = torch.arange(scene.body_count) % 3 != made.seed % 3
        padded = pgccd.resolve(scene, motion, movable, capacity=PLENTY, rounds=scene.body_count + 6, **options)
        assert not bool(padded.incomplete)
        assert_same(padded.trim(), pgccd.resolve(scene, motion, movable, **options))


def assert_nobody_moves(padded: pgccd.PaddedResolution[Any]) -> None:
    assert bool(padded.incomplete) and not bool(padded.fraction.any())
    assert bool((padded.stopped_by == -1).all())
    assert bool((padded.touching_at_start == -1).all()) and bool((padded.unresolved == -1).all())


def test_incomplete_results_move_nobody(device: torch.device) -> None:
    scene, motion = boxes(0, 64, 0.9, device)
    movable = torch.arange(64) % 5 > 0
    complete = pgccd.resolve(scene, motion, movable)
    assert 2 < complete.rounds < 30 and len(complete.unresolved) > 0
    for rounds in (1, complete.rounds - 1):
        padded = pgccd.resolve(scene, motion, movable, capacity=PLENTY, rounds=rounds)
        assert_nobody_moves(padded)
        assert torch.equal(padded.motion.position_t1, motion.position_t0) and not bool(padded.motion.rotation.any())
        with pytest.raises(RuntimeError, match=f"rounds: more than {rounds} are needed"):
            padded.trim()
    assert_same(pgccd.resolve(scene, motion, movable, capacity=PLENTY, rounds=complete.rounds).trim(), complete)
    ample = dict.fromkeys(("poses", "tasks", "leaf_pairs", "candidates", "open"), 9000)
    tight = BufferSizes(pairs=30, contacts=4096, overlaps=100, **ample)
    for capacity in (tight, BufferSizes(pairs=4096, contacts=20, overlaps=9000, **ample)):
        padded = pgccd.resolve(scene, motion, capacity=capacity)
        assert_nobody_moves(padded)
        with pytest.raises(pgccd.CapacityError) as raised:
            padded.trim()
        needed = raised.value.needed
        assert needed.pairs > capacity.pairs or needed.contacts > capacity.contacts
    motion.position_t1[3, 1] = torch.inf
    padded = pgccd.resolve(scene, motion, capacity=PLENTY)
    assert_nobody_moves(padded)
    assert torch.equal(padded.motion.position_t1, motion.position_t0)
    with pytest.raises(ValueError, match="position_t1: body 3"):
        padded.trim()


def test_a_round_that_alone_exceeds_its_capacity(device: torch.device) -> None:
    """Two bodies that follow a third one run into it where it stops."""
    scene, motion = on_a_line(device, [0.0, 0.0, 2.0, 3.2], [1.6, 1.6, 1.6, 0.0])
    for column in (motion.position_t0, motion.position_t1):
        column[:2, 1] += torch.tensor([0.6, -0.6], device=device)
    assert len(pgccd.detect(scene, motion, nonzero_toi=True)) == 1
    for contacts in (1, 2):
        padded = pgccd.resolve(scene, motion, capacity=BufferSizes(**(vars(PLENTY) | {"contacts": contacts})))
        if contacts == 1:
            assert_nobody_moves(padded)
            with pytest.raises(pgccd.CapacityError, match="contacts: 2 in 1"):
                padded.trim()
        else:
            assert_same(padded.trim(), pgccd.resolve(scene, motion))


@pytest.mark.cuda
@pytest.mark.parametrize("seed", [0, 11, 23])
def test_in_a_graph(seed: int) -> None:
    device = torch.device("cuda")
    made = next(s for s in map(random_scene, range(seed, seed + 50)) if s.kind in ("rigid", "deforming"))
    scene, motion = made.scene(device), made.motion(device)
    resolve = lambda: pgccd.resolve(scene, motion, capacity=PLENTY, rounds=20)  # noqa: E731
    graph, padded = capture(resolve, device)
    for scale in (1.0, 0.5, 0.0):
        for name in ("position_t1", "x_t1"):
            if name in motion.columns():
                begin = motion.columns()[name.replace("1", "0")]
                motion.columns()[name].copy_(begin + scale * (motion.columns()[name] - begin))
        graph.replay()
        assert_same(padded.trim(), pgccd.resolve(scene, motion))


@pytest.mark.cuda
def test_capacities_are_learnt() -> None:
    """On a GPU the first calls repeat rounds in larger capacities; the result is that of a CPU."""
    for seed in range(3):
        scene, motion = boxes(seed, 1000, 1.0, torch.device("cuda"))
        expected = pgccd.resolve(scene.to("cpu"), motion.to("cpu"))
        for _ in range(3):
            found = pgccd.resolve(scene, motion)
            for name in FIELDS:
                assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
            assert found.rounds == expected.rounds
