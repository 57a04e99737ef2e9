#include "mesh/hierarchy.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "core/vec3.h"
#include "mesh/point_columns.h"

namespace pgccd {
namespace {

struct Box {
  Double4 lower{HUGE_VAL, HUGE_VAL, HUGE_VAL, HUGE_VAL};
  Double4 upper{-HUGE_VAL, -HUGE_VAL, -HUGE_VAL, -HUGE_VAL};

  void include(const Box& other) {
    lower = other.lower < lower ? other.lower : lower;
    upper = upper < other.upper ? other.upper : upper;
  }
  double half_area() const {
    const Double4 extent = upper - lower;
    return extent[0] * extent[1] + extent[1] * extent[2] + extent[2] * extent[0];
  }
};

struct NodeVolume {
  Vec3<float> centre, normal;
  float radius, low, high;
};

class Builder {
 public:
  Builder(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces, int leaf_size)
      : vertices_(vertices),
        faces_(faces),
        leaf_size_(leaf_size),
        boxes_(faces.size()),
        node_of_vertex_(static_cast<size_t>(vertex_count), -1),
        is_left_(faces.size()),
        right_area_(faces.size()) {
    for (size_t f = 0; f < faces.size(); ++f) {
      for (const int32_t v : faces[f]) {
        const double* const p = vertices + 3 * int64_t{v};
        const Double4 point{p[0], p[1], p[2], 0.0};
        boxes_[f].include({point, point});
      }
    }
    tree_.triangle_order.resize(faces.size());
    std::iota(tree_.triangle_order.begin(), tree_.triangle_order.end(), 0);
    for (int axis = 0; axis < 3; ++axis) sort_along(axis);
  }

  Hierarchy build() {
    split_all();
    fold();
    return std::move(tree_);
  }

 private:
  struct BinaryNode {
    int32_t begin, end;                          // triangles
    int32_t child;                               // first of two consecutive nodes, or -1
    int32_t first_points = 0, points_count = 0;  // of leaves
    NodeVolume volume{};
  };

  struct Split {
    int axis;
    int32_t middle;
  };

  // A node of the binary tree that has no volume yet.
  struct Task {
    int32_t node, depth;
    const std::vector<int32_t>* order;  // order of its triangles
    std::vector<int32_t> vertices;      // vertices of its parent, ascending
  };

  struct PendingVolume {
    int32_t node;
    Vec3<float> normal;
    PointColumns points;
  };
  static constexpr int kVolumesAtOnce = 4;

  void split_all() {
    const int32_t count = static_cast<int32_t>(faces_.size());
    binary_.push_back({0, count, -1});
    std::vector<int32_t> all(node_of_vertex_.size());
    std::iota(all.begin(), all.end(), 0);
    const std::vector<int32_t> as_given = tree_.triangle_order;
    std::vector<Task> tasks;
    tasks.push_back({0, 1, &as_given, std::move(all)});
    while (!tasks.empty()) {
      Task task = std::move(tasks.back());
      tasks.pop_back();
      const int32_t begin = binary_[task.node].begin, end = binary_[task.node].end;
      keep_vertices_of_node(task);
      add_volume(task);
      if (end - begin <= leaf_size_) {
        std::copy(task.order->begin() + begin, task.order->begin() + end, tree_.triangle_order.begin() + begin);
        add_leaf_points(task);
        continue;
      }
      const Split split = best_split(begin, end, task.depth);
      partition_orders(begin, end, split);
      const int32_t child = static_cast<int32_t>(binary_.size());
      binary_[task.node].child = child;
      binary_.push_back({begin, split.middle, -1});
      binary_.push_back({split.middle, end, -1});
      tasks.push_back({child + 1, task.depth + 1, &along_[split.axis], task.vertices});
      tasks.push_back({child, task.depth + 1, &along_[split.axis], std::move(task.vertices)});
    }
    set_pending_volumes();
  }

  // Folds the binary tree into blocks.
  void fold() {
    plan_blocks();
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
          tree_.links[task.block][slot] = {0, -1, 0, 0};
          continue;
        }
        const BinaryNode& node = binary_[task.nodes[slot]];
        set_volume(task.block, slot, node.volume);
        if (node.child < 0) {
          tree_.links[task.block][slot] = {node.begin, node.end - node.begin, node.first_points, node.points_count};
          continue;
        }
        tree_.links[task.block][slot] = {static_cast<int32_t>(tree_.blocks.size()), 0, 0, 0};
        tasks.push_back({{}, static_cast<int32_t>(tree_.blocks.size())});
        add_descendants(task.nodes[slot], kBlockWidth, tasks.back().nodes);
        tree_.blocks.emplace_back();
        tree_.links.emplace_back();
      }
    }
  }

  // How a node is represented by at most k slots of a block: by itself, or by its descendants, of which its first
  // child's take slots_of_first[k] (0: by itself). `cost[k]`: of all blocks below.
  struct Folding {
    std::array<double, kBlockWidth + 1> cost{};
    std::array<int8_t, kBlockWidth + 1> slots_of_first{};
  };

  // Minimises the total cost of all blocks by dynamic programming (Ylitie, Karras & Laine 2017). A block is tested
  // about as often as other bodies reach the node that it belongs to: in proportion to the area of the node's sphere.
  void plan_blocks() {
    foldings_.resize(binary_.size());
    for (size_t n = binary_.size(); n-- > 0;) {  // children follow their parents
      const BinaryNode& node = binary_[n];
      if (node.child < 0) continue;
      const Folding &first = foldings_[node.child], &second = foldings_[node.child + 1];
      Folding& folding = foldings_[n];
      for (int k = 2; k <= kBlockWidth; ++k) {
        folding.cost[k] = HUGE_VAL;
        for (int j = 1; j < k; ++j) {
          const double cost = first.cost[j] + second.cost[k - j];
          if (!(cost < folding.cost[k])) continue;
          folding.cost[k] = cost;
          folding.slots_of_first[k] = static_cast<int8_t>(j);
        }
      }
      const double radius = node.volume.radius;
      folding.cost[1] = radius * radius + folding.cost[kBlockWidth];
      for (int k = 2; k <= kBlockWidth; ++k) {
        if (folding.cost[k] <= folding.cost[1]) continue;
        folding.cost[k] = folding.cost[1];
        folding.slots_of_first[k] = 0;
      }
    }
  }

  // Adds the nodes that represent an inner node by at most `slots` slots, and not by itself if that is a whole block.
  void add_descendants(int32_t n, int slots, std::vector<int32_t>& nodes) const {
    const int of_first = foldings_[n].slots_of_first[slots];
    if (of_first == 0) return nodes.push_back(n);
    add_descendants(binary_[n].child, of_first, nodes);
    add_descendants(binary_[n].child + 1, slots - of_first, nodes);
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

  // Below this depth nodes are split in the middle: 31-bit counts then need at most kMaxTreeDepth levels in total.
  static constexpr int kFreeDepth = kMaxTreeDepth - 32;

  // Sorts triangles by the middles of their boxes, then by index. Children keep this order.
  void sort_along(int axis) {
    std::vector<std::pair<double, int32_t>> keys(faces_.size());
    for (size_t f = 0; f < faces_.size(); ++f) {
      keys[f] = {boxes_[f].lower[axis] + boxes_[f].upper[axis], static_cast<int32_t>(f)};
    }
    std::sort(keys.begin(), keys.end());
    along_[axis].reserve(keys.size());
    for (const auto& [middle, f] : keys) along_[axis].push_back(f);
  }

  Split best_split(int32_t begin, int32_t end, int depth) {
    const int32_t count = end - begin;
    double best_cost = HUGE_VAL;
    Split best{0, begin + count / 2};
    for (int axis = 0; axis < 3; ++axis) {
      const int32_t* const order = along_[axis].data() + begin;
      Box right;
      for (int32_t k = count - 1; k > 0; --k) {
        right.include(boxes_[order[k]]);
        right_area_[k] = right.half_area();
      }
      Box left;
      for (int32_t k = 1; k < count; ++k) {
        left.include(boxes_[order[k - 1]]);
        if (depth >= kFreeDepth && k != count / 2) continue;
        const double cost = left.half_area() * k + right_area_[k] * (count - k);
        if (cost < best_cost) {
          best_cost = cost;
          best = {axis, begin + k};
        }
      }
    }
    return best;
  }

  // Partitions each order: the left triangles of a node first, then the right ones.
  void partition_orders(int32_t begin, int32_t end, const Split& split) {
    const std::vector<int32_t>& chosen = along_[split.axis];
    for (int32_t k = begin; k < end; ++k) is_left_[chosen[k]] = k < split.middle;
    for (int axis = 0; axis < 3; ++axis) {
      if (axis == split.axis) continue;
      std::vector<int32_t>& order = along_[axis];
      right_side_.clear();
      int32_t left = begin;
      for (int32_t k = begin; k < end; ++k) {
        const int32_t f = order[k];
        if (is_left_[f]) {
          order[left++] = f;
        } else {
          right_side_.push_back(f);
        }
      }
      std::copy(right_side_.begin(), right_side_.end(), order.begin() + left);
    }
  }

  // Keeps the parent's vertices that belong to the node's own triangles, in ascending order.
  void keep_vertices_of_node(Task& task) {
    for (int32_t k = binary_[task.node].begin; k < binary_[task.node].end; ++k) {
      for (const int32_t v : faces_[(*task.order)[k]]) node_of_vertex_[v] = task.node;
    }
    std::erase_if(task.vertices, [&](int32_t v) { return node_of_vertex_[v] != task.node; });
  }

  void add_leaf_points(const Task& leaf) {
    BinaryNode& node = binary_[leaf.node];
    node.first_points = static_cast<int32_t>(tree_.leaf_points.size());
    const size_t count = leaf.vertices.size();
    for (size_t first = 0; first < count; first += kBlockWidth) {
      LeafPoints& points = tree_.leaf_points.emplace_back();
      for (size_t slot = 0; slot < kBlockWidth; ++slot) {
        const int32_t v = leaf.vertices[std::min(first + slot, count - 1)];
        const Vec3<float> point = cast<float>(load_vec3(vertices_ + 3 * int64_t{v}));
        points.x[slot] = point.x;
        points.y[slot] = point.y;
        points.z[slot] = point.z;
        points.vertex[slot] = v;
      }
    }
    node.points_count = static_cast<int32_t>(tree_.leaf_points.size()) - node.first_points;
  }

  // Area-weighted mean of the triangles' normals, or any direction if it vanishes.
  Vec3<float> mean_normal(const std::vector<int32_t>& order, int32_t begin, int32_t end) const {
    Vec3<double> sum{0.0, 0.0, 0.0};
    for (int32_t k = begin; k < end; ++k) {
      const Face& face = faces_[order[k]];
      const Vec3<double> p = load_vec3(vertices_ + 3 * int64_t(face[0]));
      sum =
          sum + cross(load_vec3(vertices_ + 3 * int64_t(face[1])) - p, load_vec3(vertices_ + 3 * int64_t(face[2])) - p);
    }
    const double length = norm(sum);
    return length > 0.0 ? cast<float>((1.0 / length) * sum) : Vec3<float>{0.0f, 0.0f, 1.0f};
  }

  // Schedules a node's volume, which is computed together with the next few.
  void add_volume(const Task& task) {
    const int steps = task.vertices.size() > 1000 ? 24 : 96;
    if (pending_count_ == kVolumesAtOnce || (pending_count_ > 0 && steps != steps_)) set_pending_volumes();
    steps_ = steps;
    PendingVolume& pending = pending_[pending_count_++];
    pending.node = task.node;
    pending.normal = mean_normal(*task.order, binary_[task.node].begin, binary_[task.node].end);
    pending.points.load(vertices_, task.vertices);
  }

  // Computes several volumes at once: each step depends on the previous one, but not on those of other nodes.
  void set_pending_volumes() {
    // Approximates the smallest enclosing sphere: step k moves 1/(k+1) of the way to the farthest point (Badoiu &
    // Clarkson 2003).
    std::array<Vec3<double>, kVolumesAtOnce> centres;
    for (int k = 0; k < pending_count_; ++k) centres[k] = pending_[k].points.point(0);
    for (int step = 1; step <= steps_; ++step) {
      for (int k = 0; k < pending_count_; ++k) {
        const Vec3<double> farthest = pending_[k].points.farthest(centres[k]).second;
        centres[k] = centres[k] + (1.0 / (step + 1)) * (farthest - centres[k]);
      }
    }
    for (int k = 0; k < pending_count_; ++k) {
      binary_[pending_[k].node].volume = volume_about(cast<float>(centres[k]), pending_[k]);
    }
    pending_count_ = 0;
  }

  static NodeVolume volume_about(Vec3<float> centre, const PendingVolume& node) {
    const double radius = std::sqrt(node.points.farthest(cast<double>(centre)).first) * (1.0 + 1e-14);
    const auto [low, high] = node.points.extent(cast<double>(centre), cast<double>(node.normal));
    const double slack = 1e-14 * radius;  // more than the rounding of the projection
    return {centre, node.normal, std::nextafter(static_cast<float>(radius), HUGE_VALF),
            std::nextafter(static_cast<float>(low - slack), -HUGE_VALF),
            std::nextafter(static_cast<float>(high + slack), HUGE_VALF)};
  }

  const double* vertices_;
  const std::vector<Face>& faces_;
  int leaf_size_;
  std::vector<Box> boxes_;
  std::array<std::vector<int32_t>, 3> along_;  // triangles sorted along each axis, within each node
  std::vector<int32_t> node_of_vertex_;        // latest node made that contains the vertex
  std::vector<char> is_left_;                  // for each triangle, in the current split
  std::vector<int32_t> right_side_;
  std::vector<double> right_area_;
  std::array<PendingVolume, kVolumesAtOnce> pending_;
  int pending_count_ = 0, steps_ = 0;
  std::vector<BinaryNode> binary_;
  std::vector<Folding> foldings_;
  Hierarchy tree_;
};

}  // namespace

Hierarchy build_hierarchy(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces, int leaf_size) {
  return Builder(vertices, vertex_count, faces, leaf_size).build();
}

}  // namespace pgccd
