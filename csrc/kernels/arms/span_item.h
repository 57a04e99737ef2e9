// Two bodies over a part of a segment, in their common frame; and what follows from their first contact there.
#pragma once

#include "kernels/arms/kinematics_item.h"
#include "kernels/bounds/moving_box_item.h"
#include "kernels/bounds/moving_sphere_item.h"
#include "kernels/bounds/pose_item.h"
#include "kernels/broad/box_item.h"

namespace pgccd {

// Parts of the resolution: the tolerance of contacts; and the margins aimed at when a span is split.
constexpr double kContactTolerance = 0.125, kWantedMargin = 0.25;
// A span is split into at most so many parts, and not if it is shorter than this part of its segment: then rounding
// decides.
constexpr int kMostParts = 8;
constexpr double kShortestSpan = 0x1p-30;

// The arc of an obstacle during a part of a segment: of the same points at the same times as on the whole arc.
PGCCD_HD ArmArc arc_of_obstacle(const ArmObstacles& obstacles, int64_t obstacle, int64_t path, int64_t segment,
                                double begin, double end) {
  const int64_t row = obstacles.row(path, segment) * obstacles.count + obstacle;
  const Vec3<double> from = load_vec3(obstacles.position_t0 + 3 * row);
  const Quaternion turned = load_quaternion(obstacles.orientation + 4 * row);
  if (!obstacles.move) return {{from, turned}, from, {0.0, 0.0, 0.0}, 0.0};
  const Vec3<double> to = load_vec3(obstacles.position_t1 + 3 * row);
  const Vec3<double> rotation = load_vec3(obstacles.rotation + 3 * row);
  const auto at = [&](double s) { return (1.0 - s) * from + s * to; };
  return {{at(begin), orientation_at(turned, rotation, begin)},
          at(end),
          (end - begin) * rotation,
          obstacles.error[obstacle]};
}

// Rows of bodies, as the stages of detection read them.
template <int kCount>
struct ArcRows {
  double position_t0[3 * kCount], position_t1[3 * kCount], orientation[4 * kCount], rotation[3 * kCount];
  double radius[kCount], margin[kCount];
  int32_t mesh_index[kCount];
};

// Memory of these rows.
struct ArcColumns {
  double *position_t0, *position_t1, *orientation, *rotation, *radius, *margin;
  int32_t* mesh_index;

  PGCCD_HD void store(int64_t row, const ArmArc& arc, const ArmScene& scene, int64_t body) const {
    store_vec3(position_t0 + 3 * row, arc.start.position);
    store_vec3(position_t1 + 3 * row, arc.end);
    orientation[4 * row] = arc.start.orientation.w;
    store_vec3(orientation + 4 * row + 1, arc.start.orientation.v);
    store_vec3(rotation + 3 * row, arc.rotation);
    radius[row] = scene.radius[body];
    margin[row] = arc.stray == 0.0 ? scene.margin[body] : add_up(scene.margin[body], arc.stray);
    mesh_index[row] = scene.mesh_index[body];
  }

  PGCCD_HD RigidBodies bodies(const MeshSetView& meshes, int64_t count) const {
    return {meshes, mesh_index, {position_t0, position_t1, radius, count, margin}, orientation, rotation, false};
  }
};

// A part of a segment of a path.
struct PathSpan {
  int64_t path, segment;
  double begin, end;
};

PGCCD_HD ArmSpan joints_over(const ArmPaths& paths, const Arm& arm, const PathSpan& span) {
  return {curve_of(paths, arm, span.path, span.segment), span.begin, span.end};
}

// Whether a contact over a span, with both bodies' strays added, is an end of the search: the pair comes within the
// resolution there. Other spans are split.
PGCCD_HD bool is_fine(const PathSpan& span, double stray, double resolution) {
  return 2.0 * stray + kContactTolerance * resolution <= resolution || span.end - span.begin <= kShortestSpan;
}

// The time of a contact at `toi` of a span: rounded down, so that it is never late. The pair is free before.
PGCCD_HD double time_of_contact(const PathSpan& span, double toi) {
  if (!(toi > 0.0)) return span.begin;
  return larger((span.begin + toi * (span.end - span.begin)) * (1.0 - 0x1p-50), span.begin);
}

// The number of parts into which a span is split from a time on.
PGCCD_HD int parts_of_rest(const PathSpan& span, double at, double stray, double resolution) {
  const double share = (span.end - at) / (span.end - span.begin);
  const double parts = std::ceil(std::sqrt(stray / (kWantedMargin * resolution)) * share);
  return parts > 2.0 ? static_cast<int>(smaller(parts, static_cast<double>(kMostParts))) : 2;
}

// Edge k of a span that is divided into equal parts.
PGCCD_HD double edge_of_part(double begin, double end, int64_t k, int64_t parts) {
  if (k == 0) return begin;
  return k == parts ? end : begin + (end - begin) * (static_cast<double>(k) / static_cast<double>(parts));
}

// The number of parts into which a segment is split first.
PGCCD_HD int64_t first_parts(const Arm& arm, const JointCurve& segment) {
  return static_cast<int64_t>(larger(std::ceil(most_turn(arm, segment) / (0.99 * kMostTurn)), 1.0));
}

// Whether poses of a segment, whose values are between those of its control points, are computed with the proven
// bounds: by control point k of the path, and where that ends a segment, by the segment.
PGCCD_HD bool is_sound_control(const Arm& arm, const ArmPaths& paths, int64_t path, int64_t k) {
  const double* const q = paths.control + (path * paths.control_count + k) * arm.coordinate_count;
  for (int64_t c = 0; c < arm.coordinate_count; ++c) {
    if (!(magnitude(q[c]) <= kLargestJointValue)) return false;
  }
  double slides = 0.0;
  for (int64_t j = 0; j < arm.joint_count; ++j) {
    const int32_t coordinate = arm.joints[j].coordinate;
    if (coordinate < 0) continue;
    const JointPlace& place = arm.places[j];
    const double largest = magnitude(q[coordinate]) * magnitude(place.scale) + magnitude(place.offset);
    if (!(largest <= kLargestJointValue)) return false;
    if (arm.joints[j].slides()) slides += magnitude(value_of(place, q[coordinate]));
  }
  if (slides > arm.room) return false;
  if (k == 0 || k % paths.degree != 0) return true;
  return most_turn(arm, curve_of(paths, arm, path, k / paths.degree - 1)) <= kLongestTurn;
}

// Whether the poses of resting obstacles of a path are valid; those that move are checked before.
PGCCD_HD bool are_sound_obstacles(const ArmObstacles& obstacles, int64_t path) {
  if (obstacles.move) return true;
  for (int64_t k = 0; k < obstacles.count; ++k) {
    const int64_t row = obstacles.row(path, 0) * obstacles.count + k;
    const RowColumn position{obstacles.position_t0, row + 1, 3, RowCheck::kMagnitude, kLargestCoordinate};
    const RowColumn orientation{obstacles.orientation, row + 1, 4, RowCheck::kUnitLength, kUnitTolerance};
    if (is_invalid(position, row) || is_invalid(orientation, row)) return false;
  }
  return true;
}

}  // namespace pgccd
