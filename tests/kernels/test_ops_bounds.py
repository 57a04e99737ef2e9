"""Operators called directly with nonsensical arguments: an error or a result, never an out-of-bounds access.

Run in a separate process, so that a crash is a test failure.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from support.forked_job import ForkedJob
from support.steps import step_of

# Operator, argument (and list element), name in the error message: indices that must be validated.
INDICES = [
    ("prepare_mesh", (1,), "faces"),
    ("refit", (1,), "mesh_index"),
    ("refit", (4,), "vertex_begin"),
    ("refit", (5,), "block_begin"),
    ("moving_boxes_rigid", (1, 0), "mesh"),
    ("moving_boxes_deforming", (1, 0), "mesh"),
    ("moving_boxes_deforming", (1, 8), "vertices"),
    ("moving_boxes_deforming", (1, 9), "node blocks"),
    ("traverse_rigid", (1, 0), "mesh"),
    ("traverse_rigid", (3,), "pairs"),
    ("traverse_deforming", (1, 0), "mesh"),
    ("traverse_deforming", (1, 8), "vertices"),
    ("traverse_deforming", (1, 9), "node blocks"),
    ("traverse_deforming", (2,), "pairs"),
    ("narrow_rigid", (1, 0), "candidates"),
    ("narrow_rigid", (3,), "candidates"),
    ("narrow_rigid", (4,), "candidates"),
    ("narrow_deforming", (3,), "candidates"),
    ("contacts_padded_rigid", (1, 0), "mesh"),
    ("contacts_padded_rigid", (3,), "pairs"),
    ("detect_rigid", (1, 0), "mesh"),
    ("lower_first_toi_rigid", (1,), "owners"),
    ("lower_first_toi_rigid", (5,), "pairs"),
    ("certify_paths", (1, 0), "arm.joints"),
    ("certify_paths", (1, 3), "arm.chain_begin"),
    ("certify_paths", (1, 4), "arm.chain"),
    ("certify_paths", (2, 0), "bodies.mesh_index"),
    ("certify_paths", (2, 3), "bodies.pairs"),
    ("arm_poses", (0, 4), "arm.chain"),
    ("arm_arcs", (0, 4), "arm.chain"),
    ("take_rows", (2,), "rows"),
    ("replica_ranks", (4,), "owner"),
    ("replica_ranks", (6,), "bodies"),
    ("reached_ranks", (4,), "owner"),
    ("reached_ranks", (6,), "bodies"),
    ("reached_ranks", (7,), "begin"),
    ("meeting_pairs", (0,), "pairs"),
    ("owned_pairs", (0,), "pairs"),
    ("owned_pairs", (1,), "rows"),
    ("leaving_bodies", (2,), "owner"),
    ("resolve_first_toi", (1,), "pairs"),
    ("resolve_pairs", (4,), "pairs"),
    ("simulate_tally", (3,), "pairs"),
    ("voxels_touched", (1, 0), "mesh"),
    ("voxel_boxes", (1, 0), "mesh"),
    ("voxel_boxes", (6,), "voxels"),
    ("voxel_boxes", (7,), "counts"),
    ("voxel_pairs", (1,), "segments"),
    ("voxel_pairs", (3,), "first_segment"),
    *((name, (0, 8), "mesh_set.offsets") for name in ("refit", "traverse_rigid", "narrow_deforming")),
]
LENGTHS = ("broad_pairs", "pairs_padded", "swept_boxes", "boundary_bodies", "near_ghosts", "owned_pairs")
LENGTHS += (
    "meeting_pairs",
    "replica_ranks",
    "traverse_rigid",
    "narrow_rigid",
    "contacts_padded_rigid",
    "lower_first_toi_rigid",
)
LENGTHS += ("detect_rigid", "reached_ranks", "vertex_face", "edge_edge", "voxels_touched", "voxel_boxes")


@functools.cache
def calls() -> dict[str, tuple[Any, ...]]:
    """The call with the most data, for each operator."""
    from kernels.test_ops import Recorder, recorded
    from pgccd import ops, sim

    every = recorded(torch.device("cpu"))
    recorder = Recorder(ops.library.operators)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops.library, "operators", recorder)
        model = sim.Model(sim.ModelConfig(robots=60, speed=0.4))
        state = model.start()
        for index in range(6):
            state = step_of(model, state, index).after
        ops.simulate_hash([state.id, state.position])
        ops.random_uniforms(state.id, 1, 2, 3)
        plan = state.velocity, state.angular_velocity, state.target, state.stay_until
        columns = [column.clone() for column in state.columns.values()]
        ops.simulate_commit(columns, plan, torch.ones(60).double(), torch.zeros(1, dtype=torch.int64))
    most: dict[str, tuple[tuple[int, int], tuple[Any, ...]]] = {}
    for name, arguments in every + recorder.calls:
        tensors = [a for a in torch.utils._pytree.tree_leaves(arguments) if isinstance(a, torch.Tensor)]
        if any(t.shape == (7,) and t.dtype == torch.int64 and t[3] == 0 for t in tensors):
            continue  # no pairs
        if name == "detect_rigid" and torch.ops.pgccd.detect_rigid(*arguments)[-1][3] == 0:
            continue  # likewise
        size = -sum(t.numel() == 0 for t in tensors), sum(t.numel() for t in tensors)
        if name not in most or size > most[name][0]:
            most[name] = size, arguments
    return {name: arguments for name, (_, arguments) in most.items()}


def attempt(name: str, arguments: tuple[Any, ...]) -> str | None:
    """The error raised by a call on copies of the arguments, or None."""
    copies = torch.utils._pytree.tree_map_only(torch.Tensor, torch.clone, arguments)
    sys.stderr.write(f"{name}\n")
    try:
        getattr(torch.ops.pgccd, name)(*copies)
    except (RuntimeError, IndexError, TypeError, ValueError) as error:
        return str(error)
    return None


def with_changed(arguments: tuple[Any, ...], at: tuple[int, ...], value: Any) -> tuple[Any, ...]:
    changed = list(arguments)
    if len(at) == 2:
        changed[at[0]] = list(changed[at[0]])
        changed[at[0]][at[1]] = value
    else:
        changed[at[0]] = value
    return tuple(changed)


def replacements(value: Any) -> Iterator[Any]:
    """Replacements for one argument: other types, shapes, dtypes and numbers."""
    if isinstance(value, torch.Tensor):
        yield from (value[:0], value.reshape(-1)[:0], value.reshape(-1), value.unsqueeze(0), value[:-1])
        yield torch.cat([value, value])
        yield value.to(torch.float32 if value.dtype == torch.float64 else torch.float64)
        yield torch.empty((), dtype=value.dtype)
        if value.is_floating_point():
            yield from (
                torch.full_like(value, x) for x in (-1.0, 0.0)
            )  # other values cause long searches without result
        elif value.dtype != torch.bool:
            info = torch.iinfo(value.dtype)
            yield from (torch.full_like(value, x) for x in (info.min, info.max, 2, info.max // 2, 100))
            yield from (torch.full_like(value, x) for x in (-1, -2) if info.min < 0)
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, float):
        yield from (float("nan"), float("inf"), -1.0, -2.0, 1e300)
    elif isinstance(value, int):
        yield from (-1, -(2**40), 2**62)
    elif isinstance(value, list):
        yield from ([], value[:-1], [*value, *value[:1]])


def change_everything() -> None:
    """Changes each argument of each operator, and each element of lists."""
    for name, arguments in calls().items():
        schema = getattr(torch.ops.pgccd, name).default._schema.arguments
        for k, value in enumerate(arguments):
            for other in replacements(value):
                attempt(name, with_changed(arguments, (k,), other))
            for m, element in enumerate(value if isinstance(value, list) else []):
                # Mesh sets, incidence and node blocks come from the package: only shapes and offsets are validated.
                is_blocks = isinstance(element, torch.Tensor) and element.dtype == torch.float32
                is_content = is_blocks or schema[k].name == "incidence" or (schema[k].name == "mesh_set" and m != 8)
                for other in replacements(element):
                    is_same_shape = isinstance(other, torch.Tensor) and other.shape == element.shape
                    if is_content and is_same_shape and other.dtype == element.dtype:
                        continue
                    attempt(name, with_changed(arguments, (k, m), other))


def change_indices() -> None:
    """Errors name the argument whose indices are out of range or whose length is zero."""
    known = calls()
    wrong = []
    for name, at, named in INDICES:
        value = known[name][at[0]] if len(at) == 1 else known[name][at[0]][at[1]]
        if value.numel() == 0:
            value = value.new_empty((2, *value.shape[1:]))
        for number in (torch.iinfo(value.dtype).max, 2**30):
            error = attempt(name, with_changed(known[name], at, torch.full_like(value, number)))
            if error is None or named not in error:
                wrong.append((name, at, number, error))
    for name in LENGTHS:
        schema = getattr(torch.ops.pgccd, name).default._schema.arguments
        for k, argument in enumerate(schema):
            if argument.name in ("min_separation", "tolerance"):
                for number in (float("nan"), -2.0, 1e200):
                    error = attempt(name, with_changed(known[name], (k,), number))
                    if error is None or argument.name not in error:
                        wrong.append((name, argument.name, number, error))
    assert wrong == [], wrong


def change_all() -> None:
    change_everything()
    change_indices()


def test_in_a_process_of_its_own(tmp_path: Path) -> None:
    with ForkedJob(1, tmp_path, change_all) as job:
        assert job.finish(280.0) == [0], job.said[-2000:]
