"""The bodies that one rank of a `World` owns: their rows, and what contacts mean for them."""

from __future__ import annotations

from torch import Tensor

from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.detection.ids import rows_of
from pgccd.distributed.detection.report import first_toi_of, sum_per_body
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.world.input_checks import require_ids, scene_of
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene


class OwnBodies:
    """Rows of `id`, `position`, `mesh_index` and `payload`, by ascending id. Nothing here sends messages."""

    columns: Columns
    meshes: MeshSet
    _vertices: Vertices | None
    _scene: Scene | None = None

    @property
    def id(self) -> Tensor:
        """(N,) int64, ascending: this rank's own bodies."""
        return self.columns["id"]

    @property
    def position(self) -> Tensor:
        """(N, 3) float64: positions of the origins of these bodies, as last given."""
        return self.columns["position"]

    @property
    def mesh_index(self) -> Tensor:
        """(N,) int32."""
        return self.columns["mesh_index"]

    @property
    def payload(self) -> dict[str, Tensor]:
        """The current per-body payload, by name."""
        return {name[1:]: column for name, column in self.columns.items() if name.startswith(".")}

    @property
    def vertex_payload(self) -> dict[str, Tensor]:
        """The current per-vertex payload, by name, of this rank's own bodies by ascending id."""
        columns = {} if self._vertices is None else self._vertices.columns
        return {name[1:]: column for name, column in columns.items()}

    def first_toi(self, hits: Contacts) -> Tensor:
        """(N,) float64: the first toi of each own body, or the first `time` of a trajectory; inf without a contact.

        Args:
            hits: as returned by `step`.
        """
        return first_toi_of(self.id, hits)

    def rows_of(self, ids: Tensor) -> Tensor:
        """The rows of bodies in `id`, `position` and `payload` of this rank, until bodies migrate.

        Args:
            ids: (...) int64 global ids, such as `pairs` of contacts.

        Returns:
            (...) int64: -1 for bodies that this rank does not own. It sends no messages.

        Raises:
            TypeError, ValueError: `ids` is no int64 tensor, or is on another device.

        Example:
            >>> row = world.rows_of(hits.pairs)  # (K, 2)
            >>> own = row[row >= 0]
        """
        require_ids(ids, self.id.device)
        return rows_of(self.id, ids)

    def sum_per_body(self, hits: Contacts | CollidingPairs, values: Tensor) -> Tensor:
        """Sums values of contacts, such as impulses, over the contacts of each own body.

        The terms are added in the order of the contacts: the bits do not depend on the number of ranks or the device.

        Args:
            hits: as returned by `step` or `collide`.
            values: (K, 2, ...) floating-point numbers of 16 bits or more: what each contact adds to i, and to j.

        Returns:
            (N, ...): 0 for bodies without a contact.

        Raises:
            TypeError, ValueError: naming the argument.

        Example:
            >>> hits = world.step(motion, payload=("velocity",))
            >>> exchanged = hits.payload["velocity"].flip(1) - hits.payload["velocity"]  # each takes the other's
            >>> velocity = world.payload["velocity"] + world.sum_per_body(hits, exchanged)
        """
        return sum_per_body(self.id, hits, values)

    def _current_scene(self) -> Scene:
        """The scene of this rank's own bodies, kept until bodies migrate."""
        if self._scene is None or self._scene.mesh_index is not self.mesh_index:
            self._scene = scene_of(self.meshes, self.columns)
        return self._scene
