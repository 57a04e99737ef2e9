"""Comparison of calls on scenes: what differs, and what takes too long."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from support import calls
from support.calls import CALLS, COPIES, Columns, Given
from support.random_scenes import RandomScene
from support.same_bits import difference
from support.ways import THREADS, Difference, threads_set

# Processor seconds of a call that are not a fault: of any scene, and of each face of its bodies.
_SECONDS, _SECONDS_OF_FACE = 10.0, 5e-3
# Of errors that scenes cause: not every one has only watertight bodies.
_EXPECTED = ("watertight",)
Announce = Callable[[str], None]


@dataclass
class Timed:
    """What a comparison of a call took."""

    call: str
    seconds: float
    difference: Difference | None = None


def limit(scene: RandomScene) -> float:
    """Seconds that a call on a scene may take."""
    faces = [len(mesh.faces) for mesh in scene.meshes]
    return _SECONDS + _SECONDS_OF_FACE * sum(faces[k] for k in scene.mesh_index.tolist())


def compared(scene: RandomScene, device: str, announce: Announce = lambda call: None) -> Iterator[Timed]:
    """Every call on the CPU in one thread, compared with the device; without one with several threads, with copies of
    scene and motion, and with all bodies in two worlds.
    """
    given = Given.of(scene)
    other = given if device == "cpu" else Given.of(scene, device)
    allowed = limit(scene)
    for number, name in enumerate(CALLS):
        if not CALLS[name][1](given):
            continue
        announce(f"{name}, cpu")
        with threads_set(1):
            seconds, expected = _timed(name, given)
        said = _error(expected) or _late(seconds, allowed)
        yield Timed(name, seconds, None if said is None else Difference(scene, f"{name}, cpu", said))
        copied = list(COPIES)[(scene.seed + number) % len(COPIES)]
        # On the CPU calls take turns: of neighbouring seeds each call is made in every way.
        turn, ways = (scene.seed // 2 + number) % 3, dict[str, Callable[[], Given]]()
        if turn == 0:
            ways[f"copy by {copied}, {device}"] = lambda copied=copied: other.copied(COPIES[copied])  # type: ignore[misc]
        if device != "cpu":
            ways[device] = lambda: other
        elif turn == 1:
            ways[f"{THREADS} threads"] = lambda: given
        elif turn == 2 and calls.is_by_world(name):
            ways["two worlds"] = lambda: Given.of(calls.twofold(scene))
        for way, make in ways.items():
            announce(f"{name}, {way}")
            try:
                again = make()
            except Exception as error:
                yield Timed(name, 0.0, Difference(scene, f"{name}, {way}", f"{type(error).__name__}: {error}"))
                continue
            with threads_set(THREADS if way.endswith("threads") else 1):
                more, found = _timed(name, again)
            wanted = expected
            if way == "two worlds" and isinstance(found, dict) and isinstance(expected, dict):
                found = calls.of_second_world(name, found, len(scene.mesh_index))
                wanted = {key: expected[key] for key in found}
            said = _said(found, wanted) or _late(more, allowed)
            yield Timed(name, more, None if said is None else Difference(scene, f"{name}, {way}", said))


def _late(seconds: float, allowed: float) -> str | None:
    return f"took {seconds:.0f} s, expected at most {allowed:.0f}" if seconds > allowed else None


def _error(found: Columns | str) -> str | None:
    """An error that no scene should cause."""
    return found if isinstance(found, str) and not any(part in found for part in _EXPECTED) else None


def _timed(name: str, given: Given) -> tuple[float, Columns | str]:
    began, wall = time.process_time(), time.perf_counter()
    found = calls.made(name, given)
    # A host that waits for a device uses no processor time, or all of it.
    seconds = time.process_time() - began if given.device == "cpu" else time.perf_counter() - wall
    return seconds, found


def _said(found: Columns | str, expected: Columns | str) -> str | None:
    if isinstance(found, str) or isinstance(expected, str):
        return None if found == expected else f"{_short(found)}, expected {_short(expected)}"
    gradients = {key for key in expected if key.startswith("gradient ")}
    apart = {*gradients, "turn"}
    plain = [{key: column for key, column in each.items() if key not in apart} for each in (found, expected)]
    said = difference(*plain)
    if said is None and found.keys() == expected.keys():
        for key in gradients:
            bound = calls.OF_GRADIENTS * (1.0 + float(expected["turn"]))
            said = said or _said_of_gradient(key, found[key], expected[key], bound)
    return said


def _said_of_gradient(name: str, found: Tensor, expected: Tensor, bound: float) -> str | None:
    if found.shape != expected.shape:
        return f"{name}: {tuple(found.shape)}, expected {tuple(expected.shape)}"
    if not expected.numel():
        return None
    error = float((found - expected).abs().max() / expected.abs().max().clamp(min=torch.finfo(torch.float64).tiny))
    return None if error <= bound else f"{name}: differs by {error:.1e} of its largest entry"


def _short(found: Columns | str) -> str:
    return found if isinstance(found, str) else "a result"
