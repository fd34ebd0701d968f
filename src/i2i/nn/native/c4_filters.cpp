// The blocks of the C4-spectral convolution from the filters' coefficients, and the gradient of the
// coefficients from the gradient of the blocks: two products with one small matrix, made where the
// coefficients of one output field lie in the cache. What is written has nine times their size.
//
//   block[n][o][r][i]    = sum_k matrix[n][k][r] coefficient[o][k][i]
//   gradient[o][k][i]   += sum_n sum_r matrix[n][k][r] dblock[n][o][r][i]
//
// n: orbit, o and i: fields out and in, r: the 16 entries of a pair's block, k: coefficient.

#include <cstdint>

#include "lanes.h"

namespace {

using namespace i2i;

constexpr int kEntries = 16;

// `left`: how many of the vector's fields there are, a constant wherever it is full.

template <class T, class S>
inline void block_columns(const T* from, const T* entries, S* to, int64_t ins, int64_t count,
                          int left, bool in_lines) {
  typename Lane<T>::Vec sums[kEntries] = {};
  for (int64_t k = 0; k < count; ++k) {
    const auto x = load_one<T>(from + k * ins, left);
#pragma GCC unroll 16
    for (int r = 0; r < kEntries; ++r) sums[r] += entries[k * kEntries + r] * x;
  }
#pragma GCC unroll 16
  for (int r = 0; r < kEntries; ++r) store_one<T>(to + r * ins, left, sums[r], in_lines);
}

template <class T, class S>
inline void add_gradient(const S* from, const T* weights, T* total, int64_t ins, int64_t count,
                         int left) {
  typename Lane<T>::Vec entries[kEntries];
#pragma GCC unroll 16
  for (int r = 0; r < kEntries; ++r) entries[r] = load_one<T>(from + r * ins, left);
  for (int64_t k = 0; k < count; ++k) {
    auto sum = load_one<T>(total + k * ins, left), other = weights[k * kEntries] * entries[0];
#pragma GCC unroll 8
    for (int r = 1; r < kEntries / 2; ++r) other += weights[k * kEntries + r] * entries[r];
#pragma GCC unroll 8
    for (int r = kEntries / 2; r < kEntries; ++r) sum += weights[k * kEntries + r] * entries[r];
    store_one<T>(total + k * ins, left, sum + other);
  }
}

template <class T, class S>
void blocks_of(const T* coefficients, const T* matrix, S* blocks, int64_t orbits, int64_t outs,
               int64_t ins, int64_t count, int threads) {
  constexpr int size = Lane<T>::size;
  const bool in_lines = ins % size == 0 && is_line_start(blocks);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t o = 0; o < outs; ++o) {
    const T* from = coefficients + o * count * ins;
    for (int64_t n = 0; n < orbits; ++n) {
      const T* entries = matrix + n * count * kEntries;
      S* to = blocks + (n * outs + o) * kEntries * ins;
      int64_t i = 0;
      for (; i + size <= ins; i += size) {
        block_columns(from + i, entries, to + i, ins, count, size, in_lines);
      }
      if (i < ins) {
        block_columns(from + i, entries, to + i, ins, count, static_cast<int>(ins - i), false);
      }
    }
    finish_streams();
  }
}

template <class T, class S>
void gradient_of(const S* blocks, const T* matrix, T* gradient, int64_t orbits, int64_t outs,
                 int64_t ins, int64_t count, int threads) {
  constexpr int size = Lane<T>::size;
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t o = 0; o < outs; ++o) {
    T* total = gradient + o * count * ins;
    for (int64_t n = 0; n < orbits; ++n) {
      const S* from = blocks + (n * outs + o) * kEntries * ins;
      const T* weights = matrix + n * count * kEntries;
      int64_t i = 0;
      for (; i + size <= ins; i += size) {
        add_gradient(from + i, weights, total + i, ins, count, size);
      }
      if (i < ins) add_gradient(from + i, weights, total + i, ins, count, static_cast<int>(ins - i));
    }
  }
}

}  // namespace

extern "C" {

// types: 0 float, 1 float and blocks of bfloat16, 2 double
void i2i_blocks(const void* coefficients, const void* matrix, void* blocks, int type,
                int64_t orbits, int64_t outs, int64_t ins, int64_t count, int threads) {
  if (type == 0) {
    blocks_of(static_cast<const float*>(coefficients), static_cast<const float*>(matrix),
              static_cast<float*>(blocks), orbits, outs, ins, count, threads);
  } else if (type == 1) {
    blocks_of(static_cast<const float*>(coefficients), static_cast<const float*>(matrix),
              static_cast<uint16_t*>(blocks), orbits, outs, ins, count, threads);
  } else {
    blocks_of(static_cast<const double*>(coefficients), static_cast<const double*>(matrix),
              static_cast<double*>(blocks), orbits, outs, ins, count, threads);
  }
}

void i2i_coefficient_gradient(const void* blocks, const void* matrix, void* gradient, int type,
                              int64_t orbits, int64_t outs, int64_t ins, int64_t count,
                              int threads) {
  if (type == 0) {
    gradient_of(static_cast<const float*>(blocks), static_cast<const float*>(matrix),
                static_cast<float*>(gradient), orbits, outs, ins, count, threads);
  } else if (type == 1) {
    gradient_of(static_cast<const uint16_t*>(blocks), static_cast<const float*>(matrix),
                static_cast<float*>(gradient), orbits, outs, ins, count, threads);
  } else {
    gradient_of(static_cast<const double*>(blocks), static_cast<const double*>(matrix),
                static_cast<double*>(gradient), orbits, outs, ins, count, threads);
  }
}
}
