// Samples of the support functions of a hierarchy's nodes.
#pragma once

#include <array>
#include <vector>

#include "mesh/hierarchy.h"

namespace pgccd {

// One row per block; empty slots hold zeros. `vertices`: those of which the hierarchy was built.
std::vector<std::array<NodeSupport, kBlockWidth>> sample_supports(const Hierarchy& tree, const double* vertices);

}  // namespace pgccd
