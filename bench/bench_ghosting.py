"""Two ways to find all contacts of bodies distributed over ranks, counted on the standard model:

* once: ghosts where CBVs reach. Each pair is tested by one rank, the owner of its boxes' reference point, and contacts
  are sent to the owners of both bodies (as in `pgccd.distributed`).
* twice: ghosts where CBVs grown by the largest extent of any body reach. Every owner finds all contacts of its bodies,
  and pairs with two owners are tested by both.

Per body: ghosts, body pairs tested, rows of contacts sent. "unseen": pairs that no rank would test with ghosts where
CBVs reach and owners testing only pairs of their own bodies, since neither owner has the other body. Robots have moved
for some steps before. Only counts are computed; no GPU is used and no messages are sent.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from support import results, timing
from torch import Tensor

from pgccd import broad, distributed, ops, sim
from pgccd.distributed import Cells
from pgccd.search.bodies import MovingBodies

_ROWS = 1 << 18  # (body, rank) entries per chunk


#: Positions at both ends (N, 3), and radii (N,).
Centres = tuple[Tensor, Tensor, Tensor]


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots", type=int, default=1_000_000, help="in all")
    parser.add_argument("--ranks", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--cells", type=int, default=16, help="of each rank: M x M")
    parser.add_argument("--steps", type=int, default=20, help="before the one that is looked at")
    arguments = parser.parse_args()
    model = sim.Model(sim.ModelConfig(robots=arguments.robots))
    simulation = sim.Simulation.create(distributed.Alone(), model, graph=False)
    for index in range(arguments.steps):
        simulation.step(index)
    last = simulation.step(arguments.steps)
    assert isinstance(last, sim.Step)
    bodies = MovingBodies.of(model.scene(last.before.id), model.motion(last.before))
    rows = [count(model, bodies, last.contacts.pairs, ranks, arguments) for ranks in arguments.ranks]
    results.table(rows)
    results.write(
        "ghosting", "cpu", {"robots": arguments.robots, "steps": arguments.steps, "rows": rows}, arguments.out
    )


def count(
    model: sim.Model, bodies: MovingBodies, contacts: Tensor, ranks: int, arguments: argparse.Namespace
) -> dict[str, Any]:
    """The row of one number of ranks."""
    x, y, z = model.half_extent
    partition = Cells.uniform((-x, -y, -z), (x, y, z), ranks, cells=arguments.cells)
    centres = bodies.position_t0, bodies.position_t1, bodies.radius
    lower, upper = ops.swept_boxes(centres, 0.0, 0.0)
    # Largest distance of a box's faces from the centre that determines the owner.
    extent = float(torch.maximum(upper - bodies.position_t0, bodies.position_t0 - lower).max())
    owner, pairs = partition.owner_of(bodies.position_t0), broad.find_pairs(bodies)
    owners = owner[pairs]
    between = owners[:, 0] != owners[:, 1]
    robots = len(owner)
    return {
        "ranks": ranks,
        "ghosts once": timing.rounded(ghosts(partition, centres, owner, 0.0) / robots),
        "ghosts twice": timing.rounded(ghosts(partition, centres, owner, 2.0 * extent) / robots),
        "pairs once": timing.rounded(len(pairs) / robots),
        "pairs twice": timing.rounded((len(pairs) + int(between.sum())) / robots),
        "sent once": timing.rounded(sent(partition, lower, owner, contacts) / robots),
        "contacts": timing.rounded(len(contacts) / robots),
        "unseen": unseen(partition, centres, pairs[between], owners[between]),
    }


def ghosts(partition: Cells, centres: Centres, owner: Tensor, separation: float) -> int:
    """Ghosts with boxes grown by half the separation: bodies times the other ranks that they reach."""
    total = 0
    for rows in torch.arange(len(owner)).split(max(1, _ROWS // partition.ranks)):
        reached = reach(partition, centres, rows, separation)
        reached[torch.arange(len(rows)), owner[rows]] = 0
        total += int(reached.sum())
    return total


def reach(partition: Cells, centres: Centres, rows: Tensor, separation: float = 0.0) -> Tensor:
    """Entry (B, ranks) uint8: 1 where one of the rows (B,) reaches a cell of the rank."""
    ranks = partition.ranks
    reached, _ = ops.replica_ranks(centres, separation, 0.0, *partition.subdomain(0), rows, [], ranks)
    # The operator omits the calling rank; its column is computed as another rank.
    reached[:, 0] = ops.replica_ranks(centres, separation, 0.0, *partition.subdomain(ranks - 1), rows, [], ranks)[0][
        :, 0
    ]
    return reached


def unseen(partition: Cells, centres: Centres, pairs: Tensor, owners: Tensor) -> int:
    """Pairs (P, 2) with different owners (P, 2) in which neither owner has the other body."""
    seen = torch.zeros(len(pairs), dtype=torch.bool)
    for side in range(2):
        reached = reach(partition, centres, pairs[:, side].contiguous())
        seen |= reached[torch.arange(len(pairs)), owners[:, 1 - side]] != 0
    return int((~seen).sum())


def sent(partition: Cells, lower: Tensor, owner: Tensor, contacts: Tensor) -> int:
    """Rows of contacts sent to owners of their bodies that did not find them."""
    tester = partition.owner_of(torch.maximum(lower[contacts[:, 0]], lower[contacts[:, 1]]))
    owners = owner[contacts]
    rows = owners != tester[:, None]
    rows[:, 1] &= owners[:, 1] != owners[:, 0]
    return int(rows.sum())


if __name__ == "__main__":
    main()
