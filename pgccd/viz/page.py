"""A self-contained interactive page of a world: rotate, zoom, play the step, step through the collisions."""

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from pgccd.viz.snapshot import Motion, Snapshot

# A WebGL 2 viewer without external scripts; @NAME@ is replaced.
_TEMPLATE = Path(__file__).with_name("page.html")

# About 80 bytes of text per robot or contact: keeps the page below 5 MB.
_MOST_ROBOTS = 50_000
_MOST_CONTACTS = 2_000


def world_page(path: str | Path, snapshot: Snapshot) -> Path:
    """Writes a self-contained HTML page, below 5 MB, that shows a world with WebGL.

    Of very large worlds it shows the colliding robots and a random sample of the others, and states the fraction shown.

    Args:
        path: of the page.
        snapshot: such as from `pgccd.sim.snapshot_of_step`.

    Returns:
        The path.

    Example:
        >>> pgccd.viz.world_page("model.html", pgccd.sim.snapshot_of_step(model, step))
    """
    still = np.zeros_like(snapshot.position)
    at_rest = Motion(
        position=snapshot.position,
        orientation=snapshot.orientation,
        velocity=still,
        angular_velocity=still,
        fraction=np.ones(len(still)),
        contact_ids=np.zeros((0, 2), dtype=np.int64),
        contact_toi=np.zeros(0),
        contact_point=still[:0],
    )
    motion = snapshot.motion or at_rest
    # Colliding robots first, then the others in random order, so that any prefix is a random sample.
    order = np.random.default_rng(0).permutation(len(snapshot.kind))
    order = order[np.argsort(~snapshot.colliding[order], kind="stable")][:_MOST_ROBOTS]
    columns = [motion.position, motion.orientation, motion.velocity, motion.angular_velocity]
    columns += [motion.fraction[:, None], snapshot.colliding[:, None]]
    bodies = np.concatenate(columns, axis=1)
    kinds = []
    for kind, mesh in enumerate(snapshot.meshes):
        rows = order[snapshot.kind[order] == kind]
        kinds.append(
            {
                "vertices": _encode(mesh.vertices.numpy(), np.float32),
                "faces": _encode(mesh.faces.numpy(), np.uint32),
                "bodies": _encode(bodies[rows], np.float32),
                "count": len(rows),
                "colliding": int(snapshot.colliding[rows].sum()),
            }
        )
    # Contacts in the middle of the step first, with motion before and after them.
    shown = np.argsort(np.abs(motion.contact_toi - 0.5), kind="stable")[:_MOST_CONTACTS]
    contacts = [
        {
            "ids": motion.contact_ids[k].tolist(),
            "toi": float(motion.contact_toi[k]),
            "point": motion.contact_point[k].tolist(),
        }
        for k in shown
    ]
    data = {
        "kinds": kinds,
        "contacts": contacts,
        "half_extent": snapshot.half_extent.tolist(),
        "radius": max(mesh.radius for mesh in snapshot.meshes),
        "robots": len(snapshot.kind),
        "moving": snapshot.motion is not None,
    }
    title, *figures = snapshot.caption or ["Nanorobot world"]
    filled = {
        "@TITLE@": html.escape(title),
        "@FIGURES@": "".join(f"<p>{html.escape(line)}</p>" for line in figures),
        "@DATA@": json.dumps(data, separators=(",", ":")),
    }
    page = _TEMPLATE.read_text(encoding="utf-8")
    for name, text in filled.items():
        page = page.replace(name, text)
    path = Path(path)
    path.write_text(page, encoding="utf-8")
    return path


def _encode(values: np.ndarray, dtype: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")
