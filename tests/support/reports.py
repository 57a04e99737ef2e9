"""Every report by one call: those of `pgccd.detect`, and "any" for the pairs of `pgccd.collide`."""

from __future__ import annotations

from typing import Any

import pgccd
from pgccd.distributed import World

# Options of `detect` that `collide` does not have.
_OF_CONTACTS = ("nonzero_toi", "normals")


def detected(scene: pgccd.Scene, motion: Any, report: str = "first", *separation: Any, **options: Any) -> Any:
    """`pgccd.detect`, or for "any" `pgccd.collide`, without the options that it does not have."""
    if report == "any":
        return pgccd.collide(scene, motion, *separation, **_of_pairs(options))
    given: Any = report
    return pgccd.detect(scene, motion, given, *separation, **options)


def captured_loop(scene: pgccd.Scene, motion: Any, report: str = "first", *separation: Any, **options: Any) -> Any:
    """`pgccd.CapturedDetection`, or for "any" `pgccd.CapturedCollision`."""
    if report == "any":
        return pgccd.CapturedCollision(scene, motion, *separation, **_of_pairs(options))
    given: Any = report
    return pgccd.CapturedDetection(scene, motion, given, *separation, **options)


def trimmed(loop: pgccd.CapturedDetection | pgccd.CapturedCollision) -> Any:
    """What a captured loop found in its last call."""
    return loop.pairs() if isinstance(loop, pgccd.CapturedCollision) else loop.contacts()


def of_contacts(report: str) -> Any:
    """The report of a `World` that is asked for this one by `step`."""
    return "first" if report == "any" else report


def stepped(world: World, motion: Any, report: str, **options: Any) -> Any:
    """`World.step`, or for "any" `World.collide`."""
    return world.collide(motion, **options) if report == "any" else world.step(motion, **options)


def _of_pairs(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name not in _OF_CONTACTS}
