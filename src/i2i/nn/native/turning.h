// Rows to columns, in registers.

#pragma once

#include <cstddef>
#include <utility>

#include "lanes.h"

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define I2I_HAS_SHUFFLES
#endif
#endif

namespace i2i {

#if defined(I2I_HAS_SHUFFLES)
// The lower or upper halves of two vectors, one number of each in turn.
template <class V, size_t... lane>
inline V in_turn(V first, V second, bool upper, std::index_sequence<lane...>) {
  constexpr int size = sizeof...(lane);
  if (upper) {
    return __builtin_shufflevector(first, second, (size / 2 + lane / 2 + lane % 2 * size)...);
  }
  return __builtin_shufflevector(first, second, (lane / 2 + lane % 2 * size)...);
}
#endif

// (row, column) to (column, row): the numbers of kRows vectors, one vector after the other. kRows is
// a power of two and at most the size of a vector.
template <class T, int kRows>
inline void turn(typename Lane<T>::Vec (&rows)[kRows]) {
  constexpr int size = Lane<T>::size;
  static_assert(kRows <= size && (kRows & (kRows - 1)) == 0, "rows");
  typename Lane<T>::Vec next[kRows];
#if defined(I2I_HAS_SHUFFLES)
  const auto lanes = std::make_index_sequence<size>();
#pragma GCC unroll 4
  for (int done = 1; done < kRows; done *= 2) {
#pragma GCC unroll 8
    for (int i = 0; i < kRows / 2; ++i) {
      next[2 * i] = in_turn(rows[i], rows[i + kRows / 2], false, lanes);
      next[2 * i + 1] = in_turn(rows[i], rows[i + kRows / 2], true, lanes);
    }
#pragma GCC unroll 16
    for (int i = 0; i < kRows; ++i) rows[i] = next[i];
  }
#else
  T* to = reinterpret_cast<T*>(next);
  for (int i = 0; i < kRows * size; ++i) to[i] = rows[i % kRows][i / kRows];
  std::memcpy(rows, next, sizeof(next));
#endif
}

}  // namespace i2i
