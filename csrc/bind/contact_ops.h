// The operators for what follows from contacts, templates over the session that they run in.
#pragma once

#include "bind/outputs.h"
#include "kernels/contacts/contacts.h"

namespace pgccd::bind {

// bodies = [mesh_index, position_t0, position_t1, orientation, rotation] or [mesh_index, x_t0, x_t1, vertex_begin]
inline BodyPaths paths_view(const TensorList& mesh_set, const TensorList& t, bool linear_path) {
  STD_TORCH_CHECK(t.size() == 5 || t.size() == 4, "bodies: expected 5 tensors, or 4 of bodies given by vertices, got ",
                  t.size());
  BodyPaths view{};
  view.meshes = mesh_set_view(mesh_set);
  view.mesh_index = rows<int32_t>(t[0], "bodies.mesh_index", {kAnySize});
  const int64_t count = view.count = t[0].size(0);
  if (t.size() == 4) {
    view.kind = PathKind::kVertices;
    view.vertex_count = t[1].size(0);
    view.vertices_t0 = rows<double>(t[1], "bodies.x_t0", {kAnySize, 3});
    view.vertices_t1 = rows<double>(t[2], "bodies.x_t1", {view.vertex_count, 3});
    view.vertex_begin = rows<int64_t>(t[3], "bodies.vertex_begin", {count});
    return view;
  }
  view.kind = linear_path ? PathKind::kLines : PathKind::kArcs;
  view.position_t0 = rows<double>(t[1], "bodies.position_t0", {count, 3});
  view.position_t1 = rows<double>(t[2], "bodies.position_t1", {count, 3});
  view.orientation = rows<double>(t[3], "bodies.orientation", {count, 4});
  view.rotation = rows<double>(t[4], "bodies.rotation", {count, 3});
  return view;
}

inline RowLists row_lists(const Tensor& begin, const Tensor& items, int64_t count, int64_t size, const char* name) {
  return {rows<int64_t>(begin, name, {count + 1}), rows<int64_t>(items, name, {size})};
}

// incidence = [face_edges, then begin and items of faces_of_vertex, edges_of_vertex and faces_of_edge, outward]
inline Incidence incidence_view(const TensorList& t, const TensorList& mesh_set, int64_t most) {
  STD_TORCH_CHECK(t.size() == 8, "incidence: expected 8 tensors, got ", t.size());
  const int64_t vertices = mesh_set[0].size(0), faces = mesh_set[1].size(0), edges = mesh_set[2].size(0);
  STD_TORCH_CHECK(most >= 0 && most <= 3 * faces, "most: expected a number of faces, got ", most);
  return {rows<int64_t>(t[0], "incidence.face_edges", {faces, 3}),
          row_lists(t[1], t[2], vertices, 3 * faces, "incidence.faces_of_vertex"),
          row_lists(t[3], t[4], vertices, 2 * edges, "incidence.edges_of_vertex"),
          row_lists(t[5], t[6], edges, 3 * faces, "incidence.faces_of_edge"),
          rows<double>(t[7], "incidence.outward", {mesh_set[8].size(0) - 1}),
          most};
}

// contacts = [bodies (K, 2) i64, kind i8, features (K, 2) i32, coordinates (K, 2), toi, point (K, 3), normal (K, 3)]
inline ContactsOnPaths contacts_on_paths(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                         const TensorList& incidence, int64_t most, const TensorList& contacts) {
  STD_TORCH_CHECK(contacts.size() == 7, "contacts: expected 7 tensors, got ", contacts.size());
  ContactsOnPaths given;
  given.paths = paths_view(mesh_set, bodies, linear_path);
  given.incidence = incidence_view(incidence, mesh_set, most);
  const int64_t* pairs = rows<int64_t>(contacts[0], "contacts.bodies", {kAnySize, 2});
  const int64_t count = contacts[0].size(0);
  given.contacts = {pairs,
                    rows<int8_t>(contacts[1], "contacts.kind", {count}),
                    rows<int32_t>(contacts[2], "contacts.features", {count, 2}),
                    rows<double>(contacts[3], "contacts.coordinates", {count, 2}),
                    rows<double>(contacts[4], "contacts.toi", {count}),
                    rows<double>(contacts[5], "contacts.point", {count, 3}),
                    count};
  given.normal = rows<double>(contacts[6], "contacts.normal", {count, 3});
  return given;
}

template <class Session>
struct ContactOps {
  static std::tuple<Tensor, Tensor, Tensor, Tensor> closing_rates(const TensorList& mesh_set, const TensorList& bodies,
                                                                  bool linear_path, const TensorList& incidence,
                                                                  int64_t most, const TensorList& contacts) {
    const ContactsOnPaths given = contacts_on_paths(mesh_set, bodies, linear_path, incidence, most, contacts);
    const int64_t count = given.contacts.count;
    Tensor rate = new_tensor<double>(contacts[0], {count}), is_reversed = new_tensor<uint8_t>(contacts[0], {count});
    Tensor away = new_tensor<double>(contacts[0], {count}), size = new_tensor<double>(contacts[0], {count});
    pgccd::closing_rates(Session(contacts[0]).context(), given,
                         {data<double>(rate), data<uint8_t>(is_reversed), data<double>(away), data<double>(size)});
    return {rate, is_reversed, away, size};
  }

  static Tensor surface_normals(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                const TensorList& incidence, int64_t most, const TensorList& contacts) {
    const ContactsOnPaths given = contacts_on_paths(mesh_set, bodies, linear_path, incidence, most, contacts);
    Tensor normal = new_tensor<double>(contacts[0], {given.contacts.count, 3});
    pgccd::surface_normals(Session(contacts[0]).context(), given, {data<double>(normal)});
    return normal;
  }

  static Tensor certainly_recede(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                 const TensorList& incidence, int64_t most, const TensorList& contacts,
                                 const Tensor& status, const Tensor& slack) {
    const ContactsOnPaths given = contacts_on_paths(mesh_set, bodies, linear_path, incidence, most, contacts);
    const int64_t count = given.contacts.count;
    const int8_t* statuses = rows<int8_t>(status, "status", {count});
    const double* slacks = rows<double>(slack, "slack", {given.paths.count});
    Tensor certain = new_tensor<uint8_t>(contacts[0], {count});
    pgccd::certainly_recede(Session(contacts[0]).context(), given, {statuses, slacks, data<uint8_t>(certain)});
    return certain;
  }
};

template <class Session>
void register_contact_ops(Library& library) {
  using Ops = ContactOps<Session>;
  library.impl("closing_rates", PGCCD_BOX(Ops::closing_rates));
  library.impl("surface_normals", PGCCD_BOX(Ops::surface_normals));
  library.impl("certainly_recede", PGCCD_BOX(Ops::certainly_recede));
}

}  // namespace pgccd::bind
