#include "mesh/hierarchy.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>

#include "core/vec3.h"

namespace pgccd {
namespace {

using Point = std::array<double, 3>;

struct Box {
  Point lower{HUGE_VAL, HUGE_VAL, HUGE_VAL};
  Point upper{-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};

  void include(const Box& other) {
    for (int k = 0; k < 3; ++k) {
      lower[k] = std::min(lower[k], other.lower[k]);
      upper[k] = std::max(upper[k], other.upper[k]);
    }
  }
  double half_area() const {
    const double x = upper[0] - lower[0], y = upper[1] - lower[1], z = upper[2] - lower[2];
    return x * y + y * z + z * x;
  }
};

struct NodeVolume {
  Vec3<float> centre, normal;
  float radius, low, high;
};

class Builder {
 public:
  Builder(const double* vertices, const std::vector<Face>& faces, int leaf_size)
      : vertices_(vertices), faces_(faces), leaf_size_(leaf_size), boxes_(faces.size()) {
    for (size_t f = 0; f < faces.size(); ++f) {
      for (const int32_t v : faces[f]) {
        const Point p{vertices[3 * int64_t(v)], vertices[3 * int64_t(v) + 1], vertices[3 * int64_t(v) + 2]};
        boxes_[f].include({p, p});
      }
    }
    tree_.triangle_order.resize(faces.size());
    std::iota(tree_.triangle_order.begin(), tree_.triangle_order.end(), 0);
  }

  Hierarchy build() {
    split_all();
    fold();
    return std::move(tree_);
  }

 private:
  struct BinaryNode {
    int32_t begin, end;  // triangles
    int32_t child;       // first of two neighbours, or -1
    NodeVolume volume;
  };

  void split_all() {
    struct Task {
      int32_t node, depth;
    };
    binary_.push_back({0, static_cast<int32_t>(faces_.size()), -1, {}});
    std::vector<Task> tasks{{0, 1}};
    while (!tasks.empty()) {
      const Task task = tasks.back();
      tasks.pop_back();
      const int32_t begin = binary_[task.node].begin, end = binary_[task.node].end;
      binary_[task.node].volume = bounding_volume(begin, end);
      if (end - begin <= leaf_size_) continue;
      const int32_t middle = split(begin, end, task.depth);
      const int32_t child = static_cast<int32_t>(binary_.size());
      binary_[task.node].child = child;
      binary_.push_back({begin, middle, -1, {}});
      binary_.push_back({middle, end, -1, {}});
      tasks.push_back({child + 1, task.depth + 1});
      tasks.push_back({child, task.depth + 1});
    }
  }

  // Each block takes the grandchildren of its largest nodes until it is full.
  void fold() {
    struct Task {
      std::vector<int32_t> nodes;  // of the binary tree
      int32_t block;
    };
    tree_.blocks.emplace_back();
    tree_.links.emplace_back();
    std::vector<Task> tasks{{{0}, 0}};
    for (size_t next = 0; next < tasks.size(); ++next) {  // breadth first: parents precede children
      const Task task = tasks[next];
      for (int slot = 0; slot < kBlockWidth; ++slot) {
        if (slot >= static_cast<int>(task.nodes.size())) {
          set_volume(task.block, slot, {{NAN, NAN, NAN}, {NAN, NAN, NAN}, NAN, NAN, NAN});
          tree_.links[task.block][slot] = {0, -1};
          continue;
        }
        const BinaryNode& node = binary_[task.nodes[slot]];
        set_volume(task.block, slot, node.volume);
        if (node.child < 0) {
          tree_.links[task.block][slot] = {node.begin, node.end - node.begin};
          continue;
        }
        tree_.links[task.block][slot] = {static_cast<int32_t>(tree_.blocks.size()), 0};
        tasks.push_back({widen(node.child), static_cast<int32_t>(tree_.blocks.size())});
        tree_.blocks.emplace_back();
        tree_.links.emplace_back();
      }
    }
  }

  // Up to eight descendants that together cover the two siblings starting at `child`.
  std::vector<int32_t> widen(int32_t child) const {
    std::vector<int32_t> nodes{child, child + 1};
    while (nodes.size() < kBlockWidth) {
      int largest = -1;
      for (size_t k = 0; k < nodes.size(); ++k) {
        const bool is_larger = largest < 0 || binary_[nodes[k]].volume.radius > binary_[nodes[largest]].volume.radius;
        if (binary_[nodes[k]].child >= 0 && is_larger) largest = static_cast<int>(k);
      }
      if (largest < 0) break;
      const int32_t opened = binary_[nodes[largest]].child;
      nodes[largest] = opened;
      nodes.insert(nodes.begin() + largest + 1, opened + 1);
    }
    return nodes;
  }

  void set_volume(int32_t block, int slot, const NodeVolume& v) {
    NodeBlock& b = tree_.blocks[block];
    b.x[slot] = v.centre.x;
    b.y[slot] = v.centre.y;
    b.z[slot] = v.centre.z;
    b.radius[slot] = v.radius;
    b.normal_x[slot] = v.normal.x;
    b.normal_y[slot] = v.normal.y;
    b.normal_z[slot] = v.normal.z;
    b.low[slot] = v.low;
    b.high[slot] = v.high;
  }

  // Below this depth the tree halves: 31-bit counts then need at most kMaxTreeDepth levels in all.
  static constexpr int kFreeDepth = kMaxTreeDepth - 32;

  void sort_along(int axis, int32_t begin, int32_t end) {
    std::sort(tree_.triangle_order.begin() + begin, tree_.triangle_order.begin() + end, [&](int32_t p, int32_t q) {
      const double cp = boxes_[p].lower[axis] + boxes_[p].upper[axis],
                   cq = boxes_[q].lower[axis] + boxes_[q].upper[axis];
      return cp != cq ? cp < cq : p < q;
    });
  }

  int32_t split(int32_t begin, int32_t end, int depth) {
    const int32_t count = end - begin;
    double best_cost = HUGE_VAL;
    int best_axis = 0;
    int32_t best_left = count / 2;
    std::vector<double> right_area(count);
    for (int axis = 0; axis < 3; ++axis) {
      sort_along(axis, begin, end);
      Box right;
      for (int32_t k = count - 1; k > 0; --k) {
        right.include(boxes_[tree_.triangle_order[begin + k]]);
        right_area[k] = right.half_area();
      }
      Box left;
      for (int32_t k = 1; k < count; ++k) {
        left.include(boxes_[tree_.triangle_order[begin + k - 1]]);
        if (depth >= kFreeDepth && k != count / 2) continue;
        const double cost = left.half_area() * k + right_area[k] * (count - k);
        if (cost < best_cost) {
          best_cost = cost;
          best_axis = axis;
          best_left = k;
        }
      }
    }
    if (best_axis != 2) sort_along(best_axis, begin, end);
    return begin + best_left;
  }

  // Area-weighted mean of the triangles' normals, or any direction where that vanishes.
  Vec3<float> mean_normal(int32_t begin, int32_t end) const {
    Vec3<double> sum{0.0, 0.0, 0.0};
    for (int32_t k = begin; k < end; ++k) {
      const Face& face = faces_[tree_.triangle_order[k]];
      const Vec3<double> p = load_vec3(vertices_ + 3 * int64_t(face[0]));
      sum =
          sum + cross(load_vec3(vertices_ + 3 * int64_t(face[1])) - p, load_vec3(vertices_ + 3 * int64_t(face[2])) - p);
    }
    const double length = norm(sum);
    return length > 0.0 ? cast<float>((1.0 / length) * sum) : Vec3<float>{0.0f, 0.0f, 1.0f};
  }

  NodeVolume bounding_volume(int32_t begin, int32_t end) const {
    std::vector<int32_t> used;
    for (int32_t k = begin; k < end; ++k) {
      for (const int32_t v : faces_[tree_.triangle_order[k]]) used.push_back(v);
    }
    std::sort(used.begin(), used.end());
    used.erase(std::unique(used.begin(), used.end()), used.end());
    const auto farthest = [&](Vec3<double> centre) {
      std::pair<double, Vec3<double>> far{-1.0, centre};
      for (const int32_t v : used) {
        const Vec3<double> p = load_vec3(vertices_ + 3 * int64_t(v));
        const double squared = norm_squared(p - centre);
        if (squared > far.first) far = {squared, p};
      }
      return far;
    };
    // Towards the smallest enclosing sphere: step k moves 1/(k+1) of the way to the farthest point (Badoiu & Clarkson
    // 2003).
    Vec3<double> centre = load_vec3(vertices_ + 3 * int64_t(used.front()));
    const int steps = used.size() > 1000 ? 24 : 96;
    for (int step = 1; step <= steps; ++step) centre = centre + (1.0 / (step + 1)) * (farthest(centre).second - centre);
    const Vec3<float> rounded = cast<float>(centre);
    const double radius = std::sqrt(farthest(cast<double>(rounded)).first) * (1.0 + 1e-14);
    NodeVolume volume{rounded, mean_normal(begin, end), std::nextafter(static_cast<float>(radius), HUGE_VALF), 0.0f,
                      0.0f};
    double low = HUGE_VAL, high = -HUGE_VAL;
    for (const int32_t v : used) {
      const Vec3<double> x = load_vec3(vertices_ + 3 * int64_t(v)) - cast<double>(rounded);
      const double along = dot(cast<double>(volume.normal), x);
      low = smaller(low, along);
      high = larger(high, along);
    }
    const double slack = 1e-14 * radius;  // more than the rounding of the projection
    volume.low = std::nextafter(static_cast<float>(low - slack), -HUGE_VALF);
    volume.high = std::nextafter(static_cast<float>(high + slack), HUGE_VALF);
    return volume;
  }

  const double* vertices_;
  const std::vector<Face>& faces_;
  int leaf_size_;
  std::vector<Box> boxes_;
  std::vector<BinaryNode> binary_;
  Hierarchy tree_;
};

}  // namespace

Hierarchy build_hierarchy(const double* vertices, const std::vector<Face>& faces, int leaf_size) {
  return Builder(vertices, faces, leaf_size).build();
}

}  // namespace pgccd
