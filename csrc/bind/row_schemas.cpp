// Operators that move rows of columns: tensors of any type and width with equal numbers of rows.
//
// packed (rows, bytes) u8: a row's bytes in all columns, in order; rows, removed (rows,) i64
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def("pack_rows(Tensor[] columns, Tensor rows) -> Tensor");
  library.def("unpack_rows(Tensor packed, Tensor[] like) -> Tensor[]");
  library.def("take_rows(Tensor[] columns, Tensor[] more, Tensor rows) -> Tensor[]");
  library.def("merge_rows(Tensor[] columns, Tensor removed, Tensor packed) -> Tensor[]");
}
