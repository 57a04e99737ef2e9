// Time of a body pair that turns fast. It has too many segments to keep poses at all their boundaries, and to test each
// node pair over each of them. Spans of several segments are tested first, with the deviation of their longer chords;
// one over which nodes may meet is divided, down to single segments.
#pragma once

#include "kernels/traverse/pair_item.h"

namespace pgccd {

// Segments [begin, end), from boundary `begin` to boundary `end`.
struct TimeSpan {
  int begin, end;

  PGCCD_HD int length() const { return end - begin; }
};

// Visits the spans of a range in order of time.
class SpanWalk {
 public:
  PGCCD_HD explicit SpanWalk(TimeSpan range) : range_(range), at_(range.begin) {}

  PGCCD_HD bool is_over() const { return at_ >= range_.end; }
  PGCCD_HD TimeSpan span() const { return {at_, smaller(at_ + length_, range_.end)}; }
  // Divides the span; false if it is a single segment.
  PGCCD_HD bool divide() {
    const int length = span().length();
    if (length == 1) return false;
    while (length_ >= length) length_ /= kParts;
    return true;
  }
  // Goes on behind the span.
  PGCCD_HD void next() {
    at_ = span().end;
    while (length_ < kLongest && (at_ - range_.begin) % (kParts * length_) == 0) length_ *= kParts;
  }

  // Chords of four times the length deviate sixteen times as far, those of the longest spans by about five radii of the
  // smaller body.
  static constexpr int kParts = 4, kLongest = 16;

 private:
  TimeSpan range_;
  int at_, length_ = kLongest;
};

// A pair of rigid bodies over a span, as a pair with a single segment.
class SpanTree {
 public:
  PGCCD_HD SpanTree(const PairTree<RigidBodies>& tree, TimeSpan span)
      : bodies_(tree.bodies()),
        sweep_(tree.sweep().over(span.length())),
        poses_{tree.sweep().pose(bodies_, span.begin), tree.sweep().pose(bodies_, span.end)} {}

  PGCCD_HD PairTree<RigidBodies> tree() const { return {bodies_, sweep_, poses_}; }

 private:
  const RigidBodies& bodies_;
  RigidSweep sweep_;
  LocalPose poses_[2];
};

}  // namespace pgccd
