"""Every example and every Python block of the pages runs as written; bodies of their loops never overlap."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from support.documents import EXAMPLES, PAGES, ROOT, blocks, check_loop, run_document, steps_recorded

import pgccd

#: Documents with a loop that moves bodies: the name of their mesh, a box, and the number of motions before the loop.
LOOPS = {
    "README.md": ("box", 1),
    "cluster.md": ("rock", 0),
    "02_simulation_loop.py": ("box", 0),
    "04_many_ranks.py": ("box", 0),
}


@pytest.mark.parametrize("path", [*PAGES, *EXAMPLES], ids=lambda path: path.name)
def test_documents(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("trimesh")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    torch.manual_seed(0)
    with steps_recorded() as steps:
        names = run_document(path)
    assert path not in EXAMPLES or capsys.readouterr().out.count("\n") in (1, 2, 4, 20)
    assert (path.name in LOOPS) == (len(steps) > 1), "LOOPS: it has a loop that moves bodies, or none"
    if path.name in LOOPS:
        mesh, before = LOOPS[path.name]
        check_loop(steps[before:], names, names[mesh])


def test_all_pages_are_found() -> None:
    assert {page.name for page in PAGES} >= {"README.md", "cluster.md"} and len(EXAMPLES) >= 5
    assert sum(len(blocks(page)) for page in PAGES) >= 6


def test_readme_with_contacts_and_without() -> None:
    pytest.importorskip("trimesh")
    for spacing in ("2.1", "210.0"):
        names: dict[str, object] = {}
        torch.manual_seed(0)
        for block in blocks(ROOT / "README.md"):
            exec(block.replace("2.1 *", f"{spacing} *"), names)
        hits, contacts = names["hits"], names["contacts"]
        assert isinstance(hits, pgccd.detection.contacts.PaddedContacts) and isinstance(contacts, pgccd.Contacts)
        assert torch.equal(contacts.toi, hits.trim().toi)
        assert (len(contacts) > 0) == (spacing == "2.1")
