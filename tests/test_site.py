"""The site: its reference covers the public API, its pages stand in its contents, and it builds without warnings."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from support.documents import EXAMPLES, ROOT

import pgccd

DOCS = ROOT / "docs"


def directives() -> dict[str, set[str]]:
    """Names by directive of autodoc, such as "class", from the pages of the reference."""
    text = "".join(page.read_text() for page in sorted((DOCS / "reference").glob("*.md")))
    found: dict[str, set[str]] = {}
    for kind, name in re.findall(r"^\.\. auto(\w+):: (\S+)$", text, re.MULTILINE):
        assert name not in found.setdefault(kind, set()), f"{name} is described twice"
        found[kind].add(name)
    return found


def test_reference_covers_what_is_public() -> None:
    """Modules are described with all that their `__all__` names; every other name has a directive of its own."""
    public = {f"pgccd.{name}": getattr(pgccd, name) for name in pgccd.__all__}
    modules = {name for name, value in public.items() if isinstance(value, ModuleType)}
    found = directives()
    assert found.pop("module") == modules
    assert set().union(*found.values()) == set(public) - modules


def test_all_pages_are_in_the_contents() -> None:
    listed = set()
    for index in (DOCS / "index.md", DOCS / "reference" / "index.md"):
        for block in re.findall(r"```\{toctree\}\n(.*?)```", index.read_text(), re.DOTALL):
            names = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {(index.parent / f"{name}.md").relative_to(DOCS).as_posix() for name in names}
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert pages - {"index.md"} == listed - {"tutorials/index.md"}


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_examples_have_titles_and_pictures(example: Path) -> None:
    text = example.read_text()
    title = re.match(r'r?"""\n(\S.*)\n(=+)\n\n', text)
    assert title and len(title[1]) == len(title[2])
    assert "\nplt.show()\n" in text.replace("    ", "") and "\n# %%\n" in text


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_build(tmp_path: Path) -> None:
    """With the examples, in a copy: the build writes the tutorials beside the pages."""
    pytest.importorskip("sphinx_gallery")
    for name in ("docs", "examples"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("tutorials", "__pycache__"))
    for name in ("bench", "pgccd"):
        (tmp_path / name).symlink_to(ROOT / name)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "site"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=580)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "tutorials" / "01_two_bodies.html").read_text()
    assert "sphx_glr_01_two_bodies_001.png" in page and "<iframe" in page
    assert 'href="../reference/results.html#pgccd.Contacts.features"' in page
