// From tensors to the inputs of broad phases.
#pragma once

#include "bind/arguments.h"
#include "kernels/broad/body_volumes.h"
#include "kernels/broad/broad_phase.h"

namespace pgccd::bind {

inline BroadPhaseChoice broad_phase_choice(int64_t broad_phase, int64_t axis) {
  STD_TORCH_CHECK(broad_phase >= 0 && broad_phase < kBroadPhases, "broad_phase: expected a number below ", kBroadPhases,
                  ", got ", broad_phase);
  STD_TORCH_CHECK(axis >= -1 && axis <= 2, "axis: expected 0, 1, 2 or -1 (any), got ", axis);
  return {static_cast<BroadPhase>(broad_phase), static_cast<int>(axis)};
}

inline BroadBodies broad_view(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                              const std::optional<Tensor>& group, const std::optional<Tensor>& mask,
                              const std::optional<Tensor>& world, const std::optional<Tensor>& is_static,
                              const std::optional<Tensor>& elsewhere, const KeptDistance& kept) {
  const double* radii = rows<double>(radius, "radius", {kAnySize});
  const int64_t count = radius.size(0);
  STD_TORCH_CHECK(count < (int64_t{1} << 31), "radius: more than 2^31 - 1 bodies on one device");
  BroadBodies view;
  view.count = count;
  view.centres = {rows<double>(position_t0, "position_t0", {count, 3}),
                  rows<double>(position_t1, "position_t1", {count, 3}), radii, count};
  view.group = optional_column<int64_t>(group, "group", count);
  view.mask = optional_column<int64_t>(mask, "mask", count);
  view.world = optional_column<int32_t>(world, "world", count);
  view.is_static = optional_column<uint8_t>(is_static, "is_static", count);
  view.elsewhere = optional_column<uint8_t>(elsewhere, "elsewhere", count);
  view.separation = kept.separation;
  view.tolerance = kept.tolerance;
  return view;
}

}  // namespace pgccd::bind
