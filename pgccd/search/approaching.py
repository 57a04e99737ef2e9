"""The contacts that a solver must respond to."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import torch

from pgccd import arguments
from pgccd.contacts.approach import recede
from pgccd.contacts.contacts import Contacts, earliest_of_each
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search.detect import detect

C = TypeVar("C", bound=Contacts)


def approaching(
    scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: C, slack: float | None = None
) -> C:
    """The contacts that a solver must respond to: those whose surfaces may come closer after toi, by more than `slack`.
    Of report="first" the first such contact of each pair: pairs whose first contact rests, slides or recedes are
    searched again for later ones.

    Contacts are left out only where this is certain for the whole rest of the step, so none that approaches is; of
    bodies that turn some that do not may be left in. `UNRESOLVED` contacts and intersections (`EF_AB`, `EF_BA`) always
    stay in.

    Args:
        scene, motion: with which `detect` found the contacts, unchanged.
        hits: contacts of `detect` without a capacity, on the scene's device.
        slack: length >= 0. Default: the tolerance of the detection; if none was given 1e-6 of the smaller SBV radius of
            the meshes of each pair.

    Returns:
        Contacts, of a trajectory TrajectoryContacts. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if the report was "earliest", which leaves out the contacts of
            other pairs, or the contacts are those of a capacity, of ranks or from a state_dict.

    Example:
        >>> ahead = pgccd.approaching(scene, motion, hits)  # resting on a floor: the wall ahead
        >>> fraction = ahead.first_toi().clamp(max=1.0)
    """
    if isinstance(hits, Contacts) and hits._is_earliest:
        raise ValueError(
            'report: "earliest" leaves out the contacts of other pairs; ask for "first" or "all", and then for the '
            "earliest of those that approach"
        )
    options = hits._found_with if isinstance(hits, Contacts) else {}
    if options is None:
        raise ValueError(
            "hits: were not found by `detect` without a capacity, so they do not tell how to search for later ones"
        )
    slack = options.get("tolerance") if slack is None else arguments.length(slack, "slack")
    recedes = recede(scene, motion, hits, slack)
    kept = hits[~recedes]
    if options["report"] == "first" and len(kept) < len(hits):
        pairs = torch.unique(hits.pairs[recedes], dim=0)
        every: Any = detect(scene, motion, pairs=pairs, **(options | {"report": "all"}))
        later = every[~recede(scene, motion, every, slack)]
        _, owner = torch.unique(later.pairs, dim=0, return_inverse=True)
        kept = _joined(kept, later[earliest_of_each(owner, len(later), *later._order)])
    return replace(kept, stats=replace(kept.stats, contacts=len(kept)))


def _joined(one: C, other: C) -> C:
    """Contacts with one row for each pair, and others of other pairs, in the order of pairs."""
    both = type(one).cat([one, other])
    pairs = both.pairs
    order = torch.argsort(pairs[:, 0] * (pairs.amax() + 1 if len(pairs) else 1) + pairs[:, 1])
    return replace(both[order], stats=one.stats, _found_with=one._found_with)
