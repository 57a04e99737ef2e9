// What this library was built from, and by what.
#pragma once

#include <array>
#include <utility>

namespace pgccd::bind {

// (name, value): version, commit, sources, compiler, cuda, cuda_architectures.
std::array<std::pair<const char*, const char*>, 6> build_information();

}  // namespace pgccd::bind
