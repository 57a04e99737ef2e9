"""Every example and every Python block of the pages runs as written; bodies of their loops never overlap."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest import mock

import pytest
import torch
from support.cases import mostly_slow
from support.comments import run_checked
from support.documents import (
    CHECKED_BY_THEMSELVES,
    EXAMPLES,
    LOOPS,
    PAGES,
    ROOT,
    blocks,
    check_convex,
    check_loop,
    run_document,
    steps_recorded,
)

from pgccd import distributed

DOCUMENTS = {path.name: path for path in (*PAGES, *EXAMPLES)}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The working directory, without arguments of a command line; random numbers are the same in every run."""
    pytest.importorskip("trimesh")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["example.py"])
    # Figures are drawn, and not shown.
    monkeypatch.setenv("MPLBACKEND", "agg")
    # Pages are made, and neither written nor opened.
    monkeypatch.setattr("pgccd.viz.display._is_in_notebook", lambda: True)
    # Examples that start ranks of their own import the package from here too.
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    torch.manual_seed(0)


# They start themselves again on four ranks; `tests/distributed/world/test_loops.py` runs them on two.
ON_MANY_RANKS = ("04_many_ranks.py", "08_impulses.py")
# `tests/resolution/test_cloth.py` runs it.
RUN_ELSEWHERE = ("13_cloth_that_drapes.py",)


@pytest.mark.parametrize("name", mostly_slow(DOCUMENTS, set(DOCUMENTS) - {*ON_MANY_RANKS, *RUN_ELSEWHERE}))
def test_documents(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    check_document(name, capsys, monkeypatch)


@pytest.mark.parametrize("name", ON_MANY_RANKS)
def test_examples_on_one_rank(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Without their last part, which starts ranks."""
    monkeypatch.setattr(distributed, "find_placement", lambda: mock.Mock(launcher="tests"))
    check_document(name, capsys, monkeypatch)


def check_document(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs a document and checks the steps of its loops."""
    if any("load_urdf(" in block for block in blocks(DOCUMENTS[name])):
        pytest.importorskip("yourdfpy")
    if any("import mujoco" in block for block in blocks(DOCUMENTS[name])):
        pytest.importorskip("mujoco")
    monkeypatch.setattr(sys, "argv", [str(DOCUMENTS[name])])
    with steps_recorded() as steps:
        names = run_document(DOCUMENTS[name])
    assert name.endswith(".md") or capsys.readouterr().out
    assert (name in LOOPS or name in CHECKED_BY_THEMSELVES) == (len(steps) > 1), (
        "LOOPS: it has a loop that moves bodies, or none"
    )
    if name in LOOPS:
        check_loop(name, steps, names)
    if name == "08_impulses.py":
        assert check_convex(steps[:20], names) > 1_000


@pytest.mark.cuda
@pytest.mark.parametrize("name", sorted(name for name in (*LOOPS, *CHECKED_BY_THEMSELVES) if name.endswith(".py")))
def test_examples_on_a_gpu(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, "cuda"])
    with steps_recorded() as steps:
        names = run_document(DOCUMENTS[name])
    assert steps[0].device.type == "cuda"
    if name in LOOPS:
        check_loop(name, steps, names)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_loops_go_on(name: str) -> None:
    with steps_recorded() as steps:
        names = run_document(DOCUMENTS[name], "range(5)" if name == "see_a_scene.md" else "range(20)", "range(200)")
    assert len(steps) >= 200
    check_loop(name, steps, names)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        # Each stops at its own toi.
        (
            "resolved.motion.at(1.0)",
            'motion.at(pgccd.detect(scene, motion).first_toi("body").clamp(max=1.0))',
            "overlap",
        ),
        ("resolved.motion.at(1.0)", "resolved.motion.at(0.0)", "the loop stands still"),
    ],
)
def test_wrong_loops_are_noticed(old: str, new: str, problem: str) -> None:
    with steps_recorded() as steps:
        names = run_document(ROOT / "README.md", old, new)
    with pytest.raises(AssertionError, match=problem):
        check_loop("README.md", steps, names)


def test_wrong_values_in_comments_are_noticed() -> None:
    right = "x = 0.2107\nx  # 0.21: of the way\n(x, [True, 'a'])  # (0.211, [True, 'a'])\nx  # the way: 7\n"
    assert run_checked(right, "page", {}) == []
    for line in ("x  # 0.23", "x  # 'a', 0.21", "[x > 1]  # [True]", "[]  # 0.21", "x  # 0.2 and 4 more"):
        assert len(run_checked(f"x = 0.2107\n{line}", "page", {})) == 1, line


def test_all_documents_are_found() -> None:
    assert {page.name for page in PAGES} >= {"README.md", "cluster.md"} and len(EXAMPLES) >= 7
    assert sum(len(blocks(page)) for page in PAGES) >= 6


@pytest.mark.parametrize("spacing", ["2.1", "210.0"], ids=["contacts", "no contact"])
def test_readme(spacing: str) -> None:
    names = run_document(ROOT / "README.md", "2.1 *", f"{spacing} *")
    assert (len(names["hits"]) > 0) == (spacing == "2.1")


def test_captured_contacts_are_those_of_the_step() -> None:
    names = run_document(DOCUMENTS["cuda_graphs.md"])
    assert len(names["contacts"]) > 0
    assert torch.equal(names["contacts"].toi, names["hits"].trim().toi)
