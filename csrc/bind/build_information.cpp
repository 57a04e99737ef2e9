// The build writes build_facts.h, a macro for each value, which only this file includes: it changes with every commit.
#include "bind/build_information.h"

#include <build_facts.h>

namespace pgccd::bind {

std::array<std::pair<const char*, const char*>, 6> build_information() {
  return {{{"version", PGCCD_VERSION},
           {"commit", PGCCD_COMMIT},
           {"sources", PGCCD_SOURCES},
           {"compiler", __VERSION__},
           {"cuda", PGCCD_CUDA},
           {"cuda_architectures", PGCCD_CUDA_ARCHITECTURES}}};
}

}  // namespace pgccd::bind
