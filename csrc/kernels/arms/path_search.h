// The search of one path after another on one thread, in memory that is kept between them.
#pragma once

#include <vector>

#include "kernels/arms/certify.h"
#include "kernels/arms/span_item.h"
#include "kernels/pipeline/one_pair.h"

namespace pgccd {

// Where a path is first not free: the times are compared one after the other, since their sum is rounded.
struct FirstContact {
  int64_t segment;
  double toi;
  int64_t pair;  // -1: none is known

  bool is_after(int64_t other_segment, double other_toi) const {
    return segment > other_segment || (segment == other_segment && toi > other_toi);
  }
};

struct PathVerdict {
  Verdict verdict;
  FirstContact first;
  Vec3<double> point;
  int64_t counts[kArmCounts];
};

class PathSearch {
 public:
  PathSearch(const ArmScene& scene, double resolution);

  // `tells_collisions`: whether configurations are looked for in which bodies touch.
  PathVerdict certify(const ArmPaths& paths, int64_t path, bool tells_collisions);

 private:
  // Until when a pair is free over a span, infinite for all of it; and the strays of both bodies, added.
  struct Touch {
    double toi = static_cast<double>(INFINITY), stray = 0.0;
    PairContact contact{};  // of a fine span
  };
  struct Ball {
    Vec3<double> centre;
    double radius;
  };
  struct OpenSpan {
    double begin, end;
  };

  void place_all(const PathSpan& span);
  bool may_meet(const ArmPair& pair) const;
  ArmArc arc_of_obstacle(int64_t body, const PathSpan& span) const;
  Touch touch(const ArmPair& pair, const PathSpan& span);
  std::optional<PairContact> contact_at_rest(const ArmPair& pair, const PathSpan& still, Report report);
  void search_span(const PathSpan& span);
  void search_pair(int64_t pair, const PathSpan& span, const Touch& met);
  void record(int64_t pair, const PathSpan& span, double at, const Touch& met);
  bool starts_with_contact(int64_t path, int64_t pair);
  PathSpan witness(int k) const;
  bool touch_behind();
  void place_pair(const ArmPair& pair, const PathSpan& span, double& stray);
  Vec3<double> point_of(const ArmPair& pair, const PathSpan& span, const PairContact& contact);

  ArmScene scene_;
  ArmPaths paths_{};
  int64_t path_ = 0;
  double resolution_;
  std::vector<double> numbers_;  // of the columns below
  std::vector<int32_t> mesh_index_;
  ArcColumns rows_{};  // of all bodies
  std::vector<JointMotion> joints_;
  std::vector<char> is_placed_;  // by joint
  ArcRows<2> pair_{};
  OnePairSearch one_pair_;
  BroadBodies spheres_{};
  std::vector<double> centres_;
  std::vector<Ball> balls_;  // that contain the bodies over the span
  std::vector<std::pair<int64_t, Touch>> met_;
  std::vector<OpenSpan> open_;
  PathVerdict verdict_{};
};

}  // namespace pgccd
