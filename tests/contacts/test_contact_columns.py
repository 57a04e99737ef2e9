"""Every column of a contact has the same bits by whatever phase of the search finds it, and for whatever a compiler may
choose: without optimisation each operation is computed as written, as it is on CUDA.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.deforming import crumpled, motion_of
from support.host_program import run_program
from support.same_bits import bits

import pgccd

# Two triangles, as deforming bodies and as rigid ones. Their feature pairs are searched in one call, as on a CPU, and
# from phase to phase, as on a device. Most start within the separation; many do not move relative to each other, or
# have coordinates on a lattice, so that zeros of both signs occur; many edges are near parallel.
PROGRAM = """
#include <cstdio>
#include <cstring>
#include <random>
#include "kernels/narrow/contact_item.h"
#include "kernels/narrow/elementary_item.h"

using namespace pgccd;

std::mt19937_64 engine(7);
double uniform(double from, double to) { return std::uniform_real_distribution<double>(from, to)(engine); }
bool one_in(int count) { return std::uniform_int_distribution<int>(1, count)(engine) == 1; }

struct Row {
  double toi, u, v, point[3], normal[3];
  int64_t status;
};
static_assert(sizeof(Row) == 10 * 8);

int searches = 0, contacts = 0, at_start = 0, in_phase[4] = {}, different = 0;
uint64_t hash = 0;

template <class Bodies, class Pair>
Row row_of(const Bodies& bodies, const Pair& pair, const Candidate& candidate, const Outcome<double>& outcome) {
  Row row{};
  row.status = static_cast<int64_t>(outcome.status);
  if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) return row;
  row.toi = outcome.toi;
  const ContactPlace place = contact_place(bodies, pair, candidate, outcome.toi);
  row.u = place.u;
  row.v = place.v;
  store_vec3(row.point, place.point);
  store_vec3(row.normal, place.normal);
  return row;
}

template <class Bodies>
void compare(const Bodies& bodies, const NarrowSettings& settings) {
  const PairOf<Bodies> pair(bodies, 0, 1);
  const double latest = static_cast<double>(INFINITY);
  for (int kind = 0; kind < 3; ++kind) {
    const int i_count = kind == 1 ? 1 : 3, j_count = kind == 0 ? 1 : 3;
    for (int k = 0; k < i_count * j_count; ++k) {
      const Candidate candidate{0, kind, k / j_count, k % j_count};
      const Outcome<double> whole = solve_candidate(bodies, pair, candidate, settings, latest);
      Outcome<double> handed{Status::kFree, latest, 0.0, 0.0};
      Progress<double> progress;
      int phase = 0;
      if (!is_quickly_free(bodies, pair, candidate, settings, latest, progress)) {
        handed = solve_plainly(bodies, pair, candidate, settings, latest, progress);
        phase = 1;
        if (handed.status == Status::kOpen) {
          handed = solve_candidate(bodies, pair, candidate, settings, latest, progress);
          phase = 2;
        }
      }
      const Row one = row_of(bodies, pair, candidate, whole), other = row_of(bodies, pair, candidate, handed);
      ++searches;
      ++in_phase[phase];
      contacts += one.status != 0;
      at_start += one.status != 0 && one.toi == 0.0;
      uint64_t words[10];
      std::memcpy(words, &one, sizeof(one));
      for (const uint64_t word : words) hash = (hash ^ word) * 0x100000001b3u + (hash >> 29);
      if (std::memcmp(&one, &other, sizeof(one)) == 0) continue;
      if (++different < 5) {
        std::printf("kind %d: status %d %d, toi %.17g %.17g, u %.17g %.17g, v %.17g %.17g\\n", kind, int(one.status),
                    int(other.status), one.toi, other.toi, one.u, other.u, one.v, other.v);
      }
    }
  }
}

// The elementary tests, in both precisions; their bits of precision are a column, too.
template <class T>
void ask(const double (&start)[18], const double (&end)[18], const NarrowSettings& settings) {
  T t0[12], t1[12];
  for (int k = 0; k < 12; ++k) {
    t0[k] = static_cast<T>(start[k]);
    t1[k] = static_cast<T>(end[k]);
  }
  for (const bool is_edge_edge : {false, true}) {
    const Answer<T> answer =
        is_edge_edge ? solve_elementary<FeatureKind::kEdgeEdge>(t0, t1, settings)
                     : solve_elementary<FeatureKind::kVertexFace>(t0, t1, settings);
    const double words[4] = {answer.outcome.toi, answer.outcome.u, answer.outcome.v,
                             100.0 * answer.significant_bits + static_cast<double>(answer.outcome.status)};
    for (const double word : words) {
      uint64_t bits;
      std::memcpy(&bits, &word, sizeof(bits));
      hash = (hash ^ bits) * 0x100000001b3u + (hash >> 29);
    }
  }
}

int main() {
  const int32_t mesh_index[2] = {0, 1};
  const int32_t faces[6] = {0, 1, 2, 0, 1, 2}, all_edges[12] = {0, 1, 1, 2, 2, 0, 0, 1, 1, 2, 2, 0};
  const MeshOffsets offsets[3] = {{0, 0, 0, 0, 0}, {3, 1, 3, 0, 0}, {6, 2, 6, 0, 0}};
  for (int round = 0; round < 6000; ++round) {
    const bool on_lattice = one_in(2), is_still = one_in(2), is_slender = one_in(3);
    const auto coordinate = [&](double size) {
      return on_lattice ? 0.25 * std::uniform_int_distribution<int>(-4, 4)(engine) * size : uniform(-size, size);
    };
    double vertices[18], end[18], centre[2][6] = {}, margin[2] = {uniform(0.0, 0.3), 0.25};
    for (double& x : vertices) x = coordinate(1.0);
    if (is_slender) {  // the second triangle nearly repeats the first
      for (int k = 0; k < 9; ++k) vertices[9 + k] = vertices[k] + uniform(-0.02, 0.02);
      vertices[11] = vertices[2] + 0.25;
    }
    const double shift = is_still ? 0.0 : coordinate(1.0), noise = is_still ? 0.0 : 0.2;
    for (int k = 0; k < 18; ++k) {
      end[k] = vertices[k] + (k >= 9 && k % 3 == 1 ? shift : 0.0) + noise * coordinate(1.0);
    }
    const double separation = one_in(4) ? 0.0 : 0.125 * coordinate(1.0) + 0.25;
    const NarrowSettings settings{separation, one_in(2) ? -1e-6 : 1e-3, one_in(2)};
    const double radius[2] = {1.0, 1.5};
    MeshSetView meshes{};
    meshes.vertices = vertices;
    meshes.faces = faces;
    meshes.edges = all_edges;
    meshes.offsets = offsets;
    meshes.mesh_count = 2;
    BodyCentres centres{centre[0], centre[1], radius, 2, one_in(2) ? margin : nullptr};
    const int64_t vertex_begin[2] = {0, 3}, block_begin[2] = {0, 0};
    const DeformingBodies deforming{meshes,  mesh_index, centres,      6,           vertices, end,
                                    nullptr, nullptr,    vertex_begin, block_begin, 0};
    compare(deforming, settings);
    ask<double>(vertices, end, settings);
    ask<float>(vertices, end, {settings.separation, 1e-3, settings.nonzero_toi});
    // The same triangles, turning about their origins, on arcs and on straight lines.
    const double orientation[8] = {1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5};
    double rotation[6];
    for (double& w : rotation) w = is_still ? 0.0 : coordinate(1.0);
    centre[1][4] = shift;
    for (const bool is_linear : {false, true}) {
      compare(RigidBodies{meshes, mesh_index, centres, orientation, rotation, is_linear}, settings);
    }
  }
  std::printf("%016llx\\n", static_cast<unsigned long long>(hash));
  std::printf("%d searches: %d free at once, %d end in the plain phase, %d later; %d contacts, %d at the start; "
              "%d different\\n", searches, in_phase[0], in_phase[1], in_phase[2], contacts, at_start, different);
  return different > 0 ? 1 : in_phase[1] > 1000 && in_phase[2] > 1000 && at_start > 1000 ? 0 : 2;
}
"""


@pytest.mark.slow
def test_columns_do_not_depend_on_phases_or_optimisation(tmp_path: Path) -> None:
    assert run_program(PROGRAM, tmp_path, "-O2") == run_program(PROGRAM, tmp_path, "-O0")


def test_columns_of_deforming_bodies_do_not_depend_on_their_place(device: torch.device) -> None:
    """Differences of these vertices are exact, near the world's origin and far from it."""
    shapes, ends = crumpled(5)
    place = np.array([2.0**30, -(2.0**29), 2.0**28])
    found = []
    for offset in (0.0 * place, place):
        moved = [[np.round(x * 2.0**20) / 2.0**20 + offset for x in body] for body in ends]
        scene = pgccd.Scene(shapes, self_collision=True, device=device)
        found.append(pgccd.detect(scene, motion_of(*moved, device=device), "all", 0.05, tolerance=1e-6))
    near, far = found
    assert len(near) > 1000 and bool((near.toi > 0.0).any())
    for name in ("pairs", "toi", "kind", "features", "coordinates", "normal", "status"):
        assert torch.equal(bits(getattr(near, name)), bits(getattr(far, name))), name
    shift = torch.tensor(place, device=device)
    assert torch.allclose(far.point - shift, near.point, rtol=0.0, atol=1e-6)
