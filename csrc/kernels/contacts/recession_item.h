// The proof that the features of a contact, and the surfaces around them, come closer by at most `slack` in the rest of
// the step: docs/explanation/exactness.md, section 15. Along one direction n, fixed in the world: if n . (x_b - x_a) of
// all pairs of corners of two sets of triangles stays above a distance, so do the sets. A poor direction proves
// nothing.
#pragma once

#include "kernels/contacts/moving_corners.h"
#include "kernels/contacts/surface_item.h"

namespace pgccd {
namespace contacts_detail {

// Windows of the rest of the step for bodies that turn.
constexpr int kWindows = 16;
// Rounding of the expressions below, relative to the sum of what they add up, before it is projected.
constexpr double kRounding = 0x1p-46;
// Sine of the angle between directions and a plane within which they may be rounded.
constexpr double kSliding = 0x1p-36;
// Sine of the angle within which a direction is the normal of a face.
constexpr double kParallel = 1e-5;
// Faces around a nearest point whose normals are tried as directions.
constexpr int kMostFaces = 8;
// The normal of the surfaces, that of the features and those of faces around both nearest points, both ways.
constexpr int kMostDirections = 1 + 2 + 2 * 2 * kMostFaces;

}  // namespace contacts_detail

// The proof for one contact.
class Recession {
 public:
  // `normal` of the features, from i to j; slack >= 0.
  PGCCD_HD Recession(const Site& site, Vec3<double> normal, double slack)
      : site_(site), normal_(normal), slack_(slack) {
    using contacts_detail::length_of;
    for (int side = 0; side < 2; ++side) {
      axis_[side] = {0.0, 0.0, 0.0};
      angle_[side] = 0.0;
      if (site.paths->kind != PathKind::kArcs) continue;
      const Vec3<double> rotation = load_vec3(site.paths->rotation + 3 * site.body[side]);
      angle_[side] = length_of(rotation);
      axis_[side] = contacts_detail::unit_or_zero(rotation);
      turns_ = turns_ || rotation.x != 0.0 || rotation.y != 0.0 || rotation.z != 0.0;
    }
    gap_ = length_of(site.offset);
    is_apart_ = gap_ > site.noise;
  }

  PGCCD_HD bool is_certain(Surfaces& surfaces) {
    using namespace contacts_detail;
    if (is_apart_) {
      const Pair features{corners_of(0, site_.corner[0]), corners_of(1, site_.corner[1])};
      if (stay(features, unit_or_zero(site_.offset))) return true;
    }
    const Vec3<double> of_surface = surfaces.normal(site_, normal_);
    // How far the surfaces are apart, which edges in flat surfaces are not.
    if (gap_ > 0.0)
      gap_ = smaller(gap_, smaller(height_above(surfaces, 0, of_surface), height_above(surfaces, 1, of_surface)));
    velocity_ = site_.velocity();
    set_later();
    add_direction(of_surface);
    add_direction(normal_);
    add_direction(-normal_);
    // What would pass through one another next to the contact: faces around a vertex or an edge, and the other feature;
    // of two edges both ways.
    for (int side = 0; side < 2; ++side) {
      const FeatureRow feature = site_.feature[side];
      if (feature.what == kFace) continue;
      const FacesAround around = site_.faces_around(feature);
      const int64_t (&beside)[3] = site_.corner[1 - side];
      Pair sets;
      (side == 0 ? sets.other : sets.one) = corners_of(1 - side, beside);
      for (int64_t f = 0; f < around.count; ++f) {
        int64_t face[3];
        for (int k = 0; k < 3; ++k) face[k] = site_.corner_of(side, around[f], k);
        (side == 0 ? sets.one : sets.other) = corners_of(side, face);
        if (!stay_along_some(sets, side, face, beside)) return false;
      }
    }
    return true;
  }

 private:
  struct Pair {
    contacts_detail::MovingCorners one, other;  // of i and of j
  };

  PGCCD_HD_RARE contacts_detail::MovingCorners corners_of(int side, const int64_t (&vertices)[3]) const {
    contacts_detail::MovingCorners corners;
    for (int k = 0; k < 3; ++k) {
      const PathEnds at = site_.ends(side, vertices[k]);
      corners.constant[k] = at.start;
      corners.first[k] = at.end - at.start;
      corners.second[k] = {0.0, 0.0, 0.0};
      if (!(angle_[side] > 0.0)) continue;
      const Vec3<double> axis = axis_[side];
      corners.constant[k] = contacts_detail::dot_of(axis, at.start) * axis;
      corners.first[k] = at.start - corners.constant[k];
      corners.second[k] = cross(axis, corners.first[k]);
    }
    return corners;
  }

  // By the order of corners, at toi; zero without an area.
  PGCCD_HD_RARE Vec3<double> face_normal(int side, const int64_t (&vertices)[3]) const {
    const Vec3<double> a = site_.arm(side, vertices[0]);
    const Vec3<double> b = site_.arm(side, vertices[1]) - a, c = site_.arm(side, vertices[2]) - a;
    return contacts_detail::unit_or_zero(cross(b, c));
  }

  // Of the nearest point and the corners of the other feature above those faces around the nearest point of a side that
  // have the normal of the surfaces, the least of those whose foot is in such a face; inf without one.
  PGCCD_HD double height_above(const Surfaces& surfaces, int side, Vec3<double> of_surface) const {
    using namespace contacts_detail;
    const double sign = side == 0 ? 1.0 : -1.0;
    const Vec3<double> towards = sign * site_.offset;
    Vec3<double> points[4];
    points[0] = towards;
    for (int k = 0; k < 3; ++k) {
      points[k + 1] = towards + (site_.arm(1 - side, site_.corner[1 - side][k]) - site_.nearest[1 - side]);
    }
    double lowest = INFINITY;
    const Ring& ring = surfaces.ring[side];
    for (int64_t f = 0; f < ring.face_count; ++f) {
      const RingFace& face = ring.faces[f];
      if (length_of(cross(face.normal, of_surface)) > 2.0 * kParallel) continue;
      Vec3<double> corner[3];
      for (int k = 0; k < 3; ++k) {
        corner[k] = site_.arm(side, site_.corner_of(side, face.row, k)) - site_.nearest[side];
      }
      const Vec3<double> across = cross(corner[1] - corner[0], corner[2] - corner[0]);
      if (!(length_of(across) > 0.0) || length_of(cross(unit_or_zero(across), of_surface)) > kParallel) continue;
      for (const Vec3<double>& point : points) {
        bool is_over = true;
        for (int k = 0; k < 3; ++k) {
          const Vec3<double> inward = cross(across, corner[(k + 1) % 3] - corner[k]);
          is_over = is_over && dot_of(inward, point - corner[k]) >= 0.0;
        }
        if (is_over) lowest = smaller(lowest, larger(sign * dot_of(of_surface, point), 0.0));
      }
    }
    return lowest;
  }

  // Where the nearest points, which are in all sets, are relative to one another at the end of the step, and of the
  // first window.
  PGCCD_HD void set_later() {
    const double rest = 1.0 - site_.toi;
    later_[0] = later_[1] = site_.offset + rest * velocity_;
    if (!turns_) return;
    const double times[2] = {1.0, time_of(1)};
    for (int k = 0; k < 2; ++k) {
      later_[k] = site_.between + times[k] * site_.change;
      for (int side = 0; side < 2; ++side) {
        const Spin spin{axis_[side], angle_[side]};
        const SineCosine turn = sine_cosine(angle_[side] * (times[k] - site_.toi));
        const Vec3<double> arm = rotate(spin, turn, site_.nearest[side]);
        later_[k] = side == 0 ? later_[k] - arm : later_[k] + arm;
      }
    }
  }

  // Whether sets may stay apart along a direction: not from the other side, if the features are on one, and not if the
  // nearest points themselves certainly do not.
  PGCCD_HD bool is_open(Vec3<double> direction) const {
    using namespace contacts_detail;
    if (!(length_of(direction) > 0.0) || !(dot_of(direction, site_.offset) >= -site_.noise)) return false;
    const double needed = gap_ - slack_;  // without the rounding that `stay` allows for, which is more than that here
    return dot_of(direction, later_[0]) >= needed && dot_of(direction, later_[1]) >= needed;
  }

  PGCCD_HD void add_direction(Vec3<double> direction) {
    if (is_open(direction)) open_[open_count_++] = direction;
  }

  PGCCD_HD void add_faces_around() {
    has_faces_around_ = true;
    for (int side = 0; side < 2; ++side) {
      const FacesAround around = site_.faces_around(site_.support(side));
      for (int64_t f = 0; f < smaller<int64_t>(around.count, contacts_detail::kMostFaces); ++f) {
        int64_t corner[3];
        for (int k = 0; k < 3; ++k) corner[k] = site_.corner_of(side, around[f], k);
        const Vec3<double> normal = face_normal(side, corner);
        add_direction(normal);
        add_direction(-normal);
      }
    }
  }

  // Whether sets stay apart along the normal of the surfaces or of the features, their own ones, or those of faces
  // around the nearest points. `face` is that of a side, `beside` the feature of the other one.
  PGCCD_HD bool stay_along_some(const Pair& sets, int side, const int64_t (&face)[3], const int64_t (&beside)[3]) {
    int tried = 0;
    const auto stay_along_open = [&] {
      while (tried < open_count_) {
        if (stay_along(sets, open_[tried++])) return true;
      }
      return false;
    };
    if (stay_along_open()) return true;
    for (int set = 0; set < 2; ++set) {
      const Vec3<double> normal = set == 0 ? face_normal(side, face) : face_normal(1 - side, beside);
      if (is_open(normal) && stay_along(sets, normal)) return true;
      if (is_open(-normal) && stay_along(sets, -normal)) return true;
    }
    if (!has_faces_around_) add_faces_around();
    return stay_along_open();
  }

  // Along an open direction.
  PGCCD_HD_RARE bool stay_along(const Pair& sets, Vec3<double> along) {
    using namespace contacts_detail;
    if (!stay(sets, along)) return false;
    // Features that coincide were apart before, where they came from, or, if they slide, where the sets are. Sets that
    // came from elsewhere, or slide and are flat, must stay near the plane.
    if (is_apart_ || !(site_.toi > 0.0)) return true;
    const double closing = dot_of(along, -velocity_);
    const bool slides = magnitude(closing) <= kSliding * length_of(velocity_);
    const bool is_sided = slides ? !(apart_at_toi(sets, -along) >= -slack_) : closing > 0.0;
    return is_sided || stay(sets, -along);
  }

  // Whether sets stay at least gap - slack apart along a direction from toi on.
  PGCCD_HD_RARE bool stay(const Pair& sets, Vec3<double> direction) {
    using namespace contacts_detail;
    const double start = dot_of(direction, site_.between), change = dot_of(direction, site_.change);
    const CornersAlong a = CornersAlong::of(sets.one, angle_[0], direction);
    const CornersAlong b = CornersAlong::of(sets.other, angle_[1], direction);
    const double needed = gap_ - slack_;
    const CornersAt a_first = CornersAt::of(a, turned(0, 0), site_.toi);
    const CornersAt b_first = CornersAt::of(b, turned(1, 0), site_.toi);
    const double at_toi = start + change * site_.toi + (b_first.lowest() - a_first.highest());
    if (!(at_toi >= needed)) return false;  // most poor directions end here
    const double size = sum_of_magnitudes(site_.between) + sum_of_magnitudes(site_.change) + sets.one.size(angle_[0]) +
                        sets.other.size(angle_[1]);
    const double error = kRounding * size;
    if (!(at_toi - error >= needed)) return false;
    if (!turns_) {  // lowest at one of the ends
      const CornersAt a_last = CornersAt::of(a, {}, 1.0), b_last = CornersAt::of(b, {}, 1.0);
      return start + change + (b_last.lowest() - a_last.highest()) - error >= needed;
    }
    // Most of those that stay apart along an axis of rotation do so in one window.
    return stay_in_windows(1, a, b, start, change, needed, error) ||
           stay_in_windows(kWindows, a, b, start, change, needed, error);
  }

  // As `stay`, of bodies that turn: by the chord between the ends of windows and by the tangent at their beginning.
  PGCCD_HD_RARE bool stay_in_windows(int count, const contacts_detail::CornersAlong& a,
                                     const contacts_detail::CornersAlong& b, double start, double change, double needed,
                                     double error) {
    using namespace contacts_detail;
    const int wide = kWindows / count;
    const double length = (1.0 - site_.toi) / count;
    CornersAt a_first = CornersAt::of(a, turned(0, 0), site_.toi), b_first = CornersAt::of(b, turned(1, 0), site_.toi);
    double first = start + change * site_.toi;
    for (int begin = 0; begin < kWindows; begin += wide) {
      const double time = time_of(begin + wide), last = start + change * time;
      const CornersAt a_last = CornersAt::of(a, turned(0, begin + wide), time);
      const CornersAt b_last = CornersAt::of(b, turned(1, begin + wide), time);
      const CornersWithin of_a = CornersWithin::of(a, turned(0, begin), a_first, a_last, length);
      const CornersWithin of_b = CornersWithin::of(b, turned(1, begin), b_first, b_last, length);
      const auto chord_of = [&](double at_first, double at_last, double high) {
        return smaller(at_first, at_last) - larger(high, 0.0) * length * length / 8.0;
      };
      // A bound of all pairs, which most windows need no more than.
      const double all = chord_of(first + (b_first.lowest() - a_first.highest()),
                                  last + (b_last.lowest() - a_last.highest()), of_b.highest() - of_a.lowest());
      const bool is_done = all - error >= needed;
      for (int k = 0; k < 3 && !is_done; ++k) {
        for (int m = 0; m < 3; ++m) {
          const double at_first = first + (b_first.value[m] - a_first.value[k]);
          const double at_last = last + (b_last.value[m] - a_last.value[k]);
          if (chord_of(at_first, at_last, of_b.high[m] - of_a.low[k]) - error >= needed) continue;
          const double low = of_b.low[m] - of_a.high[k];
          const double slope = change + of_b.rate[m] - of_a.rate[k];
          const double bottom = smaller(larger(low > 0.0 ? -slope / low : length, 0.0), length);
          // Where the tangent's parabola is concave, its ends are lowest.
          const double tangent = smaller(at_first, at_first + bottom * (slope + 0.5 * low * bottom));
          if (!(tangent - error >= needed)) return false;
        }
      }
      first = last, a_first = a_last, b_first = b_last;
    }
    return true;
  }

  PGCCD_HD double apart_at_toi(const Pair& sets, Vec3<double> direction) {
    using namespace contacts_detail;
    const auto at = [&](int side, const MovingCorners& corners) {
      return CornersAt::of(CornersAlong::of(corners, angle_[side], direction), turned(side, 0), site_.toi);
    };
    const double between = dot_of(direction, site_.between) + dot_of(direction, site_.change) * site_.toi;
    return between + (at(1, sets.other).lowest() - at(0, sets.one).highest());
  }

  // Where a window begins.
  PGCCD_HD double time_of(int window) const {
    return site_.toi + (1.0 - site_.toi) * (static_cast<double>(window) / contacts_detail::kWindows);
  }

  // How far a body has turned at the beginning of a window; computed once for all sets.
  PGCCD_HD SineCosine turned(int side, int window) {
    if (!(angle_[side] > 0.0)) return {0.0, 1.0, 0.0};
    if ((known_[side] >> window & 1u) == 0) {
      known_[side] |= 1u << window;
      turned_[side][window] = sine_cosine(angle_[side] * time_of(window));
    }
    return turned_[side][window];
  }

  const Site& site_;
  Vec3<double> normal_;
  double slack_;
  Vec3<double> axis_[2];
  double angle_[2];
  bool turns_ = false;
  double gap_;
  bool is_apart_;
  Vec3<double> velocity_;
  Vec3<double> later_[2];
  Vec3<double> open_[contacts_detail::kMostDirections];
  int open_count_ = 0;
  bool has_faces_around_ = false;
  uint32_t known_[2] = {0, 0};  // bits of windows
  SineCosine turned_[2][contacts_detail::kWindows + 1];
};

}  // namespace pgccd
