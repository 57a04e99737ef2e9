// Rows of a scene that name other rows, on the host.
#pragma once

#include <stdexcept>
#include <string>

#include "kernels/arms/arm.h"

namespace pgccd {

// Throws an error that names the column and the first row that names what is not there. chain_size: rows of `chain`.
inline void require_sound(const Arm& arm, int64_t chain_size) {
  const auto refuse = [](const char* column, int64_t row, const char* expected) {
    throw std::invalid_argument(std::string("arm.") + column + ": row " + std::to_string(row) + ": expected " +
                                expected);
  };
  for (int64_t k = 0; k < arm.joint_count; ++k) {
    const Joint& joint = arm.joints[k];
    const bool moves = joint.turns() || joint.slides();
    if (moves ? !is_within(joint.coordinate, arm.coordinate_count) : joint.coordinate != -1) {
      refuse("joints", k, "a coordinate of those given, and -1 if it is fixed");
    }
  }
  for (int64_t body = 0; body <= arm.body_count; ++body) {
    const int64_t begin = arm.chain_begin[body], least = body == 0 ? 0 : arm.chain_begin[body - 1];
    if (begin < least || begin > chain_size) refuse("chain_begin", body, "ascending rows of `chain`");
  }
  for (int64_t row = 0; row < chain_size; ++row) {
    if (!is_within(arm.chain[row], arm.joint_count)) refuse("chain", row, "a joint");
  }
}

inline void require_sound(const ArmScene& scene, int64_t chain_size) {
  const Arm& arm = scene.arm;
  require_sound(arm, chain_size);
  const int64_t count = arm.body_count + scene.obstacles.count;
  const auto refuse = [](const char* column, int64_t row, const char* expected) {
    throw std::invalid_argument(std::string("bodies.") + column + ": row " + std::to_string(row) + ": expected " +
                                expected);
  };
  for (int64_t body = 0; body < count; ++body) {
    if (!is_within(scene.mesh_index[body], scene.meshes.mesh_count)) refuse("mesh_index", body, "a mesh");
  }
  const auto chain_length = [&](int64_t body) {
    return body < arm.body_count ? arm.chain_begin[body + 1] - arm.chain_begin[body] : 0;
  };
  for (int64_t k = 0; k < scene.pair_count; ++k) {
    const ArmPair& pair = scene.pairs[k];
    if (!is_within(pair.first, arm.body_count) || !is_within(pair.second, count) || pair.first == pair.second) {
      refuse("pairs", k, "a body of the robot and another body");
    }
    const bool is_shared = pair.shared <= chain_length(pair.first) && pair.shared <= chain_length(pair.second);
    if (pair.shared < 0 || !is_shared) refuse("pairs", k, "frames that both chains begin with");
  }
}

}  // namespace pgccd
