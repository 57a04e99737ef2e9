// Messages between GPUs of one host, see kernels/peers/peers.h. On GPUs only.
//
// memory (ranks * region bytes,) u8, of this rank; addresses (ranks,) i64 of the memory of each rank; stop: address of
// an i64 in host memory
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def("peer_gather(Tensor values, Tensor(a!) memory, Tensor addresses, int stop, int rank) -> Tensor");
  library.def(
      "peer_minimum(Tensor(a!) values, Tensor sent_rows, int[] sent, Tensor received_rows, int[] received, "
      "Tensor? found, Tensor(c!)? anywhere, Tensor(b!) memory, Tensor addresses, int stop, int rank) -> ()");
}
