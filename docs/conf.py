"""Settings of the site: `make docs`. It is built without a network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))
# Examples that start ranks of their own import the package from here too.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
os.environ.setdefault("MPLBACKEND", "agg")

import pgccd  # noqa: E402
import pgccd.viz.display  # noqa: E402

# Pages of `pgccd.show` stand in a tutorial as in a notebook.
pgccd.viz.display._is_in_notebook = lambda: True

project, author, release = "pgccd", "the pgccd authors", pgccd.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_parser", "sphinx_gallery.gen_gallery"]
html_theme = "furo"
copyright = "the pgccd authors. Apache-2.0"
html_title = f"pgccd {release}"
html_static_path, html_css_files = ["_static"], ["site.css"]
html_theme_options = {"navigation_with_keys": True}
exclude_patterns = ["tutorials/*.py", "tutorials/*.ipynb"]
suppress_warnings = ["config.cache"]  # functions in these settings cannot be pickled, and need not be

# Pages.
myst_heading_anchors = 4  # as GitHub makes them

# Reference. Backquotes in docstrings are code, as in pages; names of the public API among them become links below.
default_role = "literal"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "inherited-members": "object, int, BaseException, Exception, ValueError, RuntimeError",
}
autodoc_class_signature = "mixed"
python_display_short_literal_types = True
python_maximum_signature_line_length = 100

# Tutorials: scripts that the build executes.
sphinx_gallery_conf = {
    "examples_dirs": ["../examples"],
    "gallery_dirs": ["tutorials"],
    "filename_pattern": r"/\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "plot_gallery": "True",
    "show_memory": False,
    "write_computation_times": False,
    "min_reported_time": 1000,
    "remove_config_comments": True,
    "reference_url": {"pgccd": None},
    "doc_module": ("pgccd",),
    "image_scrapers": ("matplotlib",),
    "matplotlib_animations": False,
    "backreferences_dir": None,
}


def _escape_bars(app: Sphinx, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """|x| and *x in docstrings are not markup."""
    code = False
    for number, line in enumerate(lines):
        code = line.lstrip().startswith(">>>") or (code and bool(line.strip()))
        if not code:
            pieces = re.split(r"(`+[^`]*`+)", line)
            lines[number] = "".join(
                piece
                if piece.startswith("`")
                else re.sub(r"(?<!\\)([|])|(?<![\w*])(\*)(?=\w)(?!\w[^*]*\*)", r"\\\g<0>", piece)
                for piece in pieces
            )


def _analyze_without_overloads(analyzer: ModuleAnalyzer) -> None:
    """Overloads say for type checkers in up to nine ways what the parameters' descriptions say once."""
    _analyze(analyzer)
    analyzer.overloads = {}


_analyze = ModuleAnalyzer.analyze
ModuleAnalyzer.analyze = _analyze_without_overloads  # type: ignore[method-assign]


def _link_names(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Makes links of what stands in backquotes: names of the public API, such as `Contacts.normal`, examples and pages,
    such as `examples/01_two_bodies.py`.
    """
    known = _known_names(app)
    main = {*pgccd.__all__, *pgccd.distributed.__all__}
    for literal in list(doctree.findall(nodes.literal)):
        name = literal.astext().removesuffix("()")
        target = known.get(name) or known.get(name.split("(")[0])
        if "." not in name and name not in main and not page.startswith("reference/"):
            target = None  # in prose a short name may be that of something else
        document = re.sub(r"^docs/(.*)\.md$|^examples/(.*)\.py$", lambda m: m[1] or f"tutorials/{m[2]}", name)
        if document != name and document in app.env.all_docs:
            target = (document, "")
        if target is None or isinstance(literal.parent, nodes.reference):
            continue
        where, anchor = target
        address = "" if where == page else app.builder.get_relative_uri(page, where)
        address += f"#{anchor}" if anchor else ""
        link = nodes.reference("", "", internal=True, refuri=address)
        literal.replace_self(link)
        link += literal


def _known_names(app: Sphinx) -> dict[str, tuple[str, str] | None]:
    """Page and anchor of each documented name, such as `pgccd.Scene`, and of each of its ends, such as `Scene`, that no
    other name has.
    """
    if not hasattr(app, "_pgccd_names"):
        found: dict[str, tuple[str, str] | None] = {}
        objects = {name: (of.docname, of.node_id) for name, of in app.env.domains["py"].objects.items()}
        for name, target in objects.items():
            pieces = name.split(".")
            for first in range(1, len(pieces)):
                end = ".".join(pieces[first:])
                # An attribute alone, such as `kind`, says too little; a class or function does not.
                if first == len(pieces) - 1 and ".".join(pieces[:-1]) in objects and pieces[-2][:1].isupper():
                    continue
                found[end] = None if found.get(end, target) != target else target
        app._pgccd_names = found | objects  # type: ignore[attr-defined]
    return app._pgccd_names  # type: ignore[attr-defined,no-any-return]


class CommandHelp(SphinxDirective):
    """A section for each command of the command line, with the text of its `--help`."""

    def run(self) -> list[nodes.Node]:
        names = re.findall(r"^    (\w+)  ", _help(), re.MULTILINE)
        assert names, "pgccd --help lists no commands"
        return [self._section(name) for name in names]

    def _section(self, name: str) -> nodes.section:
        title, text = f"pgccd {name}", _help(name)
        section = nodes.section(ids=[f"pgccd-{name}"], names=[title])
        section += [nodes.title(title, title), nodes.literal_block(text, text, language="text")]
        return section


def _help(*command: str) -> str:
    environment = os.environ | {"COLUMNS": "100"}
    program = [sys.executable, "-m", "pgccd", *command, "--help"]
    return subprocess.run(program, env=environment, capture_output=True, text=True, check=True).stdout


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("command-help", CommandHelp)
    app.connect("autodoc-process-docstring", _escape_bars)
    app.connect("doctree-resolved", _link_names)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
