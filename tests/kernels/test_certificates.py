"""Certificates of the narrow phase against points perturbed by the allowed error in the worst direction."""

from __future__ import annotations

from pathlib import Path

from support.host_program import run_program

# The coplanarity cubic r . (a x b) of features with entries near +-1, whose lengths are sqrt(3) times the largest
# entry; evaluated in long double at the end of the interval that the certificate declares free.
PROGRAM = """
#include <cstdio>
#include <random>
#include "kernels/narrow/certificates.h"

using namespace pgccd;

std::mt19937_64 engine(1);
double uniform(double from, double to) { return std::uniform_real_distribution<double>(from, to)(engine); }
double near_one() { return (engine() % 2 ? 1.0 : -1.0) * uniform(0.9, 1.0); }
Vec3<double> corner() { return {near_one(), near_one(), near_one()}; }

struct Exact {
  long double x, y, z;
};
Exact exact(Vec3<double> v) { return {v.x, v.y, v.z}; }
Exact cross(Exact p, Exact q) { return {p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x}; }
long double dot(Exact p, Exact q) { return p.x * q.x + p.y * q.y + p.z * q.z; }
Exact add(Exact p, Exact q, long double factor = 1) {
  return {p.x + factor * q.x, p.y + factor * q.y, p.z + factor * q.z};
}
Exact with_length(Exact v, long double length) {
  const long double norm = std::sqrt(dot(v, v));
  return norm > 0 ? add({0, 0, 0}, v, length / norm) : v;
}

int main() {
  int tested = 0, late = 0;
  const double point_error = 1e-5;
  for (int k = 0; k < 20000; ++k) {
    const bool edge_edge = k % 2;
    FeaturePair<double> start{corner(), corner(), corner()};
    const Vec3<double> normal = pgccd::cross(start.a, start.b);
    const double squared = norm_squared(normal);
    if (!(squared > 1.0)) continue;
    // From a little above the plane to a little below; up to the error times 100.
    const double height = std::pow(10.0, uniform(-5.0, -3.0));
    start.r = start.r - ((pgccd::dot(start.r, normal) - height) / squared) * normal;
    FeaturePair<double> end = start;
    end.r = end.r - (uniform(1.1, 3.0) * height / squared) * normal;
    // A common shift of a and b in their plane keeps it.
    const Vec3<double> shift = uniform(-0.5, 0.5) * start.a;
    end.b = end.b + shift;
    const PairError<double> error{point_error, 6.0};
    const double prefix = moving_normal(start, end, 0.0, error);
    if (!(prefix > 0.0) || !(prefix < 1.0)) continue;
    ++tested;
    const long double t = prefix;
    const auto at = [&](Vec3<double> p, Vec3<double> q) { return add(exact(p), add(exact(q), exact(p), -1), t); };
    const Exact r = at(start.r, end.r), a = at(start.a, end.a), b = at(start.b, end.b);
    // How the cubic changes with r, a, b, and so with each of the four points.
    const Exact by_r = cross(a, b), by_a = cross(b, r), by_b = cross(r, a);
    const Exact none{0, 0, 0};
    const Exact all = add(by_a, by_b);
    const Exact by_point[4] = {add(add(none, by_r, -1), edge_edge ? by_a : none, -1),
                               edge_edge ? by_a : add(by_r, all, -1),
                               edge_edge ? add(by_r, by_b, -1) : by_a, by_b};
    Exact off[4];
    for (int point = 0; point < 4; ++point) off[point] = with_length(by_point[point], -point_error);
    // Differences as in feature_pair().
    const Exact r_off = edge_edge ? add(off[2], off[0], -1) : add(off[1], off[0], -1);
    const Exact a_off = edge_edge ? add(off[1], off[0], -1) : add(off[2], off[1], -1);
    const Exact b_off = edge_edge ? add(off[3], off[2], -1) : add(off[3], off[1], -1);
    const long double cubic = dot(add(r, r_off), cross(add(a, a_off), add(b, b_off)));
    if (cubic < 0 && ++late < 5) std::printf("prefix %.17g, cubic %Lg\\n", prefix, cubic);
  }
  std::printf("%d tested, %d past the first crossing\\n", tested, late);
  return late > 0 ? 1 : tested > 1000 ? 0 : 2;
}
"""


def test_moving_normal_of_points_with_errors(tmp_path: Path) -> None:
    run_program(PROGRAM, tmp_path, "-O1")
