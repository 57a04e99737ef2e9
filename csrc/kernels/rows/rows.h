// Rows of columns: selected, packed, merged. Columns are processed as bytes. Throws for rows out of range.
#pragma once

#include <vector>

#include "kernels/executor.h"
#include "kernels/rows/rows_item.h"

namespace pgccd {

void copy_rows_cpu(const Executor& executor, const std::vector<ColumnCopy>& columns, const ChosenRows& rows);

// The first array of each column's source has the present rows, the second the added ones.
void merge_rows_cpu(const Executor& executor, const std::vector<ColumnCopy>& columns, const RowChange& change);

}  // namespace pgccd
