// The operators that move rows of columns, templates over the session that they run in. Columns are tensors of any type
// and width with one row per body, copied as bytes.
#pragma once

#include "bind/outputs.h"
#include "kernels/rows/rows.h"

namespace pgccd::bind {

// Bytes of a tile are counted in 32 bits.
constexpr int64_t kMostRowBytes = int64_t{1} << 26;

inline bool on_same_device(const Tensor& a, const Tensor& b) {
  return a.is_cuda() == b.is_cuda() && a.get_device_index() == b.get_device_index();
}

// Layout of columns; `data` is null for columns that only describe a layout.
class ColumnViews {
 public:
  // All on the device of `like`.
  ColumnViews(const TensorList& columns, const char* name, const Tensor& like) : columns_(columns), name_(name) {
    for (size_t k = 0; k < columns.size(); ++k) {
      const Tensor& column = columns[k];
      STD_TORCH_CHECK(column.dim() > 0, name, "[", k, "]: expected one dimension at least");
      STD_TORCH_CHECK(on_same_device(column, like), name, "[", k, "]: on another device than the rest");
      int64_t width = static_cast<int64_t>(column.element_size());
      for (int64_t axis = 1; axis < column.dim(); ++axis) width *= column.size(axis);
      widths_.push_back(width);
      row_bytes_ += width;
    }
    STD_TORCH_CHECK(row_bytes_ < kMostRowBytes, name, ": rows of ", row_bytes_, " bytes; expected fewer than ",
                    kMostRowBytes);
  }

  // Number of rows; requires contiguous columns of equal length.
  int64_t require_rows() const {
    const int64_t count = columns_.empty() ? 0 : columns_[0].size(0);
    for (size_t k = 0; k < columns_.size(); ++k) {
      STD_TORCH_CHECK(columns_[k].size(0) == count, name_, "[", k, "]: expected ", count, " rows as in the first, got ",
                      columns_[k].size(0));
      STD_TORCH_CHECK(columns_[k].is_contiguous(), name_, "[", k, "]: expected a contiguous tensor");
    }
    return count;
  }

  void require_like(const ColumnViews& other) const {
    STD_TORCH_CHECK(size() == other.size(), name_, ": expected ", other.size(), " tensors, got ", size());
    for (size_t k = 0; k < size(); ++k) {
      STD_TORCH_CHECK(columns_[k].scalar_type() == other.columns_[k].scalar_type(), name_, "[", k, "]: wrong dtype");
      STD_TORCH_CHECK(width(k) == other.width(k), name_, "[", k, "]: expected rows of ", other.width(k), " bytes, got ",
                      width(k));
    }
  }

  size_t size() const { return columns_.size(); }
  int64_t width(size_t k) const { return widths_[k]; }
  int64_t row_bytes() const { return row_bytes_; }
  const uint8_t* data(size_t k) const { return static_cast<const uint8_t*>(columns_[k].data_ptr()); }

  // New columns of the same types and widths with `count` rows.
  TensorList new_columns(int64_t count) const {
    TensorList made;
    for (size_t k = 0; k < size(); ++k) {
      const auto shape = columns_[k].sizes();
      std::vector<int64_t> sizes(shape.begin(), shape.end());
      sizes[0] = count;
      made.push_back(new_empty(columns_[k], sizes, columns_[k].scalar_type(), count * width(k)));
    }
    return made;
  }

 private:
  const TensorList& columns_;
  const char* name_;
  std::vector<int64_t> widths_;
  int64_t row_bytes_ = 0;
};

// Copies of all columns with a nonzero width; make(k, bytes of a row before column k) returns source and target.
template <class Make>
std::vector<ColumnCopy> column_copies(const ColumnViews& views, const Make& make) {
  std::vector<ColumnCopy> copies;
  int64_t offset = 0;
  for (size_t k = 0; k < views.size(); ++k) {
    if (views.width(k) == 0) continue;
    ColumnCopy copy = make(k, offset);
    copy.width = static_cast<uint32_t>(views.width(k));
    copies.push_back(copy);
    offset += views.width(k);
  }
  return copies;
}

template <class Session>
struct RowOps {
  static Tensor pack_rows(const TensorList& columns, const Tensor& rows) {
    ChosenRows chosen = chosen_rows(rows);
    const ColumnViews views(columns, "columns", rows);
    chosen.source_count = columns.empty() ? INT64_MAX : views.require_rows();
    Tensor packed = new_tensor<uint8_t>(rows, {chosen.count, views.row_bytes()});
    uint8_t* target = data<uint8_t>(packed);
    const auto copies = column_copies(views, [&](size_t k, int64_t offset) {
      return ColumnCopy{views.data(k), nullptr, target + offset, views.width(k), 0, views.row_bytes(), 0};
    });
    pgccd::copy_rows(Session(rows).context(), copies, chosen);
    return packed;
  }

  static TensorList unpack_rows(const Tensor& packed, const TensorList& like) {
    const ColumnViews views(like, "like", packed);
    const uint8_t* source = bind::rows<uint8_t>(packed, "packed", {kAnySize, views.row_bytes()});
    const int64_t count = packed.size(0);
    TensorList columns = views.new_columns(count);
    const auto copies = column_copies(views, [&](size_t k, int64_t offset) {
      return ColumnCopy{source + offset, nullptr, data<uint8_t>(columns[k]), views.row_bytes(), 0, views.width(k), 0};
    });
    pgccd::copy_rows(Session(packed).context(), copies, {nullptr, count, count, count});
    return columns;
  }

  static TensorList take_rows(const TensorList& columns, const TensorList& more, const Tensor& rows) {
    ChosenRows chosen = chosen_rows(rows);
    const ColumnViews views(columns, "columns", rows), following(more, "more", rows);
    chosen.first_count = chosen.source_count = columns.empty() ? INT64_MAX : views.require_rows();
    if (!more.empty()) {
      following.require_like(views);
      chosen.source_count += following.require_rows();
    } else {
      chosen.first_count = INT64_MAX;
    }
    TensorList taken = views.new_columns(chosen.count);
    const auto copies = column_copies(views, [&](size_t k, int64_t) {
      const uint8_t* second = more.empty() ? nullptr : following.data(k);
      const int64_t width = views.width(k);
      return ColumnCopy{views.data(k), second, data<uint8_t>(taken[k]), width, width, width, 0};
    });
    pgccd::copy_rows(Session(rows).context(), copies, chosen);
    return taken;
  }

  static void commit_rows(const TensorList& columns, const TensorList& values, const Tensor& id,
                          const Tensor& discard) {
    const int64_t* ids = bind::rows<int64_t>(id, "id", {kAnySize});
    const int64_t count = id.size(0);
    const CommittedRows rows{ids, bind::rows<int64_t>(discard, "discard", {1}), count, count};
    const ColumnViews targets(columns, "columns", id), sources(values, "values", id);
    sources.require_like(targets);
    if (columns.empty()) return;
    STD_TORCH_CHECK(targets.require_rows() == count && sources.require_rows() == count,
                    "columns, values: expected a row per id, ", count);
    const auto copies = column_copies(targets, [&](size_t k, int64_t) {
      const int64_t width = targets.width(k);
      return ColumnCopy{
          sources.data(k), targets.data(k), const_cast<uint8_t*>(targets.data(k)), width, width, width, 0};
    });
    pgccd::commit_rows(Session(id).context(), copies, rows);
  }

  static TensorList merge_rows(const TensorList& columns, const Tensor& removed, const Tensor& packed) {
    STD_TORCH_CHECK(!columns.empty(), "columns: expected ids at least");
    const ColumnViews views(columns, "columns", packed);
    STD_TORCH_CHECK(on_same_device(removed, packed), "removed: on another device than the rest");
    RowChange change;
    change.count = views.require_rows();
    change.id = bind::rows<int64_t>(columns[0], "columns[0] (ids)", {kAnySize});
    change.removed = bind::rows<int64_t>(removed, "removed", {kAnySize});
    change.removed_count = removed.size(0);
    STD_TORCH_CHECK(change.removed_count <= change.count, "removed: ", change.removed_count, " of ", change.count,
                    " rows");
    change.added = bind::rows<uint8_t>(packed, "packed", {kAnySize, views.row_bytes()});
    change.added_stride = views.row_bytes();
    change.added_count = packed.size(0);
    TensorList merged = views.new_columns(change.merged_count());
    const auto copies = column_copies(views, [&](size_t k, int64_t offset) {
      const int64_t width = views.width(k);
      return ColumnCopy{
          views.data(k), change.added + offset, data<uint8_t>(merged[k]), width, change.added_stride, width, 0};
    });
    pgccd::merge_rows(Session(packed).context(), copies, change);
    return merged;
  }

 private:
  static ChosenRows chosen_rows(const Tensor& rows) {
    return {bind::rows<int64_t>(rows, "rows", {kAnySize}), rows.size(0), INT64_MAX, 0};
  }
};

template <class Session>
void register_row_ops(Library& library) {
  using Ops = RowOps<Session>;
  library.impl("pack_rows", PGCCD_BOX(Ops::pack_rows));
  library.impl("unpack_rows", PGCCD_BOX(Ops::unpack_rows));
  library.impl("take_rows", PGCCD_BOX(Ops::take_rows));
  library.impl("commit_rows", PGCCD_BOX(Ops::commit_rows));
  library.impl("merge_rows", PGCCD_BOX(Ops::merge_rows));
}

}  // namespace pgccd::bind
