#include "mesh/hierarchy.h"

#include <array>
#include <cmath>
#include <utility>

#include "mesh/binary_tree.h"
#include "mesh/node_support.h"
#include "mesh/order_in_space.h"

namespace pgccd {
namespace {

// Folds the nodes of a binary tree into blocks.
class Folder {
 public:
  explicit Folder(const std::vector<BinaryNode>& nodes) : nodes_(nodes) { plan_blocks(); }

  // Without supports, triangle order and leaf points.
  Hierarchy fold() {
    struct Task {
      std::vector<int32_t> nodes;
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
        const BinaryNode& node = nodes_[task.nodes[slot]];
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
    return std::move(tree_);
  }

 private:
  // How a node is represented by at most k slots of a block: by itself, or by its descendants, of which its first
  // child's take slots_of_first[k] (0: by itself). `cost[k]`: of all blocks below.
  struct Folding {
    std::array<double, kBlockWidth + 1> cost{};
    std::array<int8_t, kBlockWidth + 1> slots_of_first{};
  };

  // Minimises the total cost of all blocks by dynamic programming (Ylitie, Karras & Laine 2017). A block is tested
  // about as often as other bodies reach the node that it belongs to: in proportion to the area of the node's sphere.
  void plan_blocks() {
    foldings_.resize(nodes_.size());
    for (size_t n = nodes_.size(); n-- > 0;) {  // children follow their parents
      const BinaryNode& node = nodes_[n];
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
    add_descendants(nodes_[n].child, of_first, nodes);
    add_descendants(nodes_[n].child + 1, slots - of_first, nodes);
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

  const std::vector<BinaryNode>& nodes_;
  std::vector<Folding> foldings_;
  Hierarchy tree_;
};

// Clouds of more points are put in order first: triangles of files have neighbours in space as neighbours already.
constexpr size_t kManyPoints = 1 << 14;

Hierarchy build_in_given_order(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces,
                               int leaf_size) {
  BinaryTree tree = build_binary_tree(vertices, vertex_count, faces, leaf_size);
  Hierarchy hierarchy = Folder(tree.nodes).fold();
  hierarchy.triangle_order = std::move(tree.triangle_order);
  hierarchy.leaf_points = std::move(tree.leaf_points);
  hierarchy.supports = sample_supports(hierarchy, vertices);
  return hierarchy;
}

}  // namespace

Hierarchy build_hierarchy(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces, int leaf_size) {
  const bool is_cloud = faces.size() > kManyPoints && kind_of(faces[faces.size() - kManyPoints]) == ElementKind::kPoint;
  if (!is_cloud) return build_in_given_order(vertices, vertex_count, faces, leaf_size);
  const MeshInSpace mesh = order_in_space(vertices, vertex_count, faces);
  const auto used = static_cast<int64_t>(mesh.vertex_of.size());
  Hierarchy hierarchy = build_in_given_order(mesh.vertices.data(), used, mesh.faces, leaf_size);
  for (int32_t& f : hierarchy.triangle_order) f = mesh.face_of[f];
  for (LeafPoints& points : hierarchy.leaf_points) {
    for (int32_t& v : points.vertex) v = mesh.vertex_of[v];
  }
  return hierarchy;
}

}  // namespace pgccd
