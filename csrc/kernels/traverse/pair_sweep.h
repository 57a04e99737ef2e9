// Selects the local frame by the kind of bodies.
#pragma once

#include <type_traits>

#include "kernels/traverse/deforming_sweep.h"
#include "kernels/traverse/rigid_sweep.h"

namespace pgccd {

template <class Bodies>
using SweepOf = std::conditional_t<std::is_same_v<Bodies, RigidBodies>, RigidSweep, DeformingSweep>;

}  // namespace pgccd
