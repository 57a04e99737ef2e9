"""What the search of paths relies on, compiled for the host: margins of moving obstacles, and the order of times."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from support.host_program import run_program

import pgccd

PROGRAM = """
#include <cmath>
#include <cstdio>
#include <limits>
#include <random>
#include "kernels/arms/validator.h"

using namespace pgccd;

#define EXPECT(what) if (!(what)) { std::printf("line %d: %s\\n", __LINE__, #what); ++failed; }
int failed = 0;

using Long = long double;
struct Exact { Long x, y, z; };

Exact rotated(const Long* w, Long angle, Exact v) {  // about w, of unit length
  const Long s = std::sin(angle), c = 1 - std::cos(angle);
  const Exact k{w[1] * v.z - w[2] * v.y, w[2] * v.x - w[0] * v.z, w[0] * v.y - w[1] * v.x};
  const Exact kk{w[1] * k.z - w[2] * k.y, w[2] * k.x - w[0] * k.z, w[0] * k.y - w[1] * k.x};
  return {v.x + s * k.x + c * kk.x, v.y + s * k.y + c * kk.y, v.z + s * k.z + c * kk.z};
}

Exact turned(const double* q, Exact v) {
  const Long n = (Long)q[0] * q[0] + (Long)q[1] * q[1] + (Long)q[2] * q[2] + (Long)q[3] * q[3];
  const Long a[3] = {q[1], q[2], q[3]}, w = q[0];
  const Exact t{2 * (a[1] * v.z - a[2] * v.y), 2 * (a[2] * v.x - a[0] * v.z), 2 * (a[0] * v.y - a[1] * v.x)};
  const Exact u{a[1] * t.z - a[2] * t.y, a[2] * t.x - a[0] * t.z, a[0] * t.y - a[1] * t.x};
  return {v.x + (w * t.x + u.x) / n, v.y + (w * t.y + u.y) / n, v.z + (w * t.z + u.z) / n};
}

Exact about(Vec3<double> rotation, Long part, Exact v) {
  const Long w[3] = {rotation.x, rotation.y, rotation.z};
  const Long angle = std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  const Long unit[3] = {w[0] / angle, w[1] / angle, w[2] / angle};
  return rotated(unit, angle * part, v);
}

// Of a point of an obstacle, at a time within a part of its segment: from its exact place to that on the arc.
void check_obstacles() {
  std::mt19937_64 random(5);
  std::normal_distribution<double> normal;
  const double sizes[][2] = {{1.0, 1.0}, {1e6, 0.1}, {1.0, 1e3}, {1e-3, 30.0}};
  const double parts[][2] = {{0.0, 1.0}, {0.3, 0.30001}, {0.123, 0.987}};
  double most = 0.0;
  for (int k = 0; k < 600; ++k) {
    const auto [size, turn] = sizes[k % 4];
    double x0[3], x1[3], r0[4], w[3], reach = 0.2;
    for (int c = 0; c < 3; ++c) {
      x0[c] = size * normal(random);
      x1[c] = size * normal(random);
      w[c] = turn * normal(random);
    }
    for (double& c : r0) c = normal(random);
    const double n = std::sqrt(r0[0] * r0[0] + r0[1] * r0[1] + r0[2] * r0[2] + r0[3] * r0[3]);
    for (double& c : r0) c /= n;
    double largest = 0.0;
    for (int c = 0; c < 3; ++c) largest += std::max(std::fabs(x0[c]), std::fabs(x1[c]));
    const double error = MARGIN;
    const ArmObstacles obstacles{1, 1, x0, x1, r0, w, &error, true};
    const Exact point{0.12L, -0.1L, 0.12L};
    for (const auto& [begin, end] : parts) {
      const ArmArc arc = arc_of_obstacle(obstacles, 0, 0, 0, begin, end);
      EXPECT(arc.stray == error);
      const Quaternion o = arc.start.orientation;
      const double q[4] = {o.w, o.v.x, o.v.y, o.v.z};
      for (const Long within : {0.0L, 0.37L, 1.0L}) {
        const Exact now = about(arc.rotation, within, turned(q, point));
        const Vec3<double> p = arc.start.position, e = arc.end;
        const Long s = begin + within * ((Long)end - begin);
        const Exact exact = about(load_vec3(w), s, turned(r0, point));
        const Long d[3] = {p.x + within * ((Long)e.x - p.x) + now.x - (x0[0] + s * ((Long)x1[0] - x0[0]) + exact.x),
                           p.y + within * ((Long)e.y - p.y) + now.y - (x0[1] + s * ((Long)x1[1] - x0[1]) + exact.y),
                           p.z + within * ((Long)e.z - p.z) + now.z - (x0[2] + s * ((Long)x1[2] - x0[2]) + exact.z)};
        const double away = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        EXPECT(away <= error);
        most = std::max(most, away / error);
      }
    }
  }
  EXPECT(most > 1e-3);
}

// A distance that is known suffices for all points of bodies that move from there in any of these ways, and hardly.
void check_known_distances() {
  double x0[6] = {1, 2, 3, 0, 0, 0}, x1[6] = {1, 2, 3, 0, 0, 0}, r[8] = {1, 0, 0, 0, 1, 0, 0, 0}, w[6] = {};
  RigidBodies bodies{};
  bodies.centres.position_t0 = x0;
  bodies.centres.position_t1 = x1;
  bodies.orientation = r;
  bodies.rotation = w;
  KnownDistance known;
  known.position[0] = {1, 2, 3};
  known.orientation[0] = known.orientation[1] = {1, {0, 0, 0}};
  const double still[2] = {0.0, 0.0}, reach[2] = {2.0, 0.5}, resolution = 0x1p-20;
  const auto extra = [&](const double (&stray)[2]) {
    return needed_distance(known, bodies, stray, reach, resolution) - resolution;
  };
  const auto suffices = [](double found, double moved) { return found >= moved && found <= moved * 1.0005 + 1e-9; };
  EXPECT(suffices(extra(still), 0.0));
  // Both bodies: where they are, how far they go, and how far they stray.
  x0[0] = x1[0] = 4.0;
  x0[4] = x1[4] = 0.25;
  EXPECT(suffices(extra(still), 3.25));
  x0[0] = 1.0;
  x0[4] = 0.0;
  EXPECT(suffices(extra(still), 3.25));
  x1[0] = 1.0;
  x1[4] = 0.0;
  EXPECT(suffices(extra({0.5, 0.25}), 3.0 * 0.75));
  // Turned by a small angle, either way round, and turning on: the farthest point moves on a circle.
  for (const double sign : {1.0, -1.0}) {
    const double angle = 0.01;
    r[0] = sign * std::cos(0.5 * angle);
    r[2] = sign * std::sin(0.5 * angle);
    w[5] = 0.03;
    EXPECT(suffices(extra(still), reach[0] * 2.0 * std::sin(0.5 * angle) + reach[1] * 0.03));
  }
}

// Balls that touch, far from the origin too, and what is no number.
void check_balls() {
  for (const double far : {0.0, 1.0, 1e9}) {
    const Ball one{{far, far, 0.3}, 0.1}, other{{far, far + 3.0, 4.3}, 4.7};
    EXPECT(may_meet(one, other, 0.2));
    EXPECT(!may_meet(one, other, 0.2 - 1e-3));
  }
  const double nan = std::nan("");
  EXPECT(may_meet({{nan, 0, 0}, 0.1}, {{9, 9, 9}, 0.1}, 0.0));
  EXPECT(may_meet({{0, 0, 0}, nan}, {{9, 9, 9}, 0.1}, 0.0));
}

int main() {
  check_balls();
  check_known_distances();
  const double half = 0.5 * (1.0 - kContactTolerance);
  EXPECT(is_fine({0, 0, 0.0, 1.0}, half, 1.0) && !is_fine({0, 0, 0.0, 1.0}, half * (1.0 + 1e-9), 1.0));
  const FirstContact late{int64_t{1} << 40, 0.5 + 0x1p-40, 0}, first{7, 0.5, 0};
  EXPECT(late.is_after(late.segment, 0.5));
  EXPECT(!late.is_after(late.segment, late.toi));
  EXPECT(first.is_after(6, 1.0));
  EXPECT(!first.is_after(8, 0.0));
  check_obstacles();
  return failed;
}
"""


def test_what_searches_rely_on(tmp_path: Path) -> None:
    """Segment and time within it are compared, not their sum, which is rounded. Points of moving obstacles are nearer
    to their exact places than the margin for that, at both ends of a part and within it. A pair is near only within the
    resolution. Bodies that move by less than what is known of their distance stay apart.
    """
    error = "0x1p-46 * (largest + (1.0 + norm(load_vec3(w))) * reach)"
    run_program(PROGRAM.replace("MARGIN", error), tmp_path)


@pytest.mark.parametrize(("size", "turn"), [(1.0, 0.0), (1e6, 0.5), (2.0, 700.0)])
def test_margins_of_moving_obstacles(size: float, turn: float) -> None:
    mesh = pgccd.Mesh.box([0.1, 0.2, 0.3])
    position = torch.tensor([[[size, 0.0, -size]], [[0.0, size, 2.0 * size]]], dtype=torch.float64)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    motion = pgccd.Trajectory(position, upright, rotation=torch.tensor([[[0.0, turn, 0.0]]], dtype=torch.float64))
    (error,) = pgccd.robots.Obstacles([mesh], motion=motion).columns()[4].tolist()
    assert abs(error / (2.0**-46 * (4.0 * size + (1.0 + turn) * mesh.reach)) - 1.0) < 1e-12
