"""The contacts that a solver must respond to."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self, cast

import torch
from torch import Tensor

if TYPE_CHECKING:
    from pgccd.contacts.approach import Cause
    from pgccd.contacts.contacts import Contacts


class WithApproach:
    """What contacts say of their rest of the step, from what they were found with."""

    @property
    def approach(self) -> Tensor:
        """(K,) float64: the rate at which the gap between the nearest points closes at toi, along `normal`, in the
        scene's length units per step (of a trajectory, per segment); divided by the duration of the step it is the
        normal approach velocity. Negative: they recede. 0: they rest or slide. Has gradients if toi has.

        Where features touch exactly, their normal may point to the wrong side on bodies that are not convex, unless
        `detect` was given normals="surface". If toi > 0 the rate is positive nevertheless: they were apart before. At
        t = 0 it has the sign that the normal gives; `approaching` does not depend on it.

        Raises:
            ValueError: the contacts are those of a given capacity, of ranks, from a state_dict or on another device.
            RuntimeError: columns of the motion have been written since.

        Example:
            >>> speed = hits.approach.clamp(min=0.0) / dt
        """
        contacts = cast("Contacts", self)
        return _known_cause(contacts).rate(contacts, contacts._moving_bodies)

    def approaching(self, slack: float | None = None) -> Self:
        """The contacts that a solver must respond to: those whose surfaces may come closer after toi, by more than
        `slack`. Of report="first" the first such contact of each pair: pairs whose first contact rests, slides or
        recedes are searched again for later ones. Synchronises with a GPU.

        Contacts are left out only where this is certain for the whole rest of the step, so none that approaches is; of
        bodies that turn some that do not may be left in. `UNRESOLVED` contacts and intersections (`EF_AB`, `EF_BA`)
        always stay in.

        Args:
            slack: length >= 0. Default: the tolerance of the detection; if none was given 1e-6 of the smaller SBV
                radius of the meshes of each pair.

        Raises:
            ValueError: the report was "earliest", which leaves out the contacts of other pairs; `slack` is not such a
                length; or as for `approach`.
            RuntimeError: as for `approach`.

        Example:
            >>> hits = pgccd.detect(scene, motion).approaching()  # resting on a floor: the wall ahead
            >>> fraction = hits.first_toi().clamp(max=1.0)
        """
        contacts = cast("Contacts", self)
        if contacts._is_earliest:
            raise ValueError(
                'report: "earliest" leaves out the contacts of other pairs; ask for "first" or "all", and then for '
                "hits.approaching().earliest()"
            )
        cause = _known_cause(contacts)
        recedes = cause.recedes(contacts, contacts._moving_bodies, slack)
        kept = contacts[~recedes]
        if cause.is_first and len(kept) < len(contacts):
            kept = _joined(kept, cause.again(contacts.pairs[recedes], slack))
        kept.stats = replace(kept.stats, contacts=len(kept))
        return cast("Self", kept)


def _known_cause(contacts: Contacts) -> Cause:
    if contacts._cause is None:
        raise ValueError(
            "hits: the approach of contacts is known of those that `detect` returns without a capacity, not of "
            "contacts of ranks or from a state_dict"
        )
    if contacts.toi.device != contacts._cause.scene.device:
        raise ValueError(
            f"hits: are on {contacts.toi.device}, but the scene on {contacts._cause.scene.device}: ask for their "
            "approach before `to`"
        )
    return contacts._cause


def _joined(one: Contacts, other: Contacts) -> Contacts:
    """Contacts with one row for each pair, and others of other pairs, in the order of pairs."""
    pairs = torch.cat([one.pairs, other.pairs])
    order = torch.argsort(pairs[:, 0] * (pairs.amax() + 1 if len(pairs) else 1) + pairs[:, 1])
    columns: dict[str, Any] = {
        name: torch.cat([column, getattr(other, name)])[order] for name, column in one.columns.items()
    }
    joined = replace(one, **columns)
    if one._differentiable is not None:
        joined._differentiable = torch.cat([one.differentiable, other.differentiable])[order]
    return joined
