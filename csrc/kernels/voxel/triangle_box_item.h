// Boxes of a rigid body's swept triangles.
#pragma once

#include <stdexcept>
#include <vector>

#include "core/centre_arc.h"
#include "kernels/voxel/voxel.h"

namespace pgccd {

struct CornerBox {
  float lower[3], upper[3];
};

// Calls use(box) for each triangle of the body; `corners` is scratch memory. Each box contains the triangle at every
// time of the step, grown by half of the distance at which a contact with another body may be reported.
template <class Use>
void for_each_triangle_box(const VoxelBodies& input, int64_t body, std::vector<CornerBox>& corners, const Use& use) {
  const RigidBodies& bodies = input.bodies;
  const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body];
  const Vec3<double> p0 = load_vec3(bodies.centres.position_t0 + 3 * body);
  const Vec3<double> p1 = load_vec3(bodies.centres.position_t1 + 3 * body);
  const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body));
  const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body));
  if (!(spin.angle <= 2.0 * kLargestAngle)) throw std::invalid_argument("bodies: a rotation is too large");
  const SineCosine turn = sine_cosine(spin.angle);
  const double reach = mesh_reach(bodies, body);
  // Half of the sum of two bodies' own tolerances is at least that of the smaller one.
  const double tolerance = input.tolerance < 0.0 ? -input.tolerance * size_of(bodies.centres, body) : input.tolerance;
  const double margin = bodies.centres.margin == nullptr ? 0.0 : bodies.centres.margin[body];
  // Errors of offsets, of adding them to positions, and of boxes in float32.
  const double farthest = larger(max_abs(p0), max_abs(p1)) + reach;
  const double rounding = Precision<double>::unit * ((kRigidPointUnits + 8.0 * spin.angle) * reach + 8.0 * farthest);
  const double separation = 0.5 * (input.separation + tolerance) + margin;
  const double grown = (separation + rounding) * (1.0 + 0x1p-40) + 0x1p-23 * (farthest + separation);

  corners.resize(rows[1].vertex - rows[0].vertex);
  for (size_t k = 0; k < corners.size(); ++k) {
    const Vec3<double> start = at_t0 * load_vec3(bodies.meshes.vertices + 3 * (rows[0].vertex + int64_t(k)));
    const Vec3<double> end = rotate(spin, turn, start);
    const double bulge = bodies.linear_path ? 0.0 : arc_bulge(spin.angle, norm(cross(spin.axis, start)));
    const double off = grown + bulge * (1.0 + 0x1p-20);
    const Vec3<double> x0 = p0 + start, x1 = p1 + end;
    const double low[3] = {smaller(x0.x, x1.x), smaller(x0.y, x1.y), smaller(x0.z, x1.z)};
    const double high[3] = {larger(x0.x, x1.x), larger(x0.y, x1.y), larger(x0.z, x1.z)};
    for (int axis = 0; axis < 3; ++axis) {
      corners[k].lower[axis] = static_cast<float>(low[axis] - off);
      corners[k].upper[axis] = static_cast<float>(high[axis] + off);
    }
  }
  for (int64_t row = rows[0].face; row < rows[1].face; ++row) {
    const Triangle& triangle = bodies.meshes.triangles[row];
    const CornerBox &a = corners[triangle.vertex[0]], &b = corners[triangle.vertex[1]],
                    &c = corners[triangle.vertex[2]];
    TriangleBox box;
    for (int axis = 0; axis < 3; ++axis) {
      box.lower[axis] = smaller(smaller(a.lower[axis], b.lower[axis]), c.lower[axis]);
      box.upper[axis] = larger(larger(a.upper[axis], b.upper[axis]), c.upper[axis]);
    }
    box.body = static_cast<int32_t>(body);
    box.triangle = static_cast<int32_t>(row - rows[0].face);
    use(box);
  }
}

}  // namespace pgccd
