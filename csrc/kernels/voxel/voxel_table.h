// A sparse grid: voxels by their coordinates.
#pragma once

#include <cmath>
#include <stdexcept>
#include <vector>

#include "kernels/voxel/voxel.h"

namespace pgccd {

class VoxelGrid {
 public:
  explicit VoxelGrid(double voxel_size) : per_length_(1.0 / voxel_size) {}

  // Monotone in the coordinate, rounding included: a point between two others is in a voxel between theirs.
  int32_t along_axis(float coordinate) const {
    const double place = std::floor(static_cast<double>(coordinate) * per_length_);
    if (!(place > -kVoxelLimit && place < kVoxelLimit)) {
      throw std::invalid_argument("voxel_size: too small, more than 2^20 voxels from the world's origin to a body");
    }
    return static_cast<int32_t>(place);
  }

  template <class Use>
  void for_each_touched(const TriangleBox& box, const Use& use) const {
    int32_t first[3], last[3];
    for (int axis = 0; axis < 3; ++axis) {
      first[axis] = along_axis(box.lower[axis]);
      last[axis] = along_axis(box.upper[axis]);
    }
    for (int32_t x = first[0]; x <= last[0]; ++x) {
      for (int32_t y = first[1]; y <= last[1]; ++y) {
        for (int32_t z = first[2]; z <= last[2]; ++z) use(Voxel{x, y, z});
      }
    }
  }

 private:
  double per_length_;
};

// 21 bits per axis, in the order of coordinates, x first.
inline uint64_t voxel_key(Voxel v) {
  const auto bits = [](int32_t place) { return static_cast<uint64_t>(place + kVoxelLimit); };
  return bits(v.x) << 42 | bits(v.y) << 21 | bits(v.z);
}

inline Voxel voxel_of_key(uint64_t key) {
  const auto place = [](uint64_t bits) { return static_cast<int32_t>(bits & (2 * kVoxelLimit - 1)) - kVoxelLimit; };
  return {place(key >> 42), place(key >> 21), place(key)};
}

// Maps voxels to numbers; a hash table with open addressing.
class VoxelTable {
 public:
  struct Entry {
    uint64_t key;
    int64_t value;
  };

  explicit VoxelTable(int64_t expected = 0) {
    size_t size = 64;
    while (size < 2 * static_cast<size_t>(expected)) size *= 2;
    slots_.assign(size, {kEmpty, 0});
  }

  // The voxel's number, initially 0. Valid until the next call.
  int64_t& operator[](uint64_t key) {
    size_t slot = find(key);
    if (slots_[slot].key == kEmpty) {
      if (2 * ++used_ > slots_.size()) {
        grow();
        slot = find(key);
      }
      slots_[slot].key = key;
    }
    return slots_[slot].value;
  }

  // Null if there is none.
  const int64_t* look_up(uint64_t key) const {
    const Entry& entry = slots_[find(key)];
    return entry.key == kEmpty ? nullptr : &entry.value;
  }

  // Unsorted.
  std::vector<Entry> entries() const {
    std::vector<Entry> all;
    for (const Entry& entry : slots_) {
      if (entry.key != kEmpty) all.push_back(entry);
    }
    return all;
  }

 private:
  static constexpr uint64_t kEmpty = ~uint64_t{0};

  size_t find(uint64_t key) const {
    // Multiplication by 2^64 over the golden ratio (Knuth, TAOCP 6.4), whose upper bits are well mixed.
    const uint64_t mixed = key * 0x9e3779b97f4a7c15u;
    size_t slot = (mixed ^ mixed >> 32) & (slots_.size() - 1);
    while (slots_[slot].key != key && slots_[slot].key != kEmpty) slot = (slot + 1) & (slots_.size() - 1);
    return slot;
  }

  void grow() {
    std::vector<Entry> former(2 * slots_.size(), {kEmpty, 0});
    former.swap(slots_);
    for (const Entry& entry : former) {
      if (entry.key != kEmpty) slots_[find(entry.key)] = entry;
    }
  }

  std::vector<Entry> slots_;
  size_t used_ = 0;
};

}  // namespace pgccd
