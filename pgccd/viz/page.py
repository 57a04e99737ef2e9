"""A self-contained interactive page: rotate, zoom, play the motion, step through the collisions."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path

from pgccd import arguments
from pgccd.geometry.scene import Scene
from pgccd.viz.animation import Animation, AnyFraction, AnyHits, Motions, RigidPaths, animation_of
from pgccd.viz.content import page_content

# A WebGL 2 viewer without external scripts; @NAME@ is replaced.
_TEMPLATE = Path(__file__).with_name("page.html")
_HEIGHT = 600  # pixels, in a notebook


class Page:
    """A self-contained HTML page, below 5 MB, that shows bodies on their paths with WebGL 2. Notebooks display it.

    Made by `Page.of` or, for the nanorobot model, by `pgccd.sim.page_of_steps`. What does not fit is left out (bodies,
    those that do not collide first; waypoints of long trajectories; triangles of large meshes), and the page says so.

    Attributes:
        html: text of the page.
        title: its title.
        notes: sentences below the title.
        left_out: sentences about what is not on the page, or simplified; empty if everything is.
        path: the file that `save` has written last, or None.

    Example:
        >>> page = pgccd.viz.Page.of(scene, motion, hits)
        >>> page.save("scene.html")
        PosixPath('scene.html')
    """

    def __init__(self, animation: Animation, playing: bool = False) -> None:
        data, self.left_out = page_content(animation)
        data["playing"] = playing
        data["moving"] = _moves(animation)
        self.title, self.notes = animation.title, list(animation.notes)
        self.path: Path | None = None
        lines = "".join(f"<p>{html.escape(line)}</p>" for line in self.notes)
        lines += "".join(f'<p class="left-out">{html.escape(line)}</p>' for line in self.left_out)
        filled = {
            "@TITLE@": html.escape(self.title),
            "@FIGURES@": lines,
            # A name of a body must not end the element.
            "@DATA@": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        }
        template = _TEMPLATE.read_text(encoding="utf-8")
        self.html = re.sub("|".join(filled), lambda found: filled[found[0]], template)

    @classmethod
    def of(
        cls,
        scene: Scene,
        motion: Motions,
        hits: AnyHits = None,
        *,
        fraction: AnyFraction = None,
        world: int | None = None,
        title: str | None = None,
        names: Sequence[str] | None = None,
    ) -> Page:
        """A page of any scene.

        Args:
            scene, motion, hits, fraction, world, title, names: as for `pgccd.show`.

        Raises:
            TypeError, ValueError: as for `pgccd.show`.

        Example:
            >>> pgccd.viz.Page.of(scene, motion, hits).left_out
            []
        """
        animation = animation_of(scene, motion, hits, fraction, world, names)
        animation.title = _title(animation) if title is None else title
        return cls(animation)

    def save(self, path: str | Path) -> Path:
        """Writes the page.

        Args:
            path: of the HTML file.

        Returns:
            The path.

        Raises:
            OSError: it cannot be written.
        """
        path = arguments.path(path, "path")
        path.write_text(self.html, encoding="utf-8")
        self.path = path
        return path

    def _repr_html_(self) -> str:
        content = html.escape(self.html)
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        return f'<iframe srcdoc="{content}" style="{style}" allowfullscreen></iframe>'

    def __repr__(self) -> str:
        where = "" if self.path is None else f", path={str(self.path)!r}"
        return f"Page({self.title!r}, bytes={len(self.html)}{where})"


def _title(animation: Animation) -> str:
    bodies = len(animation.shape_index)
    title = f"{bodies:,} {'body' if bodies == 1 else 'bodies'}"
    segments = animation.segment_count
    if segments > 1:
        title += f", {segments + 1:,} waypoints" if animation.first_step is None else f", {segments:,} steps"
    contacts = len(animation.marks)
    return title + (f", {contacts:,} contact{'s' * (contacts != 1)}" if contacts else "")


def _moves(animation: Animation) -> bool:
    paths = animation.paths
    if isinstance(paths, RigidPaths):
        return bool(paths.rotation.any()) or bool((paths.start[:1] != paths.end).any())
    return bool((paths.position != paths.position[:1]).any())
