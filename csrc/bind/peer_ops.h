// The operators for messages between GPUs of one host.
#pragma once

#include "bind/cuda_session.h"
#include "kernels/peers/peers.h"

namespace pgccd::bind {

inline PeerMemory peer_memory(const Tensor& memory, const Tensor& addresses, int64_t stop, int64_t rank) {
  PeerMemory view;
  rows<uint8_t, uint64_t>(memory, "memory", {kAnySize});  // flags are aligned
  view.addresses = rows<int64_t>(addresses, "addresses", {kAnySize});
  STD_TORCH_CHECK(stop != 0, "stop: expected the address of a word");
  view.stop = reinterpret_cast<const int64_t*>(stop);
  view.ranks = addresses.size(0);
  view.rank = rank;
  STD_TORCH_CHECK(view.ranks >= 1 && view.ranks <= kMostPeers, "addresses: expected those of at most ", kMostPeers,
                  " ranks, got ", view.ranks);
  STD_TORCH_CHECK(rank >= 0 && rank < view.ranks, "rank: expected a number below ", view.ranks, ", got ", rank);
  view.region_bytes = memory.size(0) / view.ranks / 8 * 8;
  STD_TORCH_CHECK(view.region_bytes >= kFlagBytes, "memory: too small for the flags");
  return view;
}

inline void check_message_size(const PeerMemory& memory, int64_t count) {
  STD_TORCH_CHECK(8 * count <= memory.slot_bytes(), "memory: too small for a message of ", 8 * count, " bytes");
}

inline PeerRows peer_rows(const PeerMemory& memory, const Tensor& given, const std::vector<int64_t>& counts,
                          const char* name) {
  STD_TORCH_CHECK(static_cast<int64_t>(counts.size()) == memory.ranks, name, ": expected ", memory.ranks,
                  " numbers, got ", counts.size());
  PeerRows view{rows<int64_t>(given, name, {kAnySize}), {}};
  for (size_t rank = 0; rank < counts.size(); ++rank) {
    STD_TORCH_CHECK(counts[rank] >= 0, name, ": expected numbers >= 0, got ", counts[rank]);
    check_message_size(memory, counts[rank] + 1);
    view.begin[rank + 1] = view.begin[rank] + counts[rank];
  }
  STD_TORCH_CHECK(view.begin[counts.size()] == given.size(0), name, ": expected numbers that sum up to ", given.size(0),
                  " rows");
  return view;
}

inline Tensor peer_gather(const Tensor& values, const Tensor& memory, const Tensor& addresses, int64_t stop,
                          int64_t rank) {
  const PeerMemory view = peer_memory(memory, addresses, stop, rank);
  const int64_t count = values.size(0);
  check_message_size(view, count);
  Tensor gathered = new_tensor<int64_t>(values, {view.ranks, count});
  const CudaSession session(values);
  pgccd::peer_gather(session.context(), view,
                     {rows<int64_t>(values, "values", {count}), count, data<int64_t>(gathered)});
  return gathered;
}

inline void peer_minimum(Tensor values, const Tensor& sent_rows, std::vector<int64_t> sent, const Tensor& received_rows,
                         std::vector<int64_t> received, const std::optional<Tensor>& found,
                         std::optional<Tensor> anywhere, const Tensor& memory, const Tensor& addresses, int64_t stop,
                         int64_t rank) {
  const PeerMemory view = peer_memory(memory, addresses, stop, rank);
  rows<double>(values, "values", {kAnySize});
  PeerMinimum message{data<double>(values), values.size(0), peer_rows(view, sent_rows, sent, "sent"),
                      peer_rows(view, received_rows, received, "received")};
  STD_TORCH_CHECK(found.has_value() == anywhere.has_value(), "found, anywhere: expected both or none");
  if (found.has_value()) {
    message.found = rows<int64_t>(*found, "found", {1});
    rows<int64_t>(*anywhere, "anywhere", {1});
    message.anywhere = data<int64_t>(*anywhere);
  }
  const CudaSession session(values);
  pgccd::peer_minimum(session.context(), view, message);
}

inline void register_peer_ops(Library& library) {
  library.impl("peer_gather", PGCCD_BOX(peer_gather));
  library.impl("peer_minimum", PGCCD_BOX(peer_minimum));
}

}  // namespace pgccd::bind
