// Rows of columns, on the CPU.
#include "bind/cpu_executor.h"
#include "bind/row_ops.h"

namespace pgccd::bind {
namespace {

class RowsOnCpu {
 public:
  explicit RowsOnCpu(const Tensor&) {}

  void copy_rows(const std::vector<ColumnCopy>& columns, const ChosenRows& rows) const {
    copy_rows_cpu(executor_, columns, rows);
  }
  void merge_rows(const std::vector<ColumnCopy>& columns, const RowChange& change) const {
    merge_rows_cpu(executor_, columns, change);
  }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) { PGCCD_REGISTER_ROW_OPS(library, RowsOnCpu); }

}  // namespace pgccd::bind
