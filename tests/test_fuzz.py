"""The fuzzer: a short run, that it sees a difference of one bit, and that scenes are of every kind."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import fuzz
import pytest
import torch
from support import calls, watched
from support.hard_scenes import HARD_LAYOUTS, hard_scene
from support.random_scenes import KINDS, LAYOUTS, random_scene
from support.same_bits import COLUMNS
from support.ways import reference

import pgccd
from pgccd.search import detect as pipeline

# Of some contacts, found in several chunks if memory is limited.
SEED = 53


def test_every_call_gives_the_same_bits(device: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    assert fuzz.main(["--scenes", "2", "--seed", "13", "--device", device.type]) == 0, capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_many_scenes(device: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--scenes", "1000", "--jobs", str(os.cpu_count()), "--device", device.type]
    assert fuzz.main(given) == 0, capsys.readouterr().out


def test_slow_calls_and_errors_are_differences(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(given: Any) -> Any:
        raise ValueError("broken")

    monkeypatch.setattr(calls, "CALLS", {name: calls.CALLS[name] for name in ("detect first", "enclosed")})
    monkeypatch.setattr(watched, "CALLS", calls.CALLS)
    monkeypatch.setattr(watched, "limit", lambda scene: -1.0)
    calls.CALLS["enclosed"] = (fails, calls.CALLS["enclosed"][1])
    assert fuzz.main(["--only", str(SEED)]) == 1
    said = capsys.readouterr().out
    assert "detect first, cpu: took 0 s" in said and "enclosed, cpu: ValueError: broken" in said


def test_hard_scenes_hold_what_they_say() -> None:
    whole = {"report": "all", "initial": "report"}
    scenes = [hard_scene(seed) for seed in range(0, 24, 2)]
    assert {scene.layout for scene in scenes} == set(HARD_LAYOUTS)
    found = {}
    for scene in scenes:
        hits = reference(replace(scene, arguments=scene.arguments | whole, exclude=None, filters={}))
        found.setdefault(scene.layout, []).append(hits)
    crossing = max(found["crossing"], key=len)
    at_start = crossing[(crossing.kind >= pgccd.Kind.EF_AB) & (crossing.toi == 0.0)]
    assert int(torch.unique(at_start.pairs, dim=0, return_counts=True)[1].max()) > 200
    assert len(scenes[0].mesh_index) >= 30
    ties = max(found["tied"], key=len)
    assert len(ties) > 100 and len(torch.unique(ties.toi)) < len(ties) / 10
    assert all(any(len(hits) for hits in found[layout]) for layout in HARD_LAYOUTS)


@pytest.mark.parametrize("column", COLUMNS)
def test_one_bit_is_seen(column: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    stream = pipeline.stream

    def inexact(*arguments: Any) -> Any:
        found = stream(*arguments)
        values = getattr(found, column)
        values.view(-1).view(torch.uint8)[0] ^= 1
        return found

    monkeypatch.setattr(pipeline, "stream", inexact)
    monkeypatch.setattr(watched, "CALLS", {})  # the ways to detect suffice
    assert fuzz.main(["--only", str(SEED)]) == 1
    said = capsys.readouterr().out
    assert f"{column}: 1 of" in said and "chunks of 1 bytes, cpu" in said and f"--only {SEED}" in said


def test_scenes_are_of_every_kind() -> None:
    scenes = [random_scene(seed) for seed in range(60)]
    assert {scene.layout for scene in scenes} == set(LAYOUTS) and {scene.kind for scene in scenes} == set(KINDS)
    found = [reference(scene) for scene in scenes]
    assert sum(len(hits) > 0 for hits in found) > 30
    assert sum(bool((hits.toi == 0.0).any()) for hits in found if isinstance(hits, pgccd.Contacts)) > 10
    assert sum(bool((hits.toi > 0.0).any()) for hits in found if isinstance(hits, pgccd.Contacts)) > 10
    excluding = [(scene, hits) for scene, hits in zip(scenes, found, strict=True) if scene.exclude is not None]
    assert {scene.kind for scene, _ in excluding} == set(KINDS)
    without = [replace(scene, exclude=None) for scene, _ in excluding]
    fewer = [len(hits) < len(reference(whole)) for whole, (_, hits) in zip(without, excluding, strict=True)]
    assert sum(fewer) > 5 and any(len(hits) for _, hits in excluding)
    assert any(str(scene) == str(random_scene(scene.seed)) for scene in scenes)
