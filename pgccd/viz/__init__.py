"""Pictures of worlds: a PNG by matplotlib, and an interactive web page."""

from pgccd.viz.page import world_page
from pgccd.viz.picture import world_picture
from pgccd.viz.snapshot import Impact, Motion, Snapshot

__all__ = ["Impact", "Motion", "Snapshot", "world_page", "world_picture"]


def __dir__() -> list[str]:
    return sorted(__all__)
