// Rows of columns: selected, packed, merged. Columns are processed as bytes. Throws for rows out of range; on a device,
// which is not synchronised, the launch fails.
#pragma once

#include <vector>

#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/rows/rows_item.h"

namespace pgccd {

void copy_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const ChosenRows& rows);
void copy_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const ChosenRows& rows);

// Overwrites the rows of bodies: the target of each column is also its second array.
void commit_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const CommittedRows& rows);
void commit_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const CommittedRows& rows);

// The first array of each column's source has the present rows, the second the added ones.
void merge_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const RowChange& change);
void merge_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const RowChange& change);

}  // namespace pgccd
