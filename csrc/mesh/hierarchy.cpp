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
    struct Task {
      int32_t node, begin, end, depth;
    };
    tree_.links.push_back({});
    tree_.spheres.push_back({});
    std::vector<Task> tasks{{0, 0, static_cast<int32_t>(faces_.size()), 1}};
    while (!tasks.empty()) {
      const Task task = tasks.back();
      tasks.pop_back();
      tree_.spheres[task.node] = bounding_sphere(task.begin, task.end);
      if (task.end - task.begin <= leaf_size_) {
        tree_.links[task.node] = {task.begin, task.end - task.begin};
        continue;
      }
      const int32_t middle = split(task.begin, task.end, task.depth);
      const int32_t child = static_cast<int32_t>(tree_.links.size());
      tree_.links[task.node] = {child, 0};
      tree_.links.resize(child + 2);
      tree_.spheres.resize(child + 2);
      tasks.push_back({child + 1, middle, task.end, task.depth + 1});
      tasks.push_back({child, task.begin, middle, task.depth + 1});
    }
    return std::move(tree_);
  }

 private:
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

  NodeSphere bounding_sphere(int32_t begin, int32_t end) const {
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
    return {rounded.x, rounded.y, rounded.z, std::nextafter(static_cast<float>(radius), HUGE_VALF)};
  }

  const double* vertices_;
  const std::vector<Face>& faces_;
  int leaf_size_;
  std::vector<Box> boxes_;
  Hierarchy tree_;
};

}  // namespace

Hierarchy build_hierarchy(const double* vertices, const std::vector<Face>& faces, int leaf_size) {
  return Builder(vertices, faces, leaf_size).build();
}

}  // namespace pgccd
