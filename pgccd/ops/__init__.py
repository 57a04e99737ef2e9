"""Typed wrappers of the compiled operators, each with its fake kernel as its body: see `pgccd.ops.library`.

The operators check shapes and dtypes; the stage modules that call these wrappers document meaning and units.
"""

from pgccd.ops.arms import arm_arcs, arm_poses, certify_paths
from pgccd.ops.contacts import certainly_recede, closing_rates, surface_normals
from pgccd.ops.detection import (
    ContactRows,
    Swept,
    broad_pairs,
    contacts_padded,
    detect_rigid,
    edge_edge,
    first_invalid_rows,
    lower_first_toi_rigid,
    meeting_pairs,
    moving_boxes,
    moving_spheres,
    narrow,
    pairs_padded,
    poses_at,
    refit,
    rotations_between,
    shorten_arcs,
    sound_radii,
    traverse,
    vertex_face,
)
from pgccd.ops.distance import distances
from pgccd.ops.graphs import begin_conditional, end_conditional, has_conditional_nodes
from pgccd.ops.library import Bodies, build_information, set_device_share, take_scratch_peak
from pgccd.ops.meshes import prepare_mesh
from pgccd.ops.peers import peer_gather, peer_minimum
from pgccd.ops.resolve import resolve_first_toi, resolve_pairs, resolve_slow_down
from pgccd.ops.rows import commit_rows, merge_rows, pack_rows, take_rows, unpack_rows
from pgccd.ops.simulate import (
    random_uniforms,
    simulate_commit,
    simulate_hash,
    simulate_plan,
    simulate_respond,
    simulate_start,
    simulate_tally,
)
from pgccd.ops.subdomain import (
    Centres,
    Subdomain,
    boundary_bodies,
    counts_to_send,
    leaving_and_invalid,
    leaving_bodies,
    near_ghosts,
    owned_pairs,
    reached_ranks,
    replica_ranks,
    rows_by_rank,
    swept_boxes,
)
from pgccd.ops.voxel import voxel_boxes, voxel_pairs, voxels_touched
