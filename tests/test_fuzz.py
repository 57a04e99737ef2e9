"""The fuzzer: a short run, that it sees a difference of one bit, and that scenes are of every kind."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import fuzz
import pytest
import torch
from support.random_scenes import KINDS, LAYOUTS, random_scene
from support.same_bits import COLUMNS
from support.ways import differences, reference

import pgccd
from pgccd.detection import pipeline

# Of some contacts, found in several chunks if memory is limited.
SEED = 53


def test_every_way_gives_the_same_bits(device: torch.device) -> None:
    scenes = [random_scene(seed) for seed in range(12 if device.type == "cpu" else 100)]
    assert not list(map(str, differences(scenes, dict.fromkeys(("cpu", device.type)), None, 0)))


@pytest.mark.parametrize("column", COLUMNS)
def test_one_bit_is_seen(column: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    stream = pipeline.stream

    def inexact(*arguments: Any) -> Any:
        found = stream(*arguments)
        values = getattr(found, column)
        values.view(-1).view(torch.uint8)[0] ^= 1
        return found

    monkeypatch.setattr(pipeline, "stream", inexact)
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
