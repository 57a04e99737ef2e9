#include <algorithm>
#include <vector>

#include "kernels/voxel/voxel_table.h"

namespace pgccd {
namespace {

// Up to this number of boxes all pairs are tested.
constexpr int64_t kMostHomes = 10;
constexpr int64_t kVoxelGrain = 8;

struct PlacedBox {
  float lower[3], upper[3];
  int64_t body, triangle;
};

using BoxRows = std::vector<int32_t>;

struct Bounds {
  float lower[3] = {INFINITY, INFINITY, INFINITY}, upper[3] = {-INFINITY, -INFINITY, -INFINITY};

  void add(const PlacedBox& box) {
    for (int axis = 0; axis < 3; ++axis) {
      lower[axis] = smaller(lower[axis], box.lower[axis]);
      upper[axis] = larger(upper[axis], box.upper[axis]);
    }
  }
};

template <class Box>
bool overlap(const PlacedBox& a, const Box& b) {
  return a.lower[0] <= b.upper[0] && b.lower[0] <= a.upper[0] && a.lower[1] <= b.upper[1] && b.lower[1] <= a.upper[1] &&
         a.lower[2] <= b.upper[2] && b.lower[2] <= a.upper[2];
}

// Finds the pairs of one voxel's boxes. Every bisection assigns a box to one side, its home, by its lower coordinate;
// boxes of the lower side that reach into the upper one are added there as guests. So two overlapping boxes are tested
// once: where the one on the upper side is at home.
class VoxelSearch {
 public:
  VoxelSearch(const VoxelGrid& grid, std::vector<TrianglePair>& found) : grid_(grid), found_(found) {}

  void search(const VoxelContents& contents, int64_t voxel) {
    voxel_ = contents.voxels[voxel];
    boxes_.clear();
    for (int64_t s = contents.first_segment[voxel]; s < contents.first_segment[voxel + 1]; ++s) {
      const BoxSegment& segment = contents.segments[s];
      for (int64_t k = segment.begin; k < segment.begin + segment.count; ++k) {
        const TriangleBox& box = contents.boxes[k];
        PlacedBox placed;
        std::copy(box.lower, box.lower + 3, placed.lower);
        std::copy(box.upper, box.upper + 3, placed.upper);
        placed.body = segment.first_body + box.body;
        placed.triangle = box.triangle;
        boxes_.push_back(placed);
      }
    }
    BoxRows homes(boxes_.size());
    for (size_t k = 0; k < homes.size(); ++k) homes[k] = static_cast<int32_t>(k);
    bisect(std::move(homes), {}, 0);
  }

 private:
  void bisect(BoxRows homes, BoxRows guests, int axis) {
    while (true) {
      if (homes.empty() || are_of_one_body(homes, guests)) return;
      if (static_cast<int64_t>(homes.size()) <= kMostHomes) return test_all(homes, guests);
      int64_t at = 0;
      for (int tries = 0; tries < 3 && at == 0; ++tries, axis = (axis + 1) % 3) at = split(homes, axis);
      if (at == 0) return test_all(homes, guests);  // all have the same lower corner
      const BoxRows upper(homes.begin() + at, homes.end());
      homes.resize(at);
      const Bounds below = bounds_of(homes), above = bounds_of(upper);
      BoxRows guests_above;
      for (const int32_t row : homes) {
        if (overlap(boxes_[row], above)) guests_above.push_back(row);
      }
      size_t kept = 0;
      for (const int32_t row : guests) {
        if (overlap(boxes_[row], above)) guests_above.push_back(row);
        if (overlap(boxes_[row], below)) guests[kept++] = row;
      }
      guests.resize(kept);
      bisect(upper, std::move(guests_above), axis);
    }
  }

  bool are_of_one_body(const BoxRows& homes, const BoxRows& guests) const {
    const int64_t body = boxes_[homes[0]].body;
    const auto is_same = [&](int32_t row) { return boxes_[row].body == body; };
    return std::all_of(guests.begin(), guests.end(), is_same) && std::all_of(homes.begin(), homes.end(), is_same);
  }

  // Partitions by the median, lower boxes first; returns their number, or 0 if all have the same coordinate.
  int64_t split(BoxRows& homes, int axis) const {
    const auto place = [&](int32_t row) { return boxes_[row].lower[axis]; };
    const auto middle = homes.begin() + static_cast<int64_t>(homes.size() / 2);
    std::nth_element(homes.begin(), middle, homes.end(), [&](int32_t a, int32_t b) { return place(a) < place(b); });
    const float median = place(*middle);
    auto at = std::partition(homes.begin(), homes.end(), [&](int32_t row) { return place(row) < median; });
    if (at == homes.begin()) {
      at = std::partition(homes.begin(), homes.end(), [&](int32_t row) { return place(row) == median; });
    }
    return at == homes.end() ? 0 : at - homes.begin();
  }

  Bounds bounds_of(const BoxRows& rows) const {
    Bounds bounds;
    for (const int32_t row : rows) bounds.add(boxes_[row]);
    return bounds;
  }

  void test_all(const BoxRows& homes, const BoxRows& guests) {
    for (size_t k = 0; k < homes.size(); ++k) {
      const PlacedBox& home = boxes_[homes[k]];
      for (size_t other = k + 1; other < homes.size(); ++other) test(home, boxes_[homes[other]]);
      for (const int32_t guest : guests) test(home, boxes_[guest]);
    }
  }

  void test(const PlacedBox& a, const PlacedBox& b) {
    if (!overlap(a, b) || a.body == b.body) return;
    const int32_t place[3] = {voxel_.x, voxel_.y, voxel_.z};
    for (int axis = 0; axis < 3; ++axis) {
      if (grid_.along_axis(larger(a.lower[axis], b.lower[axis])) != place[axis]) return;
    }
    const bool in_order = a.body < b.body;
    const PlacedBox &first = in_order ? a : b, &second = in_order ? b : a;
    found_.push_back({first.body, first.triangle, second.body, second.triangle});
  }

  VoxelGrid grid_;
  std::vector<TrianglePair>& found_;
  Voxel voxel_{};
  std::vector<PlacedBox> boxes_;
};

}  // namespace

void voxel_pairs(const Executor& executor, const VoxelContents& contents,
                 const std::function<TrianglePair*(int64_t)>& make_output) {
  const VoxelGrid grid(contents.voxel_size);
  std::vector<std::vector<TrianglePair>> found(executor.worker_count());
  parallel_chunks(executor, contents.voxel_count, kVoxelGrain, [&](int worker, int64_t begin, int64_t end) {
    VoxelSearch search(grid, found[worker]);
    for (int64_t voxel = begin; voxel < end; ++voxel) search.search(contents, voxel);
  });
  int64_t count = 0;
  for (const auto& part : found) count += static_cast<int64_t>(part.size());
  TrianglePair* out = make_output(count);
  for (const auto& part : found) out = std::copy(part.begin(), part.end(), out);
}

}  // namespace pgccd
