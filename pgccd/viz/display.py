"""`pgccd.show`: a scene, its motion and its contacts as an interactive page, a picture or a GLB file."""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import overload

from pgccd import arguments
from pgccd.geometry.scene import Scene
from pgccd.viz.animation import AnyFraction, AnyHits, Motions, animation_of
from pgccd.viz.glb import write_glb
from pgccd.viz.page import Page
from pgccd.viz.png import write_png


@overload
def show(
    scene: Scene,
    motion: Motions,
    hits: AnyHits = None,
    path: None = None,
    *,
    fraction: AnyFraction = None,
    world: int | None = None,
    title: str | None = None,
    names: Sequence[str] | None = None,
) -> Page: ...
@overload
def show(
    scene: Scene,
    motion: Motions,
    hits: AnyHits = None,
    *,
    path: str | os.PathLike[str],
    fraction: AnyFraction = None,
    world: int | None = None,
    title: str | None = None,
    names: Sequence[str] | None = None,
) -> Path: ...
@overload
def show(
    scene: Scene,
    motion: Motions,
    hits: AnyHits,
    path: str | os.PathLike[str],
    *,
    fraction: AnyFraction = None,
    world: int | None = None,
    title: str | None = None,
    names: Sequence[str] | None = None,
) -> Path: ...
def show(
    scene: Scene,
    motion: Motions,
    hits: AnyHits = None,
    path: str | os.PathLike[str] | None = None,
    *,
    fraction: AnyFraction = None,
    world: int | None = None,
    title: str | None = None,
    names: Sequence[str] | None = None,
) -> Page | Path:
    """Shows bodies on their paths, and their contacts, on an interactive page: a time slider, play, next collision.

    The two bodies of a contact have two colours; its point and normal (from body i towards j) are drawn, in the world
    frame. The page is one HTML file below 5 MB, without outside scripts, for browsers with WebGL 2. What does not fit
    is simplified or left out, bodies that do not collide first; a UserWarning and the page say what. Detection is not
    run.

    Segments are drawn as capsules and points as balls, with the thickness of their mesh (thin if it has none), so
    spheres and capsules look like themselves. Triangles are drawn without their thickness, which counts among the
    margins.

    Args:
        scene: the bodies.
        motion: their paths: a `RigidMotion`, `VertexMotion` or `Trajectory`; or a list of the motions of consecutive
            steps, all `RigidMotion` or all `VertexMotion`.
        hits: the result of `pgccd.detect` for this scene and motion, any report, also a padded one; for a list of
            steps, a list with one result or None per step. Default: contacts are not shown.
        path: of a file to write: ".html", a page; ".png", a picture; or ".glb", a model for Blender and other viewers,
            which needs trimesh. Pictures and models have all bodies at the time of the first contact (at the start
            without one). Default: a notebook displays the returned page; elsewhere it is written to a temporary file
            and opened in the browser. Without a display, its path is written to standard error.
        fraction: body i moves on x_i(fraction_i t): a number or (N,) in [0, 1], such as `fraction` of `pgccd.resolve`;
            for a list of steps, a list with one of these per step, or a number for all. Not with a `Trajectory`. A box
            on the page switches to the whole paths, on which the contacts are. Pictures and models ignore it.
        world: shows only this world of the scene (`Scene.world`). Default: a page has a list of worlds to choose from.
        title: of the page. Default: numbers of bodies and contacts.
        names: (N,) strings: names of the bodies, which a page shows at their contacts. Default: only numbers.

    Returns:
        The path, if one was given; else a `pgccd.viz.Page`.

    Raises:
        TypeError, ValueError: naming the argument; also if `hits` are not of this scene or motion.
        OSError: the file cannot be written.
        ImportError: `path` ends in ".glb", and trimesh is not installed.

    Example:
        >>> pgccd.show(scene, motion, hits, path="scene.html")
        PosixPath('scene.html')
        >>> pgccd.show(scene, [motion, motion], [hits, None], path="steps.html")  # steps of a loop
        PosixPath('steps.html')
    """
    if title is not None and not isinstance(title, str):
        raise TypeError(f"title: expected a string, got {arguments.describe(title)}")
    if path is not None:
        path = require_writable(arguments.path(path, "path"))
        if (write := _STILL.get(path.suffix.lower())) is not None:
            return write(path, animation_of(scene, motion, hits, fraction, world, names))
    page = Page.of(scene, motion, hits, fraction=fraction, world=world, title=title, names=names)
    if page.left_out:
        warnings.warn(f"show: {' '.join(page.left_out)}", stacklevel=2)
    if path is not None:
        return page.save(path)
    if not _is_in_notebook() and not open_page(page):
        sys.stderr.write(f"pgccd.show: the page is {page.path}\n")
    return page


#: Writers of files that show one time, by suffix.
_STILL = {".glb": write_glb, ".png": write_png}


def is_page(path: Path) -> bool:
    """Whether `show` writes a page to this path, not a picture or a model."""
    return path.suffix.lower() not in _STILL


def require_writable(path: Path) -> Path:
    """The path of a page, a picture or a model, if it can be written.

    Raises:
        ValueError: it is none of these, by its suffix.
        OSError: it cannot.
    """
    if path.suffix.lower() not in (".html", ".htm", *_STILL):
        raise ValueError(f"path: expected a name that ends in .html, .htm, .png or .glb, got {path}")
    if path.is_dir():
        raise IsADirectoryError(f"path: {path} is a folder: expected the name of a file")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path: {path} cannot be written: there is no folder {path.parent}")
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise type(error)(f"path: {path} cannot be written: {error.strerror or error}") from error
    if not existed:
        path.unlink()
    return path


def _is_in_notebook() -> bool:
    """Whether the program is run by a Jupyter kernel or the like."""
    found = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(found, "kernel")


def open_page(page: Page) -> bool:
    """Writes the page to a temporary file. Opens it in the browser if there is a display; returns whether it did."""
    with tempfile.NamedTemporaryFile(prefix="pgccd-", suffix=".html", delete=False) as file:
        path = page.save(file.name)
    has_display = sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    # Without a display, browsers of a terminal would block the program.
    return has_display and webbrowser.open(path.as_uri())
