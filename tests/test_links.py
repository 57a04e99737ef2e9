"""Links between pages, their anchors, and the paths of files that pages name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.documents import ROOT

PAGES = [
    ROOT / name
    for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "bench/README.md", "csrc/README.md")
]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
FOLDERS = ("bench", "csrc", "docs", "examples", "pgccd", "tests")


def text_of(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.*)$", text_of(page), re.MULTILINE):
        anchor = re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
        repeated = (f"{anchor}-{number}" for number in range(1, len(found) + 1))
        found.add(anchor if anchor not in found else next(name for name in repeated if name not in found))
    return found


def broken_links(page: Path) -> list[str]:
    """The relative links of a page to files or anchors that do not exist."""
    broken = []
    for target in re.findall(r"\]\(([^()\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        if not file.exists() or (anchor and (file.suffix != ".md" or anchor not in anchors(file))):
            broken.append(target)
    return broken


def missing_files(page: Path) -> list[str]:
    """The paths in a page, from the root, of files that do not exist; and tests named without their folder, or with
    the end of it. Names in capitals, such as NAME, stand for any name.
    """
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[^`\s]*)`", text_of(page))
    patterns = [re.sub("NAME|STAGE|FAMILY|PACKAGE|MODULE", "*", name).rstrip("/") for name in named]
    missing = [name for name, pattern in zip(named, patterns, strict=True) if not any(ROOT.glob(pattern))]
    tests = re.findall(r"`((?!tests/)(?:\w+/)*test_\w+\.py)`", text_of(page))
    return missing + [name for name in tests if not any((ROOT / "tests").rglob(name))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links(page: Path) -> None:
    assert broken_links(page) == []
    assert missing_files(page) == []


def test_broken_links_are_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# One & two: `three`\n## Part\n## Part\n[1](#one--two-three) [2](page.md#part-1) [3](https://example.org/a#b)\n"
        "```\n# Comment\n[4](lost.md)\n```\n[5](lost.md) ![6](lost.png) [7](#comment) [8](page.md#part-2)\n"
        "`docs/lost.md` `bench/results/lost-*.json` `docs/NAME.md` `pgccd/distributed/` `lost.md`\n"
        "`test_lost.py` `sim/test_lost.py` `tests/test_lost.py` `test_links.py` `sim/test_runner.py`\n"
    )
    assert broken_links(page) == ["lost.md", "lost.png", "#comment", "page.md#part-2"]
    lost = ["docs/lost.md", "bench/results/lost-*.json", "tests/test_lost.py", "test_lost.py", "sim/test_lost.py"]
    assert missing_files(page) == lost


def test_files_to_open_exist() -> None:
    """Of the table "To change X, open Y": files from pgccd or the root, and tests from their folder or the root."""
    table = (ROOT / "docs/contributing.md").read_text().split("\n## To change X, open Y\n")[1].split("\n## ")[0]
    rows = [row.split("|") for row in re.findall(r"^\| (.*) \|$", table, re.MULTILINE)][1:]
    assert len(rows) > 20
    for _, files, tests in rows:
        for folder, names in (("pgccd", files), ("tests", tests)):
            missing = [
                name
                for name in re.findall(r"`([^`]+)`", names)
                if not any(map(Path.exists, (ROOT / folder / name, ROOT / name)))
            ]
            assert missing == []
