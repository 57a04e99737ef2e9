// A body pair in the search for its distance: points, node centres and directions at a time, relative to the reference
// point of the first body at that time, in float64.
#pragma once

#include "core/centre_arc.h"
#include "kernels/narrow/pair_points.h"

namespace pgccd {

// Where a pair moves in float64, every bound of a distance is wrong by no more than this: the errors of both points,
// and 32 roundings of twice the sum of all lengths that enter it.
PGCCD_HD double distance_rounding(double point_error, double extent) {
  return 2.0 * point_error + 32.0 * Precision<double>::unit * extent;
}

// As `pair_tolerance`, of thickened bodies: a small one with a large margin is not small.
PGCCD_HD double distance_tolerance(const BodyCentres& centres, int64_t i, int64_t j, double tolerance) {
  if (!(tolerance < 0.0)) return tolerance;
  const auto radius = [&](int64_t k) {
    return centres.margin == nullptr ? centres.radius[k] : centres.radius[k] + centres.margin[k];
  };
  return -tolerance * smaller(radius(i), radius(j));
}

template <class Bodies>
class MovingPair;

template <>
class MovingPair<RigidBodies> {
 public:
  static constexpr bool kIsRigid = true;

  struct Pose {
    Mat3<double> turn[2];
    Vec3<double> shift;  // of the second body's origin
  };

  PGCCD_HD MovingPair(const RigidBodies& bodies, int64_t i, int64_t j) : bodies_(bodies), pair_(bodies, i, j) {
    double extent = 2.0 * larger(max_abs(pair_.centre.at_t0), max_abs(pair_.centre.at_t1));
    bool turns = false;
    bend_ = reach_ = 0.0;
    for (int side = 0; side < 2; ++side) {
      const int64_t body = pair_.body[side];
      reach_ += mesh_reach(bodies, body);
      centre_[side] = mesh_centre(bodies, body);
      turns |= pair_.turns(side);
      at_t1_[side] = pair_.orientation[side];
      if (bodies.linear_path) {
        if (pair_.turns(side)) at_t1_[side] = spun(pair_.spin[side], pair_.orientation[side], 1.0);
        continue;
      }
      from_axis_[side] =
          distance_from_axis(pair_.orientation[side], pair_.spin[side], centre_[side]) + bodies.centres.radius[body];
      bend_ += (pair_.spin[side].angle * pair_.spin[side].angle) * from_axis_[side];
    }
    const Vec3<double> travel = pair_.centre.at_t1 - pair_.centre.at_t0;
    is_still_ = !turns && travel.x == 0.0 && travel.y == 0.0 && travel.z == 0.0;
    rounding_ = distance_rounding(pair_.point_error, extent + 2.0 * reach_);
  }

  PGCCD_HD const RigidBodies& bodies() const { return bodies_; }
  PGCCD_HD int64_t body(int side) const { return pair_.body[side]; }
  // Whether neither body moves relative to the other one, except by rounding.
  PGCCD_HD bool is_still() const { return is_still_; }
  // How far points of both bodies are from the reference points at most.
  PGCCD_HD double reach() const { return reach_; }
  PGCCD_HD double rounding() const { return rounding_; }
  PGCCD_HD double point_error() const { return pair_.point_error; }
  // Bound of |x''|, in units of the step, for the offset x of any two points.
  PGCCD_HD double curvature() const { return bend_; }
  PGCCD_HD Spin spin(int side) const { return bodies_.linear_path ? Spin{{0.0, 0.0, 1.0}, 0.0} : pair_.spin[side]; }
  // Bound of the distance of the body's points from its axis.
  PGCCD_HD double from_axis(int side) const { return from_axis_[side]; }
  PGCCD_HD static Vec3<double> reference_point(const Pose& pose, int side) {
    return side == 0 ? Vec3<double>{0.0, 0.0, 0.0} : pose.shift;
  }

  PGCCD_HD Pose pose(double t) const {
    Pose out;
    out.shift = (1.0 - t) * pair_.centre.at_t0 + t * pair_.centre.at_t1;
    for (int side = 0; side < 2; ++side) {
      const Mat3<double>& at_t0 = pair_.orientation[side];
      if (!pair_.turns(side)) {
        out.turn[side] = at_t0;
      } else if (bodies_.linear_path) {
        const double s = 1.0 - t;
        const Mat3<double>& at_t1 = at_t1_[side];
        out.turn[side] = {s * at_t0.r0 + t * at_t1.r0, s * at_t0.r1 + t * at_t1.r1, s * at_t0.r2 + t * at_t1.r2};
      } else {
        out.turn[side] = spun(pair_.spin[side], at_t0, t);
      }
    }
    return out;
  }

  PGCCD_HD Vec3<double> vertex(const Pose& pose, int side, int32_t index) const {
    const int64_t row = bodies_.meshes.offsets[pair_.mesh[side]].vertex + index;
    return placed(pose, side, load_vec3(bodies_.meshes.vertices + 3 * row));
  }
  PGCCD_HD const NodeBlock* blocks(int side) const {
    return bodies_.meshes.node_blocks + bodies_.meshes.offsets[pair_.mesh[side]].block;
  }
  PGCCD_HD Vec3<double> node_centre(const Pose& pose, int side, int32_t block, int slot) const {
    const NodeBlock& b = blocks(side)[block];
    return placed(pose, side, centre_[side] + cast<double>(Vec3<float>{b.x[slot], b.y[slot], b.z[slot]}));
  }
  // A direction of the body (vertices are `turned` by the pose), and one in the frame of the pair seen from the body.
  PGCCD_HD Vec3<double> turned(const Pose& pose, int side, Vec3<double> v) const { return pose.turn[side] * v; }
  PGCCD_HD Vec3<double> pulled_back(const Pose& pose, int side, Vec3<double> d) const {
    const Mat3<double>& m = pose.turn[side];
    return d.x * m.r0 + (d.y * m.r1 + d.z * m.r2);
  }
  // World coordinates of a point at a time.
  PGCCD_HD Vec3<double> in_world(Vec3<double> x, double t) const {
    const BodyCentres& c = bodies_.centres;
    return ((1.0 - t) * load_vec3(c.position_t0 + 3 * body(0)) + t * load_vec3(c.position_t1 + 3 * body(0))) + x;
  }

 private:
  PGCCD_HD static Vec3<double> placed(const Pose& pose, int side, Vec3<double> v) {
    const Vec3<double> x = pose.turn[side] * v;
    return side == 0 ? x : pose.shift + x;
  }

  const RigidBodies& bodies_;
  RigidPair pair_;
  Vec3<double> centre_[2];  // SBV centres, body frame
  Mat3<double> at_t1_[2];   // of linear paths
  double from_axis_[2] = {0.0, 0.0};
  double bend_, reach_, rounding_;
  bool is_still_;
};

template <>
class MovingPair<DeformingBodies> {
 public:
  static constexpr bool kIsRigid = false;

  struct Pose {
    double t;
    Vec3<double> shift;
  };

  PGCCD_HD MovingPair(const DeformingBodies& bodies, int64_t i, int64_t j)
      : bodies_(bodies), body_{i, j}, centre_(relative_centre(bodies.centres, i, j)) {
    double extent = 2.0 * larger(max_abs(centre_.at_t0), max_abs(centre_.at_t1));
    reach_ = bodies.centres.radius[i] + bodies.centres.radius[j];
    extent += 2.0 * reach_;
    // The given vertices are exact; taking the reference point from them and interpolating between both ends are not.
    point_error_ = 8.0 * Precision<double>::unit * extent;
    rounding_ = distance_rounding(point_error_, extent);
  }

  PGCCD_HD const DeformingBodies& bodies() const { return bodies_; }
  PGCCD_HD int64_t body(int side) const { return body_[side]; }
  PGCCD_HD static constexpr bool is_still() { return false; }
  // How far points of both bodies are from the reference points at most.
  PGCCD_HD double reach() const { return reach_; }
  PGCCD_HD double rounding() const { return rounding_; }
  PGCCD_HD double point_error() const { return point_error_; }
  PGCCD_HD static constexpr double curvature() { return 0.0; }
  PGCCD_HD static Vec3<double> reference_point(const Pose& pose, int side) {
    return side == 0 ? Vec3<double>{0.0, 0.0, 0.0} : pose.shift;
  }

  PGCCD_HD Pose pose(double t) const { return {t, (1.0 - t) * centre_.at_t0 + t * centre_.at_t1}; }

  PGCCD_HD Vec3<double> vertex(const Pose& pose, int side, int32_t index) const {
    const int64_t row = bodies_.vertex_begin[body_[side]] + index;
    const BodyCentres& c = bodies_.centres;
    return (1.0 - pose.t) * (load_vec3(bodies_.vertices_t0 + 3 * row) - load_vec3(c.position_t0 + 3 * body_[0])) +
           pose.t * (load_vec3(bodies_.vertices_t1 + 3 * row) - load_vec3(c.position_t1 + 3 * body_[0]));
  }
  PGCCD_HD const NodeBlock* blocks(int side) const { return bodies_.blocks_t0 + bodies_.block_begin[body_[side]]; }
  PGCCD_HD Vec3<double> node_centre(const Pose& pose, int side, int32_t block, int slot) const {
    const auto centre = [&](const NodeBlock* blocks) {
      const NodeBlock& b = blocks[bodies_.block_begin[body_[side]] + block];
      return cast<double>(Vec3<float>{b.x[slot], b.y[slot], b.z[slot]});
    };
    const Vec3<double> x = (1.0 - pose.t) * centre(bodies_.blocks_t0) + pose.t * centre(bodies_.blocks_t1);
    return side == 0 ? x : pose.shift + x;
  }
  PGCCD_HD static Vec3<double> turned(const Pose&, int, Vec3<double> v) { return v; }
  PGCCD_HD static Vec3<double> pulled_back(const Pose&, int, Vec3<double> d) { return d; }
  PGCCD_HD Vec3<double> in_world(Vec3<double> x, double t) const {
    const BodyCentres& c = bodies_.centres;
    return ((1.0 - t) * load_vec3(c.position_t0 + 3 * body_[0]) + t * load_vec3(c.position_t1 + 3 * body_[0])) + x;
  }

 private:
  const DeformingBodies& bodies_;
  int64_t body_[2];
  RelativeCentre centre_;
  double reach_, point_error_, rounding_;
};

}  // namespace pgccd
