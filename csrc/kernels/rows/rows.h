// Rows of columns: chosen, packed side by side, merged. Columns are bytes. Throws for rows that are not
// there.
#pragma once

#include <vector>

#include "kernels/executor.h"
#include "kernels/rows/rows_item.h"

namespace pgccd {

void copy_rows_cpu(const Executor& executor, const std::vector<ColumnCopy>& columns, const ChosenRows& rows);

// The first array of each column's source is what is there, the second what is added.
void merge_rows_cpu(const Executor& executor, const std::vector<ColumnCopy>& columns, const RowChange& change);

}  // namespace pgccd
