"""The loops of examples and pages on several ranks: the same bits as on one, also as replays of a graph."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from pathlib import Path
from unittest import mock

import pytest
import torch
from support.documents import ROOT, run_document
from support.graphs import graphs_on
from support.ranks import RankPool, to_all

from pgccd import distributed
from pgccd.distributed import Alone, Comm
from pgccd.distributed.world import loop as captured_world

PAGE = ROOT / "docs" / "how-to" / "cluster.md"
EXAMPLES = [ROOT / "examples" / "04_many_ranks.py", ROOT / "examples" / "08_impulses.py"]
DOCUMENTS = [*(pytest.param(path, marks=pytest.mark.slow) for path in EXAMPLES), PAGE]
Rows = list[list[float]]


def follow(comm: Comm, document: Path, folder: str, graph: bool = False, device: str = "cpu") -> tuple[Rows, int]:
    """Runs a document on this rank. Returns ids, poses and velocities of all bodies, and the number of replays."""
    with graphs_on(device if graph else "none") as stack:
        stack.callback(os.chdir, Path.cwd())
        os.chdir(folder)
        stack.enter_context(mock.patch.object(distributed, "connect", lambda _: comm))
        stack.enter_context(mock.patch.object(comm, "close"))
        # The example starts ranks if no launcher has.
        stack.enter_context(mock.patch.object(distributed, "find_placement", lambda: mock.Mock(launcher="tests")))
        stack.enter_context(mock.patch.object(captured_world, "can_replay", lambda *_: graph))
        stack.enter_context(mock.patch.object(sys, "argv", [document.name, device]))
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        old, new = ('name = "cpu"', f'name = "{device}"') if document == PAGE else ("", "")
        names = run_document(document, old, new)
    world = names["world"]
    columns = [world.id[:, None], world.position, *(world.payload[name] for name in sorted(world.payload))]
    rows = torch.cat([column.double().view(len(world.id), -1) for column in columns], dim=1).tolist()
    return sorted(sum(to_all(comm, rows), [])), sum(step.replayed for step in names.get("steps", []))


def test_on_one_device(device: torch.device, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    expected, _ = follow(Alone(), PAGE, str(tmp_path))
    found, replayed = follow(Alone(), PAGE, str(tmp_path), True, str(device))
    assert found == expected and replayed > 10


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_on_two_ranks(ranks: RankPool, document: Path, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    expected, _ = ranks.run(1, follow, document, str(tmp_path))[0]
    found, replayed = ranks.run(2, follow, document, str(tmp_path), document == PAGE)[0]
    assert found == expected and (replayed > 10) == (document == PAGE)
