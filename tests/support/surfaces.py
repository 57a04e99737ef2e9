"""Normals of surfaces at contacts made by hand."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import pgccd
from pgccd import ops
from pgccd.contacts.contacts import Stats
from pgccd.contacts.operands import operands


def contacts_at(bodies: Tensor, **columns: Any) -> pgccd.Contacts:
    """Contacts of bodies (K, 2), with kind, features, coordinates, toi, point and normal."""
    status = torch.full_like(columns["kind"], pgccd.Status.TOUCH)
    return pgccd.Contacts(pairs=bodies, status=status, stats=Stats(), **columns)


def surface_normals(scene: pgccd.Scene, motion: Any, hits: pgccd.Contacts) -> Tensor:
    """(K, 3), on the CPU."""
    return ops.surface_normals(*operands(scene, motion, hits.pairs, hits)).cpu()
