// A query is first solved in the precision of its points; if rounding leaves it undecided, in the next higher one, from
// the time already certified: float, double, double-double. In the last, near misses of inputs of ordinary size are
// distinguished from touches.
#pragma once

#include "kernels/narrow/advancement.h"
#include "kernels/narrow/paths.h"

namespace pgccd {

// Settings of a call; tolerance as in pair_tolerance.
struct NarrowSettings {
  double separation;
  double tolerance;
  bool nonzero_toi;
};

template <class T>
struct Answer {
  Outcome<T> outcome;
  int8_t significant_bits;  // of the precision that decided
};

namespace ladder_detail {

template <class T>
struct Rung;
template <>
struct Rung<float> {
  using Finer = double;
  static constexpr int8_t significant_bits = 24;
};
template <>
struct Rung<double> {
  using Finer = DoubleDouble;
  static constexpr int8_t significant_bits = 53;
};
template <>
struct Rung<DoubleDouble> {
  using Finer = void;
  static constexpr int8_t significant_bits = 106;
};

// Rounded so that it is at least as strict as the caller's tolerance.
template <class T>
PGCCD_HD SearchSettings<T> in_precision(const SearchSettings<double>& settings) {
  return {round_up<T>(settings.separation), round_down<T>(settings.tolerance), round_up<T>(settings.prune_at),
          settings.nonzero_toi};
}

template <class To, class From>
PGCCD_HD Outcome<To> round_outcome(const Outcome<From>& outcome) {
  return {outcome.status, round_down<To>(outcome.toi), static_cast<To>(outcome.u), static_cast<To>(outcome.v)};
}

template <FeatureKind kKind, class T, class Input>
PGCCD_HD_RARE Answer<Input> climb(const Vec3<Input> (&t0)[4], const Vec3<Input> (&t1)[4],
                                  const SearchSettings<double>& settings, T begin);

template <FeatureKind kKind, class T, class Input>
PGCCD_HD Answer<Input> ask(const Vec3<Input> (&t0)[4], const Vec3<Input> (&t1)[4],
                           const SearchSettings<double>& settings, T begin) {
  using Finer = typename Rung<T>::Finer;
  const Vec3<T> start[4] = {cast<T>(t0[0]), cast<T>(t0[1]), cast<T>(t0[2]), cast<T>(t0[3])};
  const Vec3<T> end[4] = {cast<T>(t1[0]), cast<T>(t1[1]), cast<T>(t1[2]), cast<T>(t1[3])};
  Outcome<T> outcome =
      advance_to_contact<kKind>(LinearPath<kKind, T>(start, end, T(0)), in_precision<T>(settings), begin);
  const bool is_open = outcome.status == Status::kUndecided || outcome.status == Status::kUnresolved;
  if constexpr (std::is_void_v<Finer>) {
    if (outcome.status == Status::kUndecided) outcome.status = Status::kTouch;
  } else {
    if (is_open) return climb<kKind, Finer>(t0, t1, settings, Finer(outcome.toi));
  }
  return {round_outcome<Input>(outcome), Rung<T>::significant_bits};
}

template <FeatureKind kKind, class T, class Input>
PGCCD_HD_RARE Answer<Input> climb(const Vec3<Input> (&t0)[4], const Vec3<Input> (&t1)[4],
                                  const SearchSettings<double>& settings, T begin) {
  return ask<kKind, T, Input>(t0, t1, settings, begin);
}

}  // namespace ladder_detail

// Continues in double-double, from a time before which the pair is free. What that leaves undecided counts as a touch.
template <FeatureKind kKind, class Path>
PGCCD_HD Outcome<double> continue_finely(const Path& path, const SearchSettings<double>& settings, double begin) {
  using ladder_detail::in_precision;
  Outcome<DoubleDouble> outcome =
      advance_to_contact<kKind>(path, in_precision<DoubleDouble>(settings), DoubleDouble(begin));
  if (outcome.status == Status::kUndecided) outcome.status = Status::kTouch;
  return ladder_detail::round_outcome<double>(outcome);
}

// The given points, at both ends of straight paths, are exact.
template <FeatureKind kKind, class Input>
PGCCD_HD Answer<Input> solve_straight(const Vec3<Input> (&t0)[4], const Vec3<Input> (&t1)[4],
                                      const SearchSettings<double>& settings) {
  return ladder_detail::ask<kKind, Input>(t0, t1, settings, Input(0));
}

}  // namespace pgccd
