// The operators that distribute bodies over ranks, templates over the session that they run in.
#pragma once

#include <numeric>

#include "bind/detect_ops.h"
#include "kernels/broad/subdomain.h"

namespace pgccd::bind {

constexpr int64_t kMostCells = int64_t{1} << 31;

// frame: lower corner, cells per length unit, number of cells; each along x, y, z. owner: (cells,) int64, the rank of
// each; or (planes, 4) float64, see BisectionPlane.
inline Subdomain subdomain_view(const std::vector<double>& frame, const Tensor& owner, int64_t rank) {
  STD_TORCH_CHECK(frame.size() == 9, "frame: expected 9 numbers, got ", frame.size());
  Subdomain view;
  for (size_t axis = 0; axis < 3; ++axis) {
    view.frame.lower[axis] = frame[axis];
    view.frame.per_length[axis] = frame[3 + axis];
    const bool is_count = frame[6 + axis] >= 1.0 && frame[6 + axis] <= static_cast<double>(kMostCells);
    view.frame.count[axis] = is_count ? static_cast<int64_t>(frame[6 + axis]) : 0;
  }
  for (const int64_t count : view.frame.count) {
    STD_TORCH_CHECK(count >= 1 && count <= kMostCells, "frame: expected 1 to 2^31 cells along each axis");
  }
  STD_TORCH_CHECK(view.frame.count[0] * view.frame.count[1] <= kMostCells && view.frame.cell_count() <= kMostCells,
                  "frame: expected at most 2^31 cells");
  view.rank = rank;
  view.owner = nullptr;
  view.planes = nullptr;
  view.plane_count = 0;
  if (owner.scalar_type() == torch::headeronly::ScalarType::Double) {
    view.planes = reinterpret_cast<const BisectionPlane*>(rows<double>(owner, "owner", {kAnySize, 4}));
    view.plane_count = owner.size(0);
  } else {
    view.owner = rows<int64_t>(owner, "owner", {view.frame.cell_count()});
  }
  return view;
}

inline BodyPositions positions_view(const Tensor& position, const std::optional<Tensor>& id) {
  const int64_t count = position.size(0);
  return {rows<double>(position, "position", {kAnySize, 3}), optional_column<int64_t>(id, "id", count), count};
}

using FrameList = std::vector<double>;

template <class Session>
struct SubdomainOps {
  static std::tuple<Tensor, Tensor> swept_boxes(const TensorList& centres, double min_separation, double tolerance) {
    const BroadBodies bodies = centres_view(centres, "centres", {min_separation, tolerance});
    const Tensor& radius = centres[2];
    Tensor lower = new_tensor<double>(radius, {bodies.count, 3}), upper = new_tensor<double>(radius, {bodies.count, 3});
    pgccd::swept_boxes(Session(radius).context(), bodies, data<double>(lower), data<double>(upper));
    return {lower, upper};
  }

  static std::tuple<Tensor, Tensor, Tensor> boundary_bodies(const TensorList& centres, double min_separation,
                                                            double tolerance, FrameList frame, const Tensor& owner,
                                                            int64_t rank) {
    const BroadBodies bodies = centres_view(centres, "centres", {min_separation, tolerance});
    Tensor reach = new_tensor<uint8_t>(owner, {bodies.count});
    Tensor boundary = new_tensor<int64_t>(owner, {bodies.count}), found = new_tensor<int64_t>(owner, {1});
    pgccd::boundary_bodies(Session(owner).context(), bodies, subdomain_view(frame, owner, rank), data<uint8_t>(reach),
                           {data<int64_t>(boundary), data<int64_t>(found)});
    return {reach, boundary, found};
  }

  static std::tuple<Tensor, Tensor> replica_ranks(const TensorList& centres, double min_separation, double tolerance,
                                                  FrameList frame, const Tensor& owner, int64_t rank,
                                                  const Tensor& bodies, std::vector<int64_t> received, int64_t ranks) {
    const ReplicaRanksInput input{centres_view(centres, "centres", {min_separation, tolerance}),
                                  subdomain_view(frame, owner, rank), rows<int64_t>(bodies, "bodies", {kAnySize}),
                                  bodies.size(0), received};
    for (const int64_t count : received) {
      STD_TORCH_CHECK(count >= 0, "received: expected numbers >= 0, got ", count);
    }
    STD_TORCH_CHECK(rank >= 0 && rank < ranks, "rank: expected a number below ", ranks, ", got ", rank);
    const bool sums_up = std::accumulate(received.begin(), received.end(), int64_t{0}) == bodies.size(0);
    STD_TORCH_CHECK(received.empty() || (static_cast<int64_t>(received.size()) == ranks && sums_up),
                    "received: expected numbers of ", ranks, " ranks, ", bodies.size(0), " in all");
    Tensor replica_ranks = new_tensor<uint8_t>(owner, {bodies.size(0), ranks}),
           counts = new_tensor<int64_t>(owner, {ranks});
    pgccd::replica_ranks(Session(owner).context(), input, {ranks, data<uint8_t>(replica_ranks), data<int64_t>(counts)});
    return {replica_ranks, counts};
  }

  static Tensor reached_ranks(const TensorList& centres, double min_separation, double tolerance, FrameList frame,
                              const Tensor& owner, int64_t rank, const Tensor& bodies,
                              const std::optional<Tensor>& begin, int64_t places, int64_t ranks) {
    const int64_t count = bodies.size(0);
    const ReachedRanks input{centres_view(centres, "centres", {min_separation, tolerance}),
                             subdomain_view(frame, owner, rank),
                             rows<int64_t>(bodies, "bodies", {kAnySize}),
                             count,
                             optional_column<int64_t>(begin, "begin", count),
                             places,
                             ranks};
    STD_TORCH_CHECK(rank >= 0 && rank < ranks, "rank: expected a number below ", ranks, ", got ", rank);
    STD_TORCH_CHECK(places >= 0, "places: expected a number >= 0, got ", places);
    Tensor out = new_tensor<int64_t>(owner, {begin ? places : count});
    pgccd::reached_ranks(Session(owner).context(), input, data<int64_t>(out));
    return out;
  }

  static Tensor rows_by_rank(const Tensor& replica_ranks, const Tensor& bodies, const Tensor& counts,
                             std::vector<int64_t> capacities) {
    const int64_t* numbers = rows<int64_t>(bodies, "rows", {kAnySize});
    const int64_t row_count = bodies.size(0), ranks = static_cast<int64_t>(capacities.size());
    const HeldRows held{rows<uint8_t>(replica_ranks, "replica_ranks", {row_count, ranks}), numbers, row_count, ranks,
                        rows<int64_t>(counts, "counts", {ranks})};
    for (const int64_t capacity : capacities)
      STD_TORCH_CHECK(capacity >= 0, "capacities: expected numbers >= 0, got ", capacity);
    Tensor by_rank = new_tensor<int64_t>(bodies, {std::accumulate(capacities.begin(), capacities.end(), int64_t{0})});
    pgccd::rows_by_rank(Session(bodies).context(), held, capacities, data<int64_t>(by_rank));
    return by_rank;
  }

  static Tensor counts_to_send(const Tensor& counts, std::vector<int64_t> capacities, const Tensor& found,
                               int64_t capacity) {
    const int64_t ranks = static_cast<int64_t>(capacities.size());
    const CapacityInput input{rows<int64_t>(counts, "counts", {ranks}), rows<int64_t>(found, "found", {1}), capacity};
    Tensor messages = new_tensor<int64_t>(counts, {ranks, 2});
    pgccd::counts_to_send(Session(counts).context(), input, capacities, data<int64_t>(messages));
    return messages;
  }

  static std::tuple<Tensor, Tensor> owned_pairs(const Tensor& pairs, const Tensor& held, const Tensor& id,
                                                const TensorList& centres, double min_separation, double tolerance,
                                                const Tensor& reach, FrameList frame, const Tensor& owner,
                                                int64_t rank) {
    OwnedPairs input;
    input.bodies = centres_view(centres, "centres", {min_separation, tolerance});
    input.subdomain = subdomain_view(frame, owner, rank);
    input.reach = rows<uint8_t>(reach, "reach", {kAnySize});
    input.own_count = reach.size(0);
    input.rows = rows<int64_t>(held, "rows", {input.bodies.count});
    input.id = rows<int64_t>(id, "id", {kAnySize});
    input.held_count = id.size(0);
    STD_TORCH_CHECK(id.size(0) >= input.own_count, "id: expected at least ", input.own_count, " rows");
    input.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
    input.pair_count = pairs.size(0);
    Tensor owned = new_tensor<int64_t>(owner, {input.pair_count, 2}), found = new_tensor<int64_t>(owner, {1});
    pgccd::owned_pairs(Session(owner).context(), input, data<int64_t>(owned), data<int64_t>(found));
    return {owned, found};
  }

  static std::tuple<Tensor, Tensor> near_ghosts(const TensorList& centres, const Tensor& reach,
                                                const TensorList& ghosts, double min_separation, double tolerance,
                                                FrameList frame, const Tensor& owner, int64_t rank) {
    const BroadBodies bodies = centres_view(centres, "centres", {min_separation, tolerance});
    Tensor near = new_tensor<int64_t>(owner, {bodies.count}), found = new_tensor<int64_t>(owner, {1});
    pgccd::near_ghosts(Session(owner).context(), bodies, rows<uint8_t>(reach, "reach", {bodies.count}),
                       centres_view(ghosts, "ghosts", {min_separation, tolerance}), subdomain_view(frame, owner, rank),
                       {data<int64_t>(near), data<int64_t>(found)});
    return {near, found};
  }

  static std::tuple<Tensor, Tensor, Tensor> leaving_bodies(const Tensor& position, FrameList frame, const Tensor& owner,
                                                           int64_t rank, int64_t ranks) {
    const BodyPositions bodies = positions_view(position, std::nullopt);
    const int64_t count = bodies.count;
    STD_TORCH_CHECK(ranks >= 1 && ranks <= kMostCells, "ranks: expected a number in [1, 2^31], got ", ranks);
    Tensor leaving = new_tensor<int64_t>(owner, {count}), by_destination = new_tensor<int64_t>(owner, {count});
    Tensor counts = new_tensor<int64_t>(owner, {ranks});
    pgccd::leaving_bodies(Session(owner).context(), bodies, subdomain_view(frame, owner, rank), ranks,
                          {data<int64_t>(leaving), data<int64_t>(by_destination), data<int64_t>(counts)});
    return {leaving, by_destination, counts};
  }

  static Tensor leaving_and_invalid(const Tensor& position, const std::optional<Tensor>& id, FrameList frame,
                                    const Tensor& owner, int64_t rank) {
    Tensor counts = new_tensor<int64_t>(owner, {2});
    pgccd::leaving_and_invalid(Session(owner).context(), positions_view(position, id),
                               subdomain_view(frame, owner, rank), data<int64_t>(counts));
    return counts;
  }
};

template <class Session>
void register_subdomain_ops(Library& library) {
  using Ops = SubdomainOps<Session>;
  library.impl("swept_boxes", PGCCD_BOX(Ops::swept_boxes));
  library.impl("boundary_bodies", PGCCD_BOX(Ops::boundary_bodies));
  library.impl("replica_ranks", PGCCD_BOX(Ops::replica_ranks));
  library.impl("reached_ranks", PGCCD_BOX(Ops::reached_ranks));
  library.impl("rows_by_rank", PGCCD_BOX(Ops::rows_by_rank));
  library.impl("counts_to_send", PGCCD_BOX(Ops::counts_to_send));
  library.impl("owned_pairs", PGCCD_BOX(Ops::owned_pairs));
  library.impl("near_ghosts", PGCCD_BOX(Ops::near_ghosts));
  library.impl("leaving_bodies", PGCCD_BOX(Ops::leaving_bodies));
  library.impl("leaving_and_invalid", PGCCD_BOX(Ops::leaving_and_invalid));
}

}  // namespace pgccd::bind
