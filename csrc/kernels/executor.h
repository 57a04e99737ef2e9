// Threads of CPU kernels. The kernels depend on no threading library; the binding provides torch's pool.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <stdexcept>
#include <string>

namespace pgccd {

class Executor {
 public:
  virtual ~Executor() = default;
  virtual int worker_count() const = 0;
  // Calls work(worker) once for every worker in [0, workers), workers <= worker_count(), possibly concurrently; returns
  // when all are done.
  virtual void run(int workers, const std::function<void(int)>& work) const = 0;
};

// Calls fn(worker, begin, end) on chunks of [0, count). Workers take the next chunk when they are free, so items may
// differ in cost by orders of magnitude. The assignment of chunks to workers is not specified.
template <class Fn>
void parallel_chunks(const Executor& executor, int64_t count, int64_t grain, Fn&& fn) {
  if (count <= 0) return;
  const int64_t chunks = (count + grain - 1) / grain;
  const int workers = static_cast<int>(std::min<int64_t>(chunks, executor.worker_count()));
  std::atomic<int64_t> next{0};
  executor.run(workers, [&](int worker) {
    for (int64_t chunk = next.fetch_add(1); chunk < chunks; chunk = next.fetch_add(1)) {
      fn(worker, chunk * grain, std::min(count, (chunk + 1) * grain));
    }
  });
}

// Throws an error that names the argument and the first row for which `is_sound` is false.
template <class IsSound>
void require_rows(const Executor& executor, int64_t count, const char* name, const char* expected, IsSound&& is_sound) {
  std::atomic<int64_t> first{count};
  parallel_chunks(executor, count, 8192, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      if (is_sound(row)) continue;
      int64_t seen = first.load();
      while (row < seen && !first.compare_exchange_weak(seen, row)) {
      }
      return;
    }
  });
  if (first == count) return;
  throw std::invalid_argument(std::string(name) + ": row " + std::to_string(first.load()) + ": expected rows that " +
                              expected);
}

// The clock that the counts of a search on the CPU refer to.
inline int64_t host_nanoseconds() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
}

// Adds to a counter, atomically unless `alone`; returns its previous value.
template <class T>
T add_shared(T& counter, T amount, bool alone) {
  if (!alone) return std::atomic_ref<T>(counter).fetch_add(amount, std::memory_order_relaxed);
  const T before = counter;
  counter += amount;
  return before;
}

}  // namespace pgccd
