// A pair of rigid bodies in its local frame.
#pragma once

#include "core/centre_arc.h"
#include "kernels/traverse/sweep_frame.h"

namespace pgccd {

// Bounds of the path of the second body's SBV centre relative to the first's. If both are at their bodies' origins it
// is straight, and all members except the offset are zero.
struct CentrePath {
  double offset;                     // bound of its coordinates during the step
  double from_axis[2] = {0.0, 0.0};  // of each centre: distance from the axis through the origin
  double rounding = 0.0;  // of the computed centres, plus the distance that the narrow phase treats as touching

  PGCCD_HD CentrePath(const RigidBodies& bodies, int64_t i, int64_t j) {
    const RelativeCentre origins = relative_centre(bodies.centres, i, j);
    offset = sweep_detail::largest_coordinate(origins);
    if (bodies.meshes.centres == nullptr) return;
    RelativeCentre centres = origins;
    const int64_t body[2] = {i, j};
    double bulge = 0.0, point_error = 0.0, reach = 0.0;
    bool is_straight = true;
    for (int side = 0; side < 2; ++side) {
      const Vec3<double> centre = mesh_centre(bodies, body[side]);
      const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body[side]));
      const double its_reach = mesh_reach(bodies, body[side]);
      reach = larger(reach, its_reach);
      point_error += (kRigidPointUnits + 8.0 * spin.angle) * Precision<double>::unit * its_reach;
      if (is_centred(centre)) continue;
      is_straight = false;
      const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body[side]));
      const double sign = side == 0 ? -1.0 : 1.0;
      const Vec3<double> start = at_t0 * centre;
      centres.at_t0 = centres.at_t0 + sign * start;
      centres.at_t1 = centres.at_t1 + sign * rotate(spin, sine_cosine(spin.angle), start);
      from_axis[side] = distance_from_axis(at_t0, spin, centre);
      if (!bodies.linear_path) bulge += arc_bulge(spin.angle, from_axis[side]);
    }
    if (is_straight) return;
    offset = sweep_detail::largest_coordinate(centres) + bulge;
    // As in the narrow phase, which treats a distance below 4 point errors and 64 units of the extent as touching; and
    // once more the error of points, for the centres.
    const double apart = sweep_detail::largest_coordinate(origins);
    point_error += 8.0 * Precision<double>::unit * apart;
    rounding = 5.0 * point_error + 64.0 * Precision<double>::unit * (6.0 * (3.0 * reach + apart));
    offset += rounding;
  }
};

struct alignas(16) RigidSweep : PairFrame {
  float inflation;  // distance to keep, chord deviation and rounding, local units
  float growth[2];  // see `slab_growth`
  int segment_count;
  float start_distance;
  float segment_deviation;  // of the chords of one segment, local units

  // `least_segments`: so many segments or more, whatever the motion.
  PGCCD_HD RigidSweep(const RigidBodies& bodies, int64_t i, int64_t j, const SweepSettings& settings, double until,
                      int least_segments = 1)
      : RigidSweep(bodies, i, j, settings, until, least_segments, CentrePath(bodies, i, j)) {}

  PGCCD_HD RigidSweep(const RigidBodies& bodies, int64_t i, int64_t j, const SweepSettings& settings, double until,
                      int least_segments, const CentrePath& path)
      : PairFrame(bodies, i, j, until, path.offset) {
    const BodyCentres& centres = bodies.centres;
    segment_count = least_segments;
    double deviation = 0.0;
    if (!bodies.linear_path) {
      const double ri = centres.radius[i], rj = centres.radius[j];
      const double turn_i = norm_squared(load_vec3(bodies.rotation + 3 * i));
      const double turn_j = norm_squared(load_vec3(bodies.rotation + 3 * j));
      // The distance of a body's points from its axis, which goes through its origin, is at most:
      const double rho_i = path.from_axis[0] + ri, rho_j = path.from_axis[1] + rj;
      const double bend = 0.125 * (horizon * horizon) * (turn_i * rho_i + turn_j * rho_j);
      // Chords may deviate by a fiftieth of the smaller body; with the largest segment count they may deviate further,
      // which is still covered. It is in proportion to the turn, however small a body is. A body may be a point.
      const double size_i = size_of(centres, i), size_j = size_of(centres, j);
      const double size = larger(smaller(size_i, size_j), 0x1p-10 * larger(size_i, size_j));
      const double wanted = std::sqrt(bend / (0.02 * size));
      const double most =
          sweep_detail::most_segments(horizon * std::sqrt(larger(turn_i, turn_j)), settings.divides_time);
      if (wanted > segment_count) {
        segment_count = larger(segment_count, static_cast<int>(std::ceil(smaller(wanted, most))));
      }
      deviation = bend / (static_cast<double>(segment_count) * segment_count);
    }
    const double distance = sweep_detail::kept_distance(centres, i, j, settings) + deviation + path.rounding;
    inflation = sweep_detail::rounded_up(scale * distance) + kLocalRounding;
    segment_deviation = sweep_detail::rounded_up(scale * deviation);
    start_distance = sweep_detail::start_distance(settings, scale * path.rounding);
    for (int side = 0; side < 2; ++side) {
      const double angle = norm(load_vec3(bodies.rotation + 3 * body[side]));
      const double whole_change = smaller(angle, 2.0), change = smaller(horizon * angle / segment_count, 2.0);
      growth[side] = sweep_detail::rounded_up(bodies.linear_path ? 1.5 * horizon * whole_change : 0.5 * change);
    }
  }

  // A rigid body keeps its distances from itself.
  static constexpr bool may_be_one_body = false;
  static constexpr bool has_supports = true;
  static constexpr bool may_turn_fast = true;
  PGCCD_HD static constexpr bool is_one_body() { return false; }

  // More segments than have their poses stored: see time_spans.h.
  PGCCD_HD bool turns_fast() const { return segment_count > kStoredSegments; }
  // The last boundary of which the pose is stored.
  PGCCD_HD int last_pose() const { return turns_fast() ? 1 : segment_count; }

  // As a sweep with a single segment as long as so many. Chords deviate with the square of their duration.
  PGCCD_HD RigidSweep over(int segments) const {
    RigidSweep out = *this;
    const float length = static_cast<float>(segments);
    out.segment_count = 1;
    out.inflation = (inflation + (length * length - 1.0f) * segment_deviation) * (1.0f + 8.0f * Precision<float>::unit);
    for (float& its_growth : out.growth) {
      its_growth = smaller(length * its_growth, 1.0f) * (1.0f + 8.0f * Precision<float>::unit);
    }
    return out;
  }

  // Segment boundary k of segment_count.
  PGCCD_HD LocalPose pose(const RigidBodies& bodies, int k) const {
    const RelativeCentre origins = relative_centre(bodies.centres, body[0], body[1]);
    const double t = horizon * (static_cast<double>(k) / segment_count);
    Vec3<double> shift = (1.0 - t) * origins.at_t0 + t * origins.at_t1;
    LocalPose out;
    for (int side = 0; side < 2; ++side) {
      const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body[side]));
      const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body[side]));
      Mat3<double> at_t = at_t0;
      if (k > 0)
        at_t = bodies.linear_path ? sweep_detail::blend(at_t0, spun(spin, at_t0, 1.0), t) : spun(spin, at_t0, t);
      out.of[side] = sweep_detail::scaled(scale, at_t);
      const Vec3<double> centre = mesh_centre(bodies, body[side]);
      if (!is_centred(centre)) shift = side == 0 ? shift - at_t * centre : shift + at_t * centre;
    }
    sweep_detail::set_shift(out.of[1], cast<float>(scale * shift));
    return out;
  }

  // Centre of a node relative to the SBV centre, body axes; the same at both ends of a segment.
  PGCCD_HD Vec3<float> node_centre(int side, int32_t block, int slot, int) const {
    const NodeBlock& b = blocks[side][block];
    return {b.x[slot], b.y[slot], b.z[slot]};
  }

  // Relative to the SBV centre, body axes -> local frame.
  template <class T>
  PGCCD_HD static Vec3<T> place(const Placement& p, Vec3<T> v) {
    return sweep_detail::shifted(p, sweep_detail::turned(p, v));
  }

  // Mean over both ends of a segment of a unit vector of the body, in the local frame.
  PGCCD_HD Vec3<float> mean_of_turned(const Placement& start, const Placement& end, Vec3<float> direction) const {
    return (0.5f * inverse_scale) * sweep_detail::turned_by_sum(start, end, direction);
  }

  // Extra thickness of a slab along the mean of its normals n0 and n1 at both ends of a segment, in units of the node's
  // radius. For rotations half of |n1 - n0|, since the mean differs from each by that; and |n1 - n0| is at most the
  // angle of the segment, and at most 2. With straight vertex paths up to a horizon h, offsets at the end are blends of
  // offsets under both rotations of the whole step, n1 = n0 + h (m - n0) is not the normal m of one, and the blend of
  // both excesses is |m - n0| (3/2 h - h^2) <= 3/2 h |m - n0|.
  PGCCD_HD float slab_growth(int side) const { return growth[side]; }

  // One of eight vertices of a leaf, or (T = Float8) all eight; relative to the SBV centre, body axes. They are the
  // same at both ends of a segment.
  template <class T>
  PGCCD_HD static Vec3<T> leaf_points(const RigidBodies&, const LeafPoints& points, int, int slot, int) {
    return {load<T>(points.x + slot), load<T>(points.y + slot), load<T>(points.z + slot)};
  }

  // The direction in body axes: its dot product with v is that of `direction` with the rotated v.
  template <class T>
  PGCCD_HD static Vec3<T> pulled_back(const Placement& p, Vec3<T> direction) {
    const auto along = [&](float x, float y, float z) { return direction.x * x + direction.y * y + direction.z * z; };
    const Vec3<float>&x = p.x.axis, &y = p.y.axis, &z = p.z.axis;
    return {along(x.x, y.x, z.x), along(x.y, y.y, z.y), along(x.z, y.z, z.z)};
  }

  // Corners of one triangle, or (T = Float8) of eight successive ones.
  template <class T>
  PGCCD_HD Corners<T> corners(const RigidBodies& bodies, int side, int32_t triangle, int) const {
    const CornerColumns& columns = bodies.meshes.corners;
    int64_t row = first_face[side] + triangle;
    if (columns.leaves_out_points) {
      const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body[side]];
      row = rows[0].corners + triangle;
      if (row >= rows[1].corners) return corners_of_points<T>(bodies, side, triangle);
    }
    const auto column = [&](int index) { return load<T>(columns.first + index * columns.stride + row); };
    Corners<T> out;
    for (int c = 0; c < 3; ++c) out.corner[c] = {column(3 * c), column(3 * c + 1), column(3 * c + 2)};
    return out;
  }

 private:
  // Of points, which have no rows of corners. Lanes beyond the last one repeat it.
  template <class T>
  PGCCD_HD Corners<T> corners_of_points(const RigidBodies& bodies, int side, int32_t triangle) const {
    const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body[side]];
    const Vec3<double> centre = mesh_centre(bodies, body[side]);
    const auto point = [&](int64_t element) {
      const int64_t row = smaller(rows[0].face + element, rows[1].face - 1);
      const int64_t vertex = rows[0].vertex + bodies.meshes.triangles[row].vertex[0];
      return cast<float>(load_vec3(bodies.meshes.vertices + 3 * vertex) - centre);
    };
    Vec3<T> at;
    if constexpr (sizeof(T) == sizeof(float)) {
      at = point(triangle);
    } else {
      for (int lane = 0; lane < kLanes; ++lane) {
        const Vec3<float> x = point(int64_t{triangle} + lane);
        at.x[lane] = x.x;
        at.y[lane] = x.y;
        at.z[lane] = x.z;
      }
    }
    return {{at, at, at}};
  }
};

}  // namespace pgccd
