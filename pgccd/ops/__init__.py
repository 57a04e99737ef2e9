"""One-to-one wrappers of the compiled operators (`library`); their fake kernels are in `pgccd.fake_ops`.

Thin on purpose: shapes and dtypes are checked by the operators, meaning and units are documented by the stage modules
that call these.
"""

from pgccd.ops.detection import (
    contacts_within_deforming,
    contacts_within_rigid,
    edge_edge,
    first_faults,
    grid,
    lbvh,
    narrow_deforming,
    narrow_rigid,
    pairs_within,
    refit,
    rotations_between,
    sweep,
    swept_boxes,
    traverse_deforming,
    traverse_rigid,
    vertex_face,
)
from pgccd.ops.library import take_scratch_peak
from pgccd.ops.rows import merge_rows, pack_rows, take_rows, unpack_rows
from pgccd.ops.simulate import (
    random_uniforms,
    simulate_concerned_pairs,
    simulate_first_toi,
    simulate_hash,
    simulate_pair_motion,
    simulate_plan,
    simulate_respond,
    simulate_slow_all_down,
    simulate_slow_down,
    simulate_start,
)
from pgccd.ops.territory import (
    Centres,
    Territory,
    border_bodies,
    leaving_bodies,
    near_ghosts,
    owned_pairs,
    reached_ranks,
)

__all__ = [
    "Centres",
    "Territory",
    "border_bodies",
    "contacts_within_deforming",
    "contacts_within_rigid",
    "edge_edge",
    "first_faults",
    "grid",
    "lbvh",
    "leaving_bodies",
    "merge_rows",
    "narrow_deforming",
    "narrow_rigid",
    "near_ghosts",
    "owned_pairs",
    "pack_rows",
    "pairs_within",
    "random_uniforms",
    "reached_ranks",
    "refit",
    "rotations_between",
    "simulate_concerned_pairs",
    "simulate_first_toi",
    "simulate_hash",
    "simulate_pair_motion",
    "simulate_plan",
    "simulate_respond",
    "simulate_slow_all_down",
    "simulate_slow_down",
    "simulate_start",
    "sweep",
    "swept_boxes",
    "take_rows",
    "take_scratch_peak",
    "traverse_deforming",
    "traverse_rigid",
    "unpack_rows",
    "vertex_face",
]
