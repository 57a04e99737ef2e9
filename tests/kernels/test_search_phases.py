"""A search passed from phase to phase, as on a device, ends bit for bit as one run in a single call."""

from __future__ import annotations

from pathlib import Path

from support.host_program import run_program

# The device phases, compiled for the host. Most features are slender, and many touch or nearly touch at once.
PROGRAM = """
#include <cstdio>
#include <cstring>
#include <random>
#include "kernels/narrow/advancement.h"
#include "kernels/narrow/paths.h"

using namespace pgccd;

std::mt19937_64 engine(1);
double uniform(double from, double to) { return std::uniform_real_distribution<double>(from, to)(engine); }
Vec3<double> anywhere(double size) { return {uniform(-size, size), uniform(-size, size), uniform(-size, size)}; }

int searches = 0, resumed[kQuickAdvances + 1] = {}, touching_early = 0, different = 0;

template <FeatureKind kKind, class Path>
void compare(const Path& path, const SearchSettings<double>& settings) {
  const Outcome<double> whole = advance_to_contact<kKind>(path, settings, Progress<double>{});
  Progress<double> progress;
  Outcome<double> handed{Status::kFree, static_cast<double>(INFINITY), 0.0, 0.0};
  if (!is_quickly_free<kKind>(path, settings, progress)) {
    ++resumed[progress.advances];
    if (whole.status == Status::kTouch && progress.advances < kQuickAdvances) ++touching_early;
    Progress<double> left = progress;
    handed = advance_in_phase<kKind, Phase::kPlain>(path, settings, left);
    if (handed.status == Status::kOpen) handed = advance_to_contact<kKind>(path, settings, progress);
  }
  ++searches;
  const bool same = handed.status == whole.status && std::memcmp(&handed.toi, &whole.toi, 3 * sizeof(double)) == 0;
  if (same) return;
  if (++different < 5) {
    std::printf("kind %d after %d: status %d %d, toi %.17g %.17g, u %.17g %.17g, v %.17g %.17g\\n", int(kKind),
                progress.advances, int(whole.status), int(handed.status), whole.toi, handed.toi, whole.u, handed.u,
                whole.v, handed.v);
  }
}

template <FeatureKind kKind>
void compare_at(double gap, double width, const SearchSettings<double>& settings) {
  constexpr int first_count = PointSplit<kKind>::first_count;
  // The features' directions nearly agree, and a point of one lies above a point of the other.
  Vec3<double> x[4] = {anywhere(1.0), anywhere(1.0), anywhere(1.0), anywhere(1.0)};
  const Vec3<double> along = anywhere(1.0);
  const double s = uniform(0.1, 0.9), t = uniform(0.1, 0.9);
  if constexpr (kIsEdgeEdge<kKind>) {
    x[1] = x[0] + along;
    x[3] = x[2] + (along + anywhere(width));
  } else {
    x[2] = x[1] + along;
    x[3] = x[1] + (uniform(0.5, 1.5) * along + anywhere(width));
  }
  const Vec3<double> a = kIsEdgeEdge<kKind> ? x[1] - x[0] : x[2] - x[1];
  const Vec3<double> b = kIsEdgeEdge<kKind> ? x[3] - x[2] : x[3] - x[1];
  const Vec3<double> normal = unit_vector(cross(a, b));
  const Vec3<double> on_first = kIsEdgeEdge<kKind> ? x[0] + s * a : x[0];
  const Vec3<double> on_second = kIsEdgeEdge<kKind> ? x[2] + t * b : x[1] + s * a + (t * (1.0 - s)) * b;
  const Vec3<double> shift = on_first + gap * normal - on_second;
  for (int k = first_count; k < 4; ++k) x[k] = x[k] + shift;
  Vec3<double> end[4];
  const Vec3<double> approach = uniform(-2.0, 0.5) * larger(gap, 1e-3) * normal;
  for (int k = 0; k < 4; ++k) {
    end[k] = x[k] + anywhere(uniform(0.0, 1.0) < 0.5 ? 0.0 : 0.1 * gap);
    if (k >= first_count) end[k] = end[k] + approach;
  }
  compare<kKind>(LinearPath<kKind, double>(x, end, 0.0), settings);
  // The same features, turning about axes of their own.
  const Spin spin[2] = {make_spin(anywhere(0.5)), make_spin(anywhere(0.5))};
  Vec3<double> bases[4];
  for (int k = 0; k < 4; ++k) bases[k] = k < first_count ? x[k] : x[k] - x[first_count];
  const RelativeCentre centre{x[first_count], x[first_count] + approach};
  compare<kKind>(ArcPath<kKind, double>(bases, spin[0], spin[1], centre, 0x1p-50), settings);
}

int main() {
  for (int k = 0; k < 20000; ++k) {
    const double tolerance = std::pow(10.0, uniform(-9.0, -1.0));
    const double separation = k % 3 == 0 ? uniform(0.0, 0.5) : 0.0;
    const double gap = separation + (k % 2 ? std::pow(10.0, uniform(-9.0, 0.0)) : uniform(0.0, 2.0) * tolerance);
    const double width = std::pow(10.0, uniform(-6.0, 0.0));
    const SearchSettings<double> settings{separation, tolerance, static_cast<double>(INFINITY), k % 5 == 0};
    compare_at<FeatureKind::kEdgeEdge>(gap, width, settings);
    compare_at<FeatureKind::kVertexFace>(gap, width, settings);
  }
  std::printf("%d searches, %d %d %d handed on after 0, 1, 2 advances, %d that touch before, %d different\\n", searches,
              resumed[0], resumed[1], resumed[2], touching_early, different);
  bool is_enough = touching_early > 1000;
  for (const int count : resumed) is_enough = is_enough && count > 1000;
  return different > 0 ? 1 : is_enough ? 0 : 2;
}
"""


def test_phases_hand_on_what_they_know(tmp_path: Path) -> None:
    run_program(PROGRAM, tmp_path)
