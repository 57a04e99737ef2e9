// Rows of columns, on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/cuda_backend.h"
#include "bind/row_ops.h"
#include "kernels/rows/rows_cuda.h"

namespace pgccd::bind {
namespace {

class RowsOnCuda {
 public:
  explicit RowsOnCuda(const Tensor& like) : session_(like) {}

  void copy_rows(const std::vector<ColumnCopy>& columns, const ChosenRows& rows) const {
    copy_rows_cuda(session_.context(), columns, rows);
  }
  void merge_rows(const std::vector<ColumnCopy>& columns, const RowChange& change) const {
    merge_rows_cuda(session_.context(), columns, change);
  }

 private:
  CudaSession session_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) { PGCCD_REGISTER_ROW_OPS(library, RowsOnCuda); }

}  // namespace pgccd::bind

#endif
