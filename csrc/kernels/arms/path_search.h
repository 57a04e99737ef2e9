// The search of one path after another on one thread, in memory that is kept between them.
#pragma once

#include <vector>

#include "kernels/arms/certify.h"
#include "kernels/arms/span_item.h"
#include "kernels/pipeline/pipeline.h"

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
  // The first contact of a pair over a span, and its margins for straying.
  struct Touch {
    bool found = false;
    double toi = 0.0, stray = 0.0;
    Vec3<double> point{};  // in the frame of the pair
  };
  enum class Find { kFirst, kAny };
  struct OpenSpan {
    double begin, end;
  };

  void place_all(const PathSpan& span);
  bool may_meet(const ArmPair& pair) const;
  Touch touch(const ArmPair& pair, const PathSpan& span, Find find, double tolerance);
  void search_span(const PathSpan& span);
  void search_pair(int64_t pair, const PathSpan& span, const Touch& met);
  void record(int64_t pair, const PathSpan& span, double at, const Touch& met);
  bool starts_with_contact(const PathSpan& span, int64_t pair);
  bool touches_near(int64_t segment, double toi);
  bool any_touches(const PathSpan& still);
  Vec3<double> to_world(int32_t frame, Vec3<double> point, const PathSpan& span, double s) const;

  ArmScene scene_;
  ArmPaths paths_{};
  int64_t path_ = 0;
  double resolution_;
  std::vector<double> numbers_;  // of the columns below
  std::vector<int32_t> mesh_index_;
  ArcColumns rows_{};
  BroadBodies spheres_{};
  std::vector<double> centres_;
  std::vector<std::pair<int64_t, Touch>> met_;
  std::vector<OpenSpan> open_;
  PathVerdict verdict_{};
};

}  // namespace pgccd
