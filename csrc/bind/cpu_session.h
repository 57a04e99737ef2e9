// What an operator on the CPU runs on: torch's thread pool.
#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <exception>
#include <mutex>

#include "kernels/executor.h"

namespace pgccd::bind {

// Follows torch.set_num_threads.
class TorchExecutor final : public Executor {
 public:
  int worker_count() const override { return static_cast<int>(torch::stable::get_num_threads()); }

  void run(int workers, const std::function<void(int)>& work) const override {
    if (workers == 1) return work(0);
    // An exception inside parallel_for would lose its message, so it is rethrown outside.
    std::exception_ptr failure;
    std::mutex failure_mutex;
    torch::stable::parallel_for(0, workers, 1, [&](int64_t begin, int64_t end) {
      try {
        for (int64_t worker = begin; worker < end; ++worker) work(static_cast<int>(worker));
      } catch (...) {
        const std::lock_guard lock(failure_mutex);
        failure = std::current_exception();
      }
    });
    if (failure) std::rethrow_exception(failure);
  }
};

class CpuSession {
 public:
  static constexpr bool kHostKnowsCounts = true;  // the host can allocate after counting, without waiting

  explicit CpuSession(const torch::stable::Tensor&) {}

  const Executor& context() const { return executor_; }

 private:
  TorchExecutor executor_;
};

}  // namespace pgccd::bind
