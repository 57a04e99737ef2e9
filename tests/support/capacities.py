"""Sizes of buffers that a test makes too small, on each device."""

from __future__ import annotations

from dataclasses import fields

import pytest

from pgccd.runtime.sizes import BufferSizes

PARTS = [field.name for field in fields(BufferSizes) if field.type == "int" and field.name != "launches"]
#: A CPU allocates as much as it needs of the others.
PARTS_ON_CPU = ("pairs", "contacts")
#: For parametrize(("device", "part"), DEVICES_AND_PARTS, indirect=["device"]).
DEVICES_AND_PARTS = [
    *(("cpu", part) for part in PARTS_ON_CPU),
    *(pytest.param("cuda", part, marks=pytest.mark.cuda) for part in PARTS),
]
#: For parametrize("device", ON_GPU, indirect=True).
ON_GPU = [pytest.param("cuda", marks=pytest.mark.cuda)]
