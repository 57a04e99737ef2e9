"""Counts of device lists beyond 32 bits are never mistaken for counts that fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.host_program import run_program
from support.shapes import bumpy, tensors, unit_quaternions

import pgccd
from pgccd.runtime.sizes import BufferSizes

# The device code that checks list lengths, compiled for the host.
PROGRAM = """
#include <cstdio>
#include <cstdlib>
#include "core/candidate.h"
#include "kernels/traverse/traverse_counters.h"

using namespace pgccd;

#define EXPECT(what) if (!(what)) { std::printf("line %d: %s\\n", __LINE__, #what); failed = 1; }

int main() {
  int failed = 0;
  const long long most = 0xffffffffll;
  TraverseCounters seen{};
  Counter* const lists[] = {&seen.poses,            &seen.most_rest,       &seen.leaves,
                            &seen.candidates.front, &seen.candidates.back, &seen.self_blocks};
  for (Counter* const list : lists) {
    seen = {};
    TraverseListSizes sizes{1000, 1000, 1000, 1000};
    const bool is_blocks = list == &seen.self_blocks;
    *list = is_blocks ? most : 1000;
    EXPECT(sizes.holds(seen) && sizes.can_grow(seen));
    // As warps add to it: past 2^32, where 32 bits begin again.
    *list = most - 31;
    for (int warp = 0; warp < 4; ++warp) {
      const Counter place = *list;
      *list += 32;
      EXPECT(!has_place(place, 1000) && !has_place(place, kMostRows));
    }
    EXPECT(*list == static_cast<Counter>(most) + 97);
    EXPECT(!sizes.holds(seen) && !sizes.can_grow(seen));
    sizes.grow(seen);
    EXPECT(!sizes.holds(seen));
    int64_t counts[kTraverseCounts] = {};
    store_traverse_counts(seen, sizes, 0, counts);
    EXPECT(counts[kTraverseOverflow] == 1);
    int64_t needed = 0;
    for (const int count : {kPosesNeeded, kTasksNeeded, kLeafPairsNeeded, kCandidatesNeeded}) needed += counts[count];
    EXPECT(is_blocks || needed == most + 97);
  }
  // Tasks that the last launch left, and rows that name nothing.
  const TraverseListSizes sizes{1, 1, 1, 1};
  for (int what = 0; what < 2; ++what) {
    TraverseCounters seen{};
    (what == 0 ? seen.rest[2] : seen.unsound) = Counter{1} << (32 * (1 - what));
    int64_t counts[kTraverseCounts] = {};
    store_traverse_counts(seen, sizes, 2, counts);
    EXPECT(counts[kTraverseOverflow] == 1);
  }
  // Candidates from both ends, each count below 2^32.
  const CandidateCounts many{0x80000000u, 0x80000010u}, none{0, 0}, counts{5, 7}, before{2, 4};
  EXPECT((CandidateSpan{nullptr, 1000, &many, &none}.count() == 0));
  // Without those that were there before: 2 to 4 at the front, 4 to 6 from the back.
  const CandidateSpan span{nullptr, 1000, &counts, &before};
  const int64_t places[] = {2, 3, 4, 995, 994, 993};
  EXPECT(span.count() == 6);
  for (int k = 0; k < 6; ++k) EXPECT(span.place(k) == places[k]);
  EXPECT(rows_of(-1) == 0 && rows_of(7) == 7 && rows_of(most + 8) == kMostRows);
  return failed;
}
"""


def test_counts_beyond_32_bits(tmp_path: Path) -> None:
    run_program(PROGRAM, tmp_path, "-O0")


@pytest.mark.cuda
def test_more_candidates_than_32_bits_count() -> None:
    """A separation that accepts every feature pair: so many that a 32-bit count would wrap to a value below the
    capacity.
    """
    rng = np.random.default_rng(0)
    mesh = bumpy(rng, 3)
    vertices, faces = mesh.vertices.shape[0], mesh.faces.shape[0]
    edges = vertices + faces - 2
    each = 2 * vertices * faces + edges**2  # feature pairs of two closed meshes
    pairs = 2**32 // each + 1
    count = 2 * pairs
    position = np.arange(count)[:, None] * np.array([1e-3, 0.0, 0.0])
    pose = tensors(position, unit_quaternions(rng, count), position, unit_quaternions(rng, count), device="cuda")
    scene = pgccd.Scene([mesh], [0] * count, "cuda")
    given = torch.arange(count, device="cuda").reshape(-1, 2)
    capacity = BufferSizes(pairs=pairs, contacts=64, poses=64 * pairs, tasks=2**22, leaf_pairs=2**28, candidates=2**22)
    found = pgccd.collide(scene, pgccd.RigidMotion(*pose, path="linear"), 1e6, pairs=given, capacity=capacity)
    assert bool(found.overflow)
    with pytest.raises(pgccd.CapacityError, match="candidates"):
        found.trim()
