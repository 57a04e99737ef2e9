// Certified advancement: the iteration of the narrow phase. At time t the nearest points give directions; each
// direction certifies a further interval as free; t advances to its end, until the primitives are within tolerance or
// the step is over. Every advance is proven, so toi is never late; no other part of the loop affects safety.
#pragma once

#include <type_traits>

#include "kernels/narrow/search_state.h"
#include "kernels/narrow/touching.h"
#include "kernels/narrow/whole_turns.h"

namespace pgccd {

// A search has up to three phases. Most candidates are free, and the first phase shows that for most of them; nearly
// all others end in the second, which also considers the interiors of slender features. The third handles tiny
// features, takes long strides past grazing ones, clears full turns of spinning bodies, and distinguishes near misses
// from touches, which would slow down the other phases.
enum class Phase { kQuick, kPlain, kPatient };
constexpr int kQuickAdvances = 2;
constexpr int kPlainAdvances = 24;
constexpr int kMaxAdvances = 1024;
// Advances used, once within tolerance, to distinguish a near miss from a touch.
constexpr int kMaxRefinements = 64;
// Number of advances between attempts to clear full turns of spinning bodies.
constexpr int kSpinPeriod = 32;

// The distance above the separation at which a search ends: a sixteenth of the tolerance leaves few near misses.
template <class T, class Path>
PGCCD_HD T wanted_distance(const Path& path, const SearchSettings<T>& settings) {
  return settings.tolerance * path.scale() * T(0.0625);
}

// Nothing can be decided below the error of the distance itself.
template <class T>
PGCCD_HD T distance_noise(PairError<T> error) {
  return T(4) * error.point + T(64) * T(Precision<T>::unit) * error.extent;
}

// Continues from `progress`, and stores the state at which it stopped there; or a reset state if the goal was changed.
template <FeatureKind kKind, Phase kPhase, class T, class Path>
PGCCD_HD Outcome<T> advance_in_phase(const Path& path, const SearchSettings<T>& settings, Progress<T>& progress) {
  constexpr bool kIsPatient = kPhase == Phase::kPatient;
  constexpr T unit(Precision<T>::unit);
  const PairError<T> error = path.error();
  T noise = distance_noise(error);
  const T separation = settings.separation * path.scale();
  const T wanted = wanted_distance(path, settings);
  T goal = larger(wanted, noise);

  T t = progress.t;
  FeaturePair<T> now = path.at(t);
  // The plain phase starts like the quick one, so the result does not depend on whether that ran before.
  bool with_slender = kIsPatient || (kPhase == Phase::kPlain && progress.advances >= kQuickAdvances);
  Nearest<T> nearest = nearest_points<kKind>(now, with_slender);
  T distance = norm(nearest.offset);
  if (!(progress.goal < T(0))) {
    goal = progress.goal;
    noise = smaller(noise, goal);
  } else if (settings.nonzero_toi && !(t > T(0)) && distance > separation + noise) {
    goal = smaller(goal, T(0.5) * (distance - separation));
    noise = smaller(noise, goal);
  }
  int advances = progress.advances;
  int most_advances = kPhase == Phase::kQuick ? kQuickAdvances : kPlainAdvances;
  if constexpr (kIsPatient) most_advances = kMaxAdvances + path.more_advances();
  Status if_spent = kIsPatient ? Status::kUnresolved : Status::kOpen;
  bool is_first_goal = true;
  T stride = T(0);
  const auto stop = [&](Status status) -> Outcome<T> {
    progress = is_first_goal ? Progress<T>{t, goal, advances} : Progress<T>{};
    return {status, t, nearest.u, nearest.v};
  };
  const auto free = []() -> Outcome<T> { return {Status::kFree, static_cast<T>(INFINITY), T(0), T(0)}; };
  for (; advances < most_advances; ++advances) {
    if constexpr (kIsPatient) {
      if (if_spent == Status::kUndecided && distance > separation + T(16) * wanted) {
        // The features have passed each other; continue with the original goal.
        goal = larger(wanted, noise);
        if_spent = Status::kUnresolved;
        most_advances = advances + 1 + kMaxAdvances;
      }
    }
    if (!(distance > separation + goal)) {
      if constexpr (kPhase == Phase::kQuick) return stop(Status::kOpen);
      bool is_touch = !(goal > wanted);
      if constexpr (Path::kStraight) {
        is_touch = is_touch && certainly_touch<kKind>(path, t, now, nearest, distance, separation, noise, with_slender);
      } else if (!is_touch) {
        return stop(Status::kUndecided);
      }
      if (is_touch) return stop(Status::kTouch);
      if constexpr (!kIsPatient) return stop(Status::kOpen);
      if (!(distance > separation + noise)) return stop(Status::kUndecided);
      is_first_goal = false;
      goal = noise;
      if_spent = Status::kUndecided;
      most_advances = advances + 1 + kMaxRefinements;
    }
    if (!(t < settings.prune_at)) return stop(Status::kPruned);

    Vec3<T> direction;
    if constexpr (kIsPatient) {
      direction = direction_of(nearest);
    } else {
      const T squared = norm_squared(nearest.direction);
      if (!(squared > T(Precision<T>::smallest_square))) return stop(Status::kOpen);
      direction = (T(1) / square_root(squared)) * nearest.direction;
    }
    const T remaining = T(1) - t;
    const T window = path.window(distance - separation, remaining);
    T t_end = t + window;
    if (!(window < remaining) || !(t_end < T(1))) t_end = T(1);
    const FeaturePair<T> end = path.at(t_end);
    const T duration = t_end - t;
    const T keep_apart = separation + path.deviation(duration) * (T(1) + T(16) * unit);
    T prefix = fixed_direction<kKind>(now, end, direction, keep_apart, error);
    if (prefix < T(1)) prefix = larger(prefix, moving_normal(now, end, keep_apart, error));
    T next = t_end;
    if (!(prefix >= T(1))) next = add_down(t, prefix * duration * (T(1) - T(4) * unit));

    if constexpr (kIsPatient) {
      if (next < T(1) && advances % kSpinPeriod == kPlainAdvances) {
        next = larger(next, free_while_spinning(path, t, direction, separation));
      }
      if (next < t_end) {
        // Longer strides while they succeed.
        stride = T(4) * larger(stride, next - t);
        const T far_time = t + stride < t_end ? t + stride : t_end;
        const FeaturePair<T> far = path.at(far_time);
        const Nearest<T> far_nearest = nearest_points<kKind>(far);
        const T far_duration = far_time - t;
        const T far_apart = separation + path.deviation(far_duration) * (T(1) + T(16) * unit);
        const T turned = turning_direction<kKind>(now, far, direction, direction_of(far_nearest), far_apart, error);
        if (turned >= T(1)) {
          next = far_time;
        } else {
          next = larger(next, add_down(t, turned * far_duration * (T(1) - T(4) * unit)));
        }
        stride = next - t;
      }
    }

    if (!(next < T(1))) return free();
    if (next > t) {
      t = next;
      now = t == t_end ? end : path.at(t);
      if (kPhase == Phase::kPlain && advances + 1 >= kQuickAdvances) with_slender = true;
    } else if (kPhase == Phase::kPlain && !with_slender) {
      with_slender = true;
    } else {
      if constexpr (!kIsPatient) return stop(Status::kOpen);
      break;
    }
    nearest = nearest_points<kKind>(now, with_slender);
    distance = norm(nearest.offset);
  }
  return stop(if_spent);
}

// A separate function, so that its registers and stack are not part of the common phases.
template <FeatureKind kKind, class T, class Path>
PGCCD_HD_RARE Outcome<T> advance_patiently(const Path& path, const SearchSettings<T>& settings, Progress<T> progress) {
  return advance_in_phase<kKind, Phase::kPatient>(path, settings, progress);
}

// True if the first phase certifies that the pair is free until the end, or the time of pruning. Otherwise `progress`
// is the state to continue from.
template <FeatureKind kKind, class T, class Path>
PGCCD_HD bool is_quickly_free(const Path& path, const SearchSettings<T>& settings, Progress<T>& progress) {
  return advance_in_phase<kKind, Phase::kQuick>(path, settings, progress).status != Status::kOpen;
}

// Runs to the end, from the start of the step or from the state left by `is_quickly_free`.
template <FeatureKind kKind, class T, class Path>
PGCCD_HD Outcome<T> advance_to_contact(const Path& path, const SearchSettings<T>& settings, Progress<T> progress) {
  if constexpr (!std::is_same_v<T, DoubleDouble>) {  // few searches need it
    const Outcome<T> outcome = advance_in_phase<kKind, Phase::kPlain>(path, settings, progress);
    if (outcome.status != Status::kOpen) return outcome;
  }
  const Path copy = path;  // so that the other phases may keep the path in registers
  return advance_patiently<kKind>(copy, settings, progress);
}

// Starts at a time before which the pair is known to be free.
template <FeatureKind kKind, class T, class Path>
PGCCD_HD Outcome<T> advance_to_contact(const Path& path, const SearchSettings<T>& settings, T begin = T(0)) {
  return advance_to_contact<kKind>(path, settings, Progress<T>{begin});
}

}  // namespace pgccd
