// Selects the local frame by the kind of bodies.
#pragma once

#include "kernels/traverse/deforming_sweep.h"
#include "kernels/traverse/rigid_sweep.h"

namespace pgccd {

template <class Bodies>
struct SweepOf;
template <>
struct SweepOf<RigidBodies> {
  using type = RigidSweep;
};
template <>
struct SweepOf<DeformingBodies> {
  using type = DeformingSweep;
};

}  // namespace pgccd
