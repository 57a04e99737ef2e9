// Windows of time of a body pair that turns fast, on the host: a node pair is tested only in those in which the pair
// above it may meet.
#pragma once

#include <bit>
#include <cstdint>

#include "kernels/traverse/time_spans.h"

namespace pgccd {

// A bit each, in order of time; of no meaning for pairs that do not turn fast.
using Windows = uint64_t;
constexpr int kWindows = 64;
constexpr Windows kAllWindows = ~Windows{0};

template <class Bits, class Visit>
void for_each_bit(Bits bits, Visit&& visit) {
  for (; bits != 0; bits &= bits - 1) visit(std::countr_zero(bits));
}

template <class Bodies>
int window_length(const PairTree<Bodies>& tree) {
  return (tree.sweep().segment_count + kWindows - 1) / kWindows;
}

// Calls use(window, its segments) in order of time.
template <class Bodies, class Use>
void for_each_window(const PairTree<Bodies>& tree, Windows windows, Use&& use) {
  const int length = window_length(tree), segments = tree.sweep().segment_count;
  for_each_bit(windows, [&](int window) {
    const int begin = window * length, end = smaller(begin + length, segments);
    if (begin < end) use(window, TimeSpan{begin, end});
  });
}

// Windows that do not end before a time of the step.
template <class Bodies>
Windows windows_from(const PairTree<Bodies>& tree, float begin) {
  if (!tree.sweep().turns_fast()) return kAllWindows;
  const double segment = static_cast<double>(begin) / tree.sweep().horizon * tree.sweep().segment_count;
  const int first = static_cast<int>(segment / window_length(tree)) - 1;  // one more, for rounding
  return first <= 0 ? kAllWindows : first >= kWindows ? Windows{1} << (kWindows - 1) : kAllWindows << first;
}

// What follows a span: the next one, its parts (if there are any), or nothing.
enum class Then { kNext, kDivide, kStop };

// Calls use(tree over the span as one segment, span) for spans of a range.
template <class Use>
void walk_spans(const PairTree<RigidBodies>& tree, TimeSpan range, Use&& use) {
  for (SpanWalk walk(range); !walk.is_over();) {
    const SpanTree over(tree, walk.span());
    const Then then = use(over.tree(), walk.span());
    if (then == Then::kStop) return;
    if (then != Then::kDivide || !walk.divide()) walk.next();
  }
}
// Deforming bodies do not turn fast.
template <class Use>
void walk_spans(const PairTree<DeformingBodies>&, TimeSpan, Use&&) {}

}  // namespace pgccd
