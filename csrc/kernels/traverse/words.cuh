// Structures copied 16 bytes at a time: a thread then reads or writes its row in few instructions, which matters when
// neighbouring threads' rows are far apart.
#pragma once

#include <cstring>
#include <type_traits>

#include "kernels/device.cuh"

namespace pgccd {

template <class T>
constexpr int kWordsOf = static_cast<int>(sizeof(T) / sizeof(uint4));

template <class T>
constexpr bool kIsOfWords = std::is_trivially_copyable_v<T> && sizeof(T) % sizeof(uint4) == 0 && alignof(T) >= 16;

// Copies with one thread.
template <class T>
__device__ void put_words(const T& source, uint4* words) {
  static_assert(kIsOfWords<T>);
  uint4 copied[kWordsOf<T>];
  memcpy(copied, &source, sizeof(T));
  for (int k = 0; k < kWordsOf<T>; ++k) words[k] = copied[k];
}

template <class T>
__device__ void store_words(const T& source, T& target) {
  put_words(source, reinterpret_cast<uint4*>(&target));
}

// Copies with the threads of slots 0 to `threads` - 1.
template <class T>
__device__ void copy_words(const T& source, T& target, int slot, int threads) {
  static_assert(kIsOfWords<T>);
  const auto* from = reinterpret_cast<const uint4*>(&source);
  auto* to = reinterpret_cast<uint4*>(&target);
  for (int k = slot; k < kWordsOf<T>; k += threads) to[k] = from[k];
}

}  // namespace pgccd
