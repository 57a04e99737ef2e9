// Grid broad phase: size and origin of the cells, from a sample of the bodies. It affects only the time of the search.
#pragma once

#include "kernels/broad/grid_item.h"
#include "kernels/broad/scene_sample.h"

namespace pgccd {

// Level of a body of unit size: bodies a million times smaller still have levels of their own.
constexpr int kGridUnitLevel = 20;

// Origin in the middle of the scene; a body of mean extent is one cell of level 0 on each axis.
PGCCD_HD GridFrame unit_frame(const double (&mean_middle)[3], const double (&mean_extent)[3]) {
  GridFrame frame;
  for (int k = 0; k < 3; ++k) {
    frame.origin[k] = std::fabs(mean_middle[k]) < 0x1p1000 ? mean_middle[k] : 0.0;
    frame.scale[k] = mean_extent[k] > 0x1p-1000 && mean_extent[k] < 0x1p1000 ? 1.0 / mean_extent[k] : 1.0;
  }
  return frame;
}

// Largest extent of a box in cells of the unit frame.
PGCCD_HD double unit_size(const GridFrame& frame, const SweptBox& box) {
  const Vec3<double> extent = box.upper - box.lower;
  return larger(larger(extent.x * frame.scale[0], extent.y * frame.scale[1]), extent.z * frame.scale[2]);
}

// Sizes modulo powers of two are divided into four classes per octave.
constexpr int kSizeClasses = 4;
PGCCD_HD double class_end(int size_class) {
  return size_class == 0 ? 0.594603557501360533
                         : (size_class == 1 ? 0.707106781186547524 : (size_class == 2 ? 0.840896415253714613 : 1.0));
}

PGCCD_HD int size_class(double size) {
  int exponent = 0;
  const double fraction = std::frexp(size, &exponent);
  int found = 0;
  while (found < kSizeClasses - 1 && fraction > class_end(found)) ++found;
  return found;
}

// The end of a class that, used as cell size, minimises the excess of cells over their bodies (volumes weighted by
// counts): similar sizes should not be on both sides of it.
PGCCD_HD double best_end(const double (&counts)[kSizeClasses]) {
  double best_cost = INFINITY, best = 1.0;
  for (int end = 0; end < kSizeClasses; ++end) {
    double cost = 0.0;
    for (int c = 0; c < kSizeClasses; ++c) {
      const double ratio = class_end(end) / class_end(c) * (c > end ? 2.0 : 1.0);
      cost += counts[c] * ratio * ratio * ratio;
    }
    if (cost < best_cost) {
      best_cost = cost;
      best = class_end(end);
    }
  }
  return best;
}

// The size times a power of two, in (end / 2, end].
PGCCD_HD double folded_size(double size, double end) {
  int exponent = 0;
  const double fraction = std::frexp(size, &exponent);
  return fraction > end ? 0.5 * fraction : fraction;
}

// Cells slightly larger than `cell_size` (in cells of the unit frame), since bodies outside of the sample may be
// larger.
PGCCD_HD GridFrame scaled_frame(GridFrame unit, double cell_size) {
  if (!(cell_size < 0x1p1000)) cell_size = 1.0;
  for (double& scale : unit.scale) scale *= static_cast<double>(1 << kGridUnitLevel) / (cell_size * (1.0 + 1.0 / 64.0));
  return unit;
}

// Called by all threads that share the sample.
template <class Sample>
PGCCD_TARGET GridFrame choose_grid_frame(Sample&& sample, const BroadBodies& bodies) {
  const double weight = sample_weight(bodies.count);
  double mean[6] = {};  // middle, extent
  sample.for_each(bodies, [&](const SweptBox& box) {
    for (int k = 0; k < 3; ++k) {
      mean[k] += weight * component(middle_of(box), k);
      mean[3 + k] += weight * component(box.upper - box.lower, k);
    }
  });
  sample.sum(mean);
  const GridFrame unit = unit_frame({mean[0], mean[1], mean[2]}, {mean[3], mean[4], mean[5]});
  double counts[kSizeClasses] = {};
  sample.for_each(bodies, [&](const SweptBox& box) {
    const int found = size_class(unit_size(unit, box));
    for (int c = 0; c < kSizeClasses; ++c) counts[c] += c == found ? 1.0 : 0.0;
  });
  sample.sum(counts);
  const double end = best_end(counts);
  double cell_size[] = {0.5 * end};
  sample.for_each(bodies, [&](const SweptBox& box) {
    cell_size[0] = larger(folded_size(unit_size(unit, box), end), cell_size[0]);
  });
  sample.maximum(cell_size);
  return scaled_frame(unit, cell_size[0]);
}

}  // namespace pgccd
