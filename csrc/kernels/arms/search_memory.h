// What the search of a path finds, and the memory that it works in.
#pragma once

#include <limits>

#include "kernels/arms/certify.h"
#include "kernels/arms/span_item.h"
#include "kernels/narrow/pair_contact.h"

namespace pgccd {

// Where a path is first not free: segment and time within it are compared one after the other, since their sum is
// rounded.
struct FirstContact {
  int64_t segment;
  double toi;
  int64_t pair;  // -1: none is known

  PGCCD_HD bool is_after(int64_t other_segment, double other_toi) const {
    return segment > other_segment || (segment == other_segment && toi > other_toi);
  }
};

struct PathVerdict {
  Verdict verdict;
  FirstContact first;
  Vec3<double> point;
  int64_t counts[kArmCounts];
};

PGCCD_HD void store_verdict(const PathVerdicts& out, int64_t path, const PathVerdict& found, const ArmScene& scene) {
  const ArmPair none{-1, -1, 0};
  const ArmPair& pair = found.first.pair < 0 ? none : scene.pairs[found.first.pair];
  out.verdict[path] = static_cast<int8_t>(found.verdict);
  out.segment[path] = found.first.segment;
  out.toi[path] = found.first.toi;
  out.bodies[2 * path] = pair.first;
  out.bodies[2 * path + 1] = pair.second;
  store_vec3(out.point + 3 * path, found.point);
  for (int k = 0; k < kArmCounts; ++k) out.counts[kArmCounts * path + k] = found.counts[k];
}

struct PairQuery {
  double tolerance;
  bool tests_start;
  bool any_will_do;  // else the first contact is wanted
};

struct SearchOptions {
  // Whether configurations are looked for in which bodies touch, after a contact.
  bool tells_collisions = true;
  bool any_will_do = false;                              // else the first contact is wanted
  int64_t first_pair = -1;                               // is searched before others; -1: none
  int64_t budget = std::numeric_limits<int64_t>::max();  // of pairs over spans
};

// What `find_touching` returns if no pair touches, or the configuration has no pose.
constexpr int64_t kNoPair = -1, kNoPose = -2;

// A ball around a whole way.
struct Ball {
  Vec3<double> centre;
  double radius;
};

// False only if two balls are certainly further apart than the tolerance; NaN keeps a pair.
PGCCD_HD bool may_meet(const Ball& one, const Ball& other, double tolerance) {
  const double reach = (one.radius + other.radius + tolerance) * (1.0 + 0x1p-40) +
                       0x1p-48 * (max_abs(one.centre) + max_abs(other.centre));
  return !(norm_squared(other.centre - one.centre) > reach * reach);
}

struct OpenSpan {
  double begin, end;
};
// Parts are at most half as long, and are split down to kShortestSpan.
constexpr int kMostOpenSpans = 32 * kMostParts;

// Until when a pair is free over a span: infinite for all of it. Of a fine span also the contact.
struct PairTouch {
  double toi, stray;
  PairContact contact;
};

struct MetPair {
  int64_t pair;  // -1 once it has been searched
  PairTouch touch;
};

// Two bodies, and what says that they stay apart.
struct PairMemory {
  ArcRows<2> rows;
  double stray[2], centres[12], reach[2], point[3];
  MovingBox boxes[2];

  PGCCD_HD ArcColumns columns() {
    return {rows.position_t0, rows.position_t1, rows.orientation, rows.rotation,
            rows.radius,      rows.margin,      rows.mesh_index};
  }
};

// Memory for the bodies and pairs of a scene.
struct SearchMemory {
  ArcColumns rows;
  double* centres;  // (7, bodies): of spheres at both ends, and their radii
  Ball* balls;
  JointMotion* joints;
  char* is_placed;  // (joints,)
  MetPair* met;     // (pairs,)
  OpenSpan* open;   // (kMostOpenSpans,)

  // From a block of bytes(scene), aligned for doubles.
  PGCCD_HD SearchMemory(const ArmScene& scene, char* block) {
    char* next = block;
    lay_out(scene, next);
  }
  PGCCD_HD static int64_t bytes(const ArmScene& scene) {
    char* next = nullptr;
    SearchMemory(scene, nullptr).lay_out(scene, next);
    return next - static_cast<char*>(nullptr);
  }

 private:
  PGCCD_HD void lay_out(const ArmScene& scene, char*& next) {
    const int64_t count = scene.arm.body_count + scene.obstacles.count;
    const auto take = [&]<class T>(T*& column, int64_t size) {
      column = reinterpret_cast<T*>(next);
      next += (size * static_cast<int64_t>(sizeof(T)) + 15) / 16 * 16;
    };
    take(rows.position_t0, 3 * count);
    take(rows.position_t1, 3 * count);
    take(rows.orientation, 4 * count);
    take(rows.rotation, 3 * count);
    take(rows.radius, count);
    take(rows.margin, count);
    take(rows.mesh_index, count);
    take(centres, 7 * count);
    take(balls, count);
    take(joints, scene.arm.joint_count);
    take(is_placed, scene.arm.joint_count);
    take(met, scene.pair_count);
    take(open, kMostOpenSpans);
  }
};

}  // namespace pgccd
