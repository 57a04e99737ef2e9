#include "mesh/binary_tree.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <utility>

#include "mesh/point_columns.h"
#include "mesh/smallest_sphere.h"

namespace pgccd {
namespace {

using Float4 = float __attribute__((vector_size(16)));

// In units of the mesh's extent, so that products of single precision neither overflow nor vanish. Boxes only choose
// splits; volumes are computed from the points themselves.
struct Box {
  Float4 lower{HUGE_VALF, HUGE_VALF, HUGE_VALF, 0.0f};
  Float4 upper{-HUGE_VALF, -HUGE_VALF, -HUGE_VALF, 0.0f};

  void include(const Box& other) {
    lower = other.lower < lower ? other.lower : lower;
    upper = upper < other.upper ? other.upper : upper;
  }
  float half_area() const {
    const Float4 extent = upper - lower;
    const Float4 products = extent * __builtin_shufflevector(extent, extent, 1, 2, 0, 3);
    return products[0] + products[1] + products[2];
  }
  Float4 doubled_middle() const { return lower + upper; }
};

class Builder {
 public:
  Builder(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces, int leaf_size)
      : vertices_(vertices),
        faces_(faces),
        leaf_size_(leaf_size),
        boxes_(faces.size()),
        normals_(faces.size()),
        node_of_vertex_(static_cast<size_t>(vertex_count), -1),
        is_left_(faces.size()),
        right_area_(kMostSorted) {
    tree_.triangle_order.resize(faces.size());
    for (std::vector<int32_t>& order : along_) order.resize(faces.size());
    std::iota(along_[0].begin(), along_[0].end(), 0);
    measure_faces();
  }

  BinaryTree build() {
    const int32_t count = static_cast<int32_t>(faces_.size());
    tree_.nodes.reserve(faces_.size());
    tree_.nodes.push_back({0, count, -1});
    std::vector<int32_t> all(node_of_vertex_.size());
    std::iota(all.begin(), all.end(), 0);
    std::vector<Task> tasks;
    tasks.push_back({0, 1, 0, false, std::move(all)});
    while (!tasks.empty()) {
      Task task = std::move(tasks.back());
      tasks.pop_back();
      const int32_t begin = tree_.nodes[task.node].begin, end = tree_.nodes[task.node].end;
      keep_vertices_of_node(task);
      set_volume(task);
      if (end - begin <= leaf_size_ && end_of_first_kind(begin, end, task) == end) {
        const std::vector<int32_t>& order = along_[task.axis];
        std::copy(order.begin() + begin, order.begin() + end, tree_.triangle_order.begin() + begin);
        add_leaf_points(task);
        continue;
      }
      const Split split = split_node(task);
      const int32_t child = static_cast<int32_t>(tree_.nodes.size());
      tree_.nodes[task.node].child = child;
      tree_.nodes.push_back({begin, split.middle, -1});
      tree_.nodes.push_back({split.middle, end, -1});
      // Points list their vertices again.
      const bool lists_again = kind_of(faces_[along_[split.axis][split.middle]]) == ElementKind::kPoint;
      tasks.push_back({child + 1, task.depth + 1, split.axis, task.is_sorted,
                       lists_again ? std::vector<int32_t>() : task.vertices});
      tasks.push_back({child, task.depth + 1, split.axis, task.is_sorted, std::move(task.vertices)});
    }
    return std::move(tree_);
  }

 private:
  struct Split {
    int axis;  // along_[axis] holds the triangles of both children in their order
    int32_t middle;
  };

  // A node that has no volume yet.
  struct Task {
    int32_t node, depth;
    int axis;                       // along_[axis] holds its triangles
    bool is_sorted;                 // whether along_[0], [1] and [2] all do, sorted
    std::vector<int32_t> vertices;  // of its parent, ascending
  };

  // Larger nodes are split between bins; at most as many triangles are sorted, and split anywhere between two of them.
  static constexpr int32_t kMostSorted = 128;
  static constexpr int kBins = 32;
  // Nodes with more vertices, which few tests reach, get a sphere about the middle of their box.
  static constexpr size_t kMostSphered = 2048;
  // Nodes with more points, which are in order_in_space.
  static constexpr int32_t kMostSided = 1 << 14;
  // Below this depth nodes are split in the middle: 31-bit counts then need at most kMaxTreeDepth levels in total.
  static constexpr int kFreeDepth = kMaxTreeDepth - 32;

  void measure_faces() {
    Double4 low{HUGE_VAL, HUGE_VAL, HUGE_VAL, 0.0}, high = -low;
    const auto load = [&](int32_t v) {
      const double* const p = vertices_ + 3 * int64_t{v};
      return Double4{p[0], p[1], p[2], 0.0};
    };
    for (const Face& face : faces_) {
      for (const int32_t v : face) {
        const Double4 point = load(v);
        low = point < low ? point : low;
        high = high < point ? point : high;
      }
    }
    const Double4 extent = high - low;
    const double largest = std::max({extent[0], extent[1], extent[2]});
    const double scale = largest > 0.0 ? 1.0 / largest : 0.0;
    for (size_t f = 0; f < faces_.size(); ++f) {
      for (const int32_t v : faces_[f]) {
        const Float4 point = __builtin_convertvector((load(v) - low) * scale, Float4);
        boxes_[f].include({point, point});
      }
      const Vec3<double> p = load_vec3(vertices_ + 3 * int64_t{faces_[f][0]});
      normals_[f] = cross(load_vec3(vertices_ + 3 * int64_t{faces_[f][1]}) - p,
                          load_vec3(vertices_ + 3 * int64_t{faces_[f][2]}) - p);
    }
  }

  // Faces are in the order of their kinds, and kinds are separated before all else.
  int32_t end_of_first_kind(int32_t begin, int32_t end, const Task& task) const {
    const std::vector<int32_t>& order = along_[task.axis];
    const ElementKind kind = kind_of(faces_[order[begin]]);
    if (kind_of(faces_[order[end - 1]]) == kind) return end;
    const auto is_of_first = [&](int32_t f) { return kind_of(faces_[f]) == kind; };
    return static_cast<int32_t>(std::partition_point(order.begin() + begin, order.begin() + end, is_of_first) -
                                order.begin());
  }

  // Orders the node's triangles so that those of its first child come first.
  Split split_node(Task& task) {
    const int32_t begin = tree_.nodes[task.node].begin, end = tree_.nodes[task.node].end;
    if (const int32_t middle = end_of_first_kind(begin, end, task); middle < end) return {task.axis, middle};
    if (kind_of(faces_[along_[0][begin]]) == ElementKind::kPoint) return split_points(begin, end);
    if (!task.is_sorted) {
      if (end - begin > kMostSorted && task.depth < kFreeDepth) {
        const Split split = split_between_bins(begin, end);
        if (begin < split.middle && split.middle < end) return split;
      }
      sort(begin, end);
      task.is_sorted = true;
    }
    const Split split = best_split(begin, end, task.depth);
    partition_orders(begin, end, split);
    return split;
  }

  // In the middle, so that all leaves but one are full: of the longest side, in large nodes of the given order.
  Split split_points(int32_t begin, int32_t end) {
    const int32_t leaves = (end - begin + leaf_size_ - 1) / leaf_size_, middle = begin + leaf_size_ * (leaves / 2);
    if (end - begin > kMostSided) return {0, middle};
    const auto point_of = [&](int32_t f) { return boxes_[f].lower; };
    Box box;
    for (int32_t k = begin; k < end; ++k) box.include(boxes_[along_[0][k]]);
    const Float4 extent = box.upper - box.lower;
    int axis = extent[1] > extent[0] ? 1 : 0;
    if (extent[2] > extent[axis]) axis = 2;
    const auto order = along_[0].begin();
    std::nth_element(order + begin, order + middle, order + end, [&](int32_t f, int32_t g) {
      const float at_f = point_of(f)[axis], at_g = point_of(g)[axis];
      return at_f < at_g || (at_f == at_g && f < g);
    });
    return {0, middle};
  }

  // The best of kBins - 1 equidistant planes an axis (Wald 2007). Leaves a child empty if no plane separates middles.
  Split split_between_bins(int32_t begin, int32_t end) {
    int32_t* const order = along_[0].data();
    Box middles;
    for (int32_t k = begin; k < end; ++k) {
      const Float4 middle = boxes_[order[k]].doubled_middle();
      middles.include({middle, middle});
    }
    const Float4 extent = middles.upper - middles.lower;
    Float4 scale{0.0f, 0.0f, 0.0f, 0.0f};
    for (int axis = 0; axis < 3; ++axis) {
      // Scaled middles stay below kBins. Differences of numbers up to 2 vanish or exceed 2^-149.
      if (extent[axis] > 0x1p-100f) scale[axis] = (kBins - 1e-3f) / extent[axis];
    }
    const auto bins_of = [&](int32_t f) {
      using Int4 = int32_t __attribute__((vector_size(16)));
      return __builtin_convertvector((boxes_[f].doubled_middle() - middles.lower) * scale, Int4);
    };
    struct Bin {
      Box box;
      int32_t count = 0;
    };
    std::array<std::array<Bin, kBins>, 3> bins{};
    for (int32_t k = begin; k < end; ++k) {
      const auto at = bins_of(order[k]);
      for (int axis = 0; axis < 3; ++axis) {
        Bin& bin = bins[axis][at[axis]];
        bin.box.include(boxes_[order[k]]);
        ++bin.count;
      }
    }
    float best_cost = HUGE_VALF;
    int best_axis = 0, best_bin = 0;  // bins from it on go to the second child
    for (int axis = 0; axis < 3; ++axis) {
      std::array<float, kBins> cost_of_right{};
      Box right;
      int32_t right_count = 0;
      for (int b = kBins - 1; b > 0; --b) {
        right.include(bins[axis][b].box);
        right_count += bins[axis][b].count;
        cost_of_right[b] = right_count > 0 ? right.half_area() * static_cast<float>(right_count) : HUGE_VALF;
      }
      Box left;
      int32_t left_count = 0;
      for (int b = 1; b < kBins; ++b) {
        left.include(bins[axis][b - 1].box);
        left_count += bins[axis][b - 1].count;
        if (left_count == 0) continue;
        const float cost = left.half_area() * static_cast<float>(left_count) + cost_of_right[b];
        if (cost >= best_cost) continue;
        best_cost = cost;
        best_axis = axis;
        best_bin = b;
      }
    }
    right_side_.clear();
    int32_t middle = begin;
    for (int32_t k = begin; k < end; ++k) {
      const int32_t f = order[k];
      if (bins_of(f)[best_axis] < best_bin) {
        order[middle++] = f;
      } else {
        right_side_.push_back(f);
      }
    }
    std::copy(right_side_.begin(), right_side_.end(), order + middle);
    return {0, middle};
  }

  // Sorts the triangles of a node along each axis by the middles of their boxes, then by index. Descendants keep this
  // order.
  void sort(int32_t begin, int32_t end) {
    if (static_cast<size_t>(end - begin) > right_area_.size()) right_area_.resize(static_cast<size_t>(end - begin));
    for (int axis = 2; axis >= 0; --axis) {
      keys_.clear();
      for (int32_t k = begin; k < end; ++k) {
        const int32_t f = along_[0][k];
        keys_.push_back({boxes_[f].doubled_middle()[axis], f});
      }
      std::sort(keys_.begin(), keys_.end());
      for (int32_t k = begin; k < end; ++k) along_[axis][k] = keys_[k - begin].second;
    }
  }

  Split best_split(int32_t begin, int32_t end, int depth) {
    const int32_t count = end - begin;
    float best_cost = HUGE_VALF;
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
        const float cost = left.half_area() * static_cast<float>(k) + right_area_[k] * static_cast<float>(count - k);
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
    const std::vector<int32_t>& order = along_[task.axis];
    const int32_t begin = tree_.nodes[task.node].begin, end = tree_.nodes[task.node].end;
    if (kind_of(faces_[order[begin]]) == ElementKind::kPoint) {
      task.vertices.clear();
      for (int32_t k = begin; k < end; ++k) task.vertices.push_back(faces_[order[k]][0]);
      if (end - begin <= leaf_size_) std::sort(task.vertices.begin(), task.vertices.end());
      return;
    }
    for (int32_t k = begin; k < end; ++k) {
      for (const int32_t v : faces_[order[k]]) node_of_vertex_[v] = task.node;
    }
    std::erase_if(task.vertices, [&](int32_t v) { return node_of_vertex_[v] != task.node; });
  }

  void add_leaf_points(const Task& leaf) {
    BinaryNode& node = tree_.nodes[leaf.node];
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
  Vec3<float> mean_normal(const Task& task) const {
    const std::vector<int32_t>& order = along_[task.axis];
    Vec3<double> sum{0.0, 0.0, 0.0};
    for (int32_t k = tree_.nodes[task.node].begin; k < tree_.nodes[task.node].end; ++k) sum = sum + normals_[order[k]];
    const double length = norm(sum);
    return length > 0.0 ? cast<float>((1.0 / length) * sum) : Vec3<float>{0.0f, 0.0f, 1.0f};
  }

  void set_volume(const Task& task) {
    points_.load(vertices_, task.vertices);
    const bool is_large = task.vertices.size() > kMostSphered;
    const Vec3<float> centre = cast<float>(is_large ? points_.middle() : centre_of_smallest_sphere(points_));
    const Vec3<float> normal = mean_normal(task);
    const double radius = std::sqrt(points_.farthest(cast<double>(centre)).first) * (1.0 + 1e-14);
    const auto [low, high] = points_.extent(cast<double>(centre), cast<double>(normal));
    const double slack = 1e-14 * radius;  // more than the rounding of the projection
    tree_.nodes[task.node].volume = {centre, normal, std::nextafter(static_cast<float>(radius), HUGE_VALF),
                                     std::nextafter(static_cast<float>(low - slack), -HUGE_VALF),
                                     std::nextafter(static_cast<float>(high + slack), HUGE_VALF)};
  }

  const double* vertices_;
  const std::vector<Face>& faces_;
  int leaf_size_;
  std::vector<Box> boxes_;
  std::vector<Vec3<double>> normals_;          // twice the area long
  std::array<std::vector<int32_t>, 3> along_;  // triangles, by node; sorted along each axis in small nodes
  std::vector<int32_t> node_of_vertex_;        // latest node made that contains the vertex
  std::vector<char> is_left_;                  // for each triangle, in the current split
  std::vector<int32_t> right_side_;
  std::vector<std::pair<float, int32_t>> keys_;
  std::vector<float> right_area_;
  PointColumns points_;  // of the current node
  BinaryTree tree_;
};

}  // namespace

BinaryTree build_binary_tree(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces,
                             int leaf_size) {
  return Builder(vertices, vertex_count, faces, leaf_size).build();
}

}  // namespace pgccd
