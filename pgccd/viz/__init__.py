"""Interactive pages of scenes, and pictures of worlds: HTML with WebGL, models in GLB."""

from pgccd.viz.display import show
from pgccd.viz.live_view import Live, live
from pgccd.viz.page import Page
from pgccd.viz.picture import world_picture
from pgccd.viz.snapshot import Impact, Snapshot

__all__ = ["Impact", "Live", "Page", "Snapshot", "live", "show", "world_picture"]


def __dir__() -> list[str]:
    return sorted(__all__)
