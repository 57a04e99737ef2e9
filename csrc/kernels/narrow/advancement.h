// Certified advancement: the interval iteration of the narrow phase. At time t the nearest points propose directions;
// each direction certifies a further stretch of time as free; t moves to its end, and so on, until the primitives are
// within tolerance, or the step is over. Every advance is proven, so the reported time of impact is never late; nothing
// else in the loop can affect safety.
#pragma once

#include <cstdint>

#include "kernels/narrow/touching.h"

namespace pgccd {

// Values of the `status` tensor.
enum class Status : int8_t {
  kFree = 0,
  kTouch = 1,
  kUnresolved = 2,  // iteration budget spent: counts as a contact
  kPruned = 3,      // certainly later than the limit given; never leaves the kernels
  kUndecided = 4,   // within tolerance, but this arithmetic cannot tell a touch from a miss; never leaves the kernels
};

template <class T>
struct SearchSettings {
  T separation;
  T tolerance;       // a contact comes at least this close, beyond the separation
  T prune_at;        // give up (kPruned) once free until this time
  bool nonzero_toi;  // shrink the tolerance rather than answer toi = 0 for a pair that starts further apart than the
                     // separation
};

template <class T>
struct Outcome {
  Status status;
  T toi;  // free before it
  T u, v;
};

// How far a search has come: enough to go on as if it had never stopped.
template <class T>
struct Progress {
  T t = T(0);      // free before it
  T goal = T(-1);  // how near is near enough; negative where that is still to be decided
};

// How long to go on.
enum class Effort {
  kQuickReject,  // kQuickAdvances: most candidates are free, and most of those are seen to be by then
  kFull,         // to the end, from the start or from where a quick rejection stopped
};

constexpr int kQuickAdvances = 2;
constexpr int kMaxAdvances = 1024;
// Spent, once within tolerance, on telling a near miss from a touch.
constexpr int kMaxRefinements = 64;
// From then on strides are taken along turning directions too: nearly all searches have ended before.
constexpr int kPlainAdvances = 8;
// After so many advances each, whole turns of spinning bodies are tried to be cleared at once.
constexpr int kSpinPeriod = 32;

// From `progress` on. Leaves there where it stopped, unless it is free; or nothing, where more would have to be known.
template <bool kEdgeEdge, Effort kEffort, class T, class Path>
PGCCD_HD Outcome<T> advance_to_contact(const Path& path, const SearchSettings<T>& settings, Progress<T>& progress) {
  constexpr T unit(Precision<T>::unit);
  const PairError<T> error = path.error();
  // Below the noise of the distance itself nothing can be told.
  T noise = T(4) * error.point + T(64) * unit * error.extent;
  const T separation = settings.separation * path.scale();
  // A sixteenth of what the caller tolerates leaves few near misses.
  const T wanted = settings.tolerance * path.scale() * T(0.0625);
  T goal = larger(wanted, noise);

  T t = progress.t;
  FeaturePair<T> now = path.at(t);
  Nearest<T> nearest = nearest_points<kEdgeEdge>(now);
  T distance = norm(nearest.offset);
  // Advances made, as if the search had never stopped.
  int advances = progress.goal < T(0) ? 0 : kQuickAdvances;
  int most_advances = kEffort == Effort::kQuickReject ? kQuickAdvances : kMaxAdvances + path.more_advances();
  if (!(progress.goal < T(0))) {
    goal = progress.goal;
    noise = smaller(noise, goal);
  } else if (settings.nonzero_toi && !(t > T(0)) && distance > separation + noise) {
    goal = smaller(goal, T(0.5) * (distance - separation));
    noise = smaller(noise, goal);
  }
  Status if_spent = Status::kUnresolved;
  bool is_first_goal = true;
  T stride = T(0);
  const auto stop = [&](Status status) -> Outcome<T> {
    progress = is_first_goal ? Progress<T>{t, goal} : Progress<T>{};
    return {status, t, nearest.u, nearest.v};
  };
  const auto free = []() -> Outcome<T> { return {Status::kFree, static_cast<T>(INFINITY), T(0), T(0)}; };
  for (; advances < most_advances; ++advances) {
    if (if_spent == Status::kUndecided && distance > separation + T(16) * wanted) {
      // They have passed each other: what comes later is another matter.
      goal = larger(wanted, noise);
      if_spent = Status::kUnresolved;
      most_advances = advances + 1 + kMaxAdvances;
    }
    if (!(distance > separation + goal)) {
      bool is_touch = true;
      if constexpr (Path::kStraight) {
        is_touch = !(goal > wanted) && certainly_touch<kEdgeEdge>(path, t, now, nearest, distance, separation, noise);
      }
      if (is_touch) return stop(Status::kTouch);
      if (!(distance > separation + noise)) return stop(Status::kUndecided);
      is_first_goal = false;
      goal = noise;
      if_spent = Status::kUndecided;
      most_advances = advances + 1 + kMaxRefinements;
    }
    if (!(t < settings.prune_at)) return stop(Status::kPruned);

    const T remaining = T(1) - t;
    const T window = path.window(distance - separation, remaining);
    T t_end = t + window;
    if (!(window < remaining) || !(t_end < T(1))) t_end = T(1);
    const FeaturePair<T> end = path.at(t_end);
    const T duration = t_end - t;
    const T keep_apart = separation + path.deviation(duration) * (T(1) + T(16) * unit);
    const Vec3<T> direction = direction_of(nearest);
    T prefix = fixed_direction<kEdgeEdge>(now, end, direction, keep_apart, error);
    if (prefix < T(1)) prefix = larger(prefix, moving_normal(now, end, keep_apart, error));
    T next = t_end;
    if (!(prefix >= T(1))) next = add_down(t, prefix * duration * (T(1) - T(4) * unit));

    if constexpr (kEffort == Effort::kFull) {
      if (next < T(1) && advances % kSpinPeriod == kQuickAdvances) {
        next = larger(next, path.free_while_spinning(t, direction, separation));
      }
      if (next < t_end && advances >= kPlainAdvances) {
        // Longer strides while they succeed.
        stride = T(4) * larger(stride, next - t);
        const T far_time = t + stride < t_end ? t + stride : t_end;
        const FeaturePair<T> far = path.at(far_time);
        const Nearest<T> far_nearest = nearest_points<kEdgeEdge>(far);
        const T far_duration = far_time - t;
        const T far_apart = separation + path.deviation(far_duration) * (T(1) + T(16) * unit);
        const T turned =
            turning_direction<kEdgeEdge>(now, far, direction, direction_of(far_nearest), far_apart, error);
        if (turned >= T(1)) {
          next = far_time;
        } else {
          next = larger(next, add_down(t, turned * far_duration * (T(1) - T(4) * unit)));
        }
        stride = next - t;
      }
    }

    if (!(next > t)) break;
    if (!(next < T(1))) return free();
    t = next;
    now = t == t_end ? end : path.at(t);
    nearest = nearest_points<kEdgeEdge>(now);
    distance = norm(nearest.offset);
  }
  return stop(if_spent);
}

// From a time before which the pair is known to be free.
template <bool kEdgeEdge, class T, class Path>
PGCCD_HD Outcome<T> advance_to_contact(const Path& path, const SearchSettings<T>& settings, T begin = T(0)) {
  Progress<T> progress{begin};
  return advance_to_contact<kEdgeEdge, Effort::kFull>(path, settings, progress);
}

}  // namespace pgccd
