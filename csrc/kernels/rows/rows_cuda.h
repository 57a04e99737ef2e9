// Rows of columns, on the device: contracts as in rows.h. Does not synchronise.
#pragma once

#include "kernels/device_context.h"
#include "kernels/rows/rows.h"

namespace pgccd {

void copy_rows_cuda(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const ChosenRows& rows);

void merge_rows_cuda(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const RowChange& change);

}  // namespace pgccd
