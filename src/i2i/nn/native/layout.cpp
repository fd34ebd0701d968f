// Maps (B, C * 4, P), whose cells lie side by side, to (P, 4, C, B), whose images do, and back; and
// the gradient of the maximum over the four turns of the latter.

#include <cstdint>

#include "lanes.h"

namespace {

using namespace i2i;

constexpr int64_t kTile = 16;
constexpr int64_t kTurns = 4;

// One tile of `rows` x `columns`, turned over in the cache and written in whole lines where it can be.
template <class T>
inline void turn_tile(const T* from, int64_t from_step, T* to, int64_t to_step, int64_t rows,
                      int64_t columns) {
  alignas(kLineBytes) T tile[kTile][kTile];
  for (int64_t r = 0; r < rows; ++r) {
    for (int64_t c = 0; c < columns; ++c) tile[c][r] = from[r * from_step + c];
  }
  const bool in_lines = rows == kTile && is_line_start(to) && to_step * sizeof(T) % kLineBytes == 0;
  for (int64_t c = 0; c < columns; ++c) {
    if (in_lines) {
      for (unsigned part = 0; part < sizeof(tile[0]); part += kLineBytes) {
        stream_line(reinterpret_cast<char*>(to + c * to_step) + part,
                    reinterpret_cast<const char*>(tile[c]) + part);
      }
    } else {
      std::memcpy(to + c * to_step, tile[c], rows * sizeof(T));
    }
  }
}

template <class T>
void turn_over(const T* from, T* to, bool to_pixel_major, int64_t rows, int64_t fields,
               int64_t columns, int threads) {
  const int64_t channels = fields * kTurns;
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t channel = 0; channel < channels; ++channel) {
    const int64_t stacked = channel % kTurns * fields + channel / kTurns;
    const int64_t source = to_pixel_major ? channel : stacked;
    const int64_t target = to_pixel_major ? stacked : channel;
    for (int64_t c = 0; c < columns; c += kTile) {
      for (int64_t r = 0; r < rows; r += kTile) {
        turn_tile(from + (r * channels + source) * columns + c, channels * columns,
                  to + (c * channels + target) * rows + r, channels * rows,
                  rows - r < kTile ? rows - r : kTile, columns - c < kTile ? columns - c : kTile);
      }
    }
    finish_streams();
  }
}

// Where several turns are the largest each gets an equal share, as of torch's amax.
template <class T>
void turn_max_backward(const T* maps, const T* grad, T* result, int64_t pixels, int64_t size,
                       int threads) {
  typedef typename Lane<T>::Vec Vec;
  const bool in_lines = size % Lane<T>::size == 0 && is_line_start(result);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t pixel = 0; pixel < pixels; ++pixel) {
    for (int64_t i = 0; i < size; i += Lane<T>::size) {
      const int count = static_cast<int>(size - i < Lane<T>::size ? size - i : Lane<T>::size);
      Vec turns[kTurns];
      for (int g = 0; g < kTurns; ++g) {
        turns[g] = load_one<T>(maps + (pixel * kTurns + g) * size + i, count);
      }
      Vec best = turns[0], times = {};
      for (int g = 1; g < kTurns; ++g) {
        best = (turns[g] > best) | (turns[g] != turns[g]) ? turns[g] : best;
      }
      for (int g = 0; g < kTurns; ++g) times += turns[g] == best ? Vec{} + 1 : Vec{};
      const Vec share = load_one<T>(grad + pixel * size + i, count) / times;
      const Vec rest = best - best;  // zero, or not a number where the largest is none
      for (int g = 0; g < kTurns; ++g) {
        store_one<T>(result + (pixel * kTurns + g) * size + i, count,
                     turns[g] == best ? share : rest, in_lines);
      }
    }
    finish_streams();
  }
}

}  // namespace

// `rows` of the source's first dimension, `columns` of its last.
extern "C" void i2i_turn_over(const void* from, void* to, int to_pixel_major, int is_double,
                              int64_t rows, int64_t fields, int64_t columns, int threads) {
  const bool forward = to_pixel_major != 0;
  if (is_double) {
    turn_over(as<double>(from), as<double>(to), forward, rows, fields,
              columns, threads);
  } else {
    turn_over(as<float>(from), as<float>(to), forward, rows, fields,
              columns, threads);
  }
}

// Maps (pixels, 4, size), the gradient of their maximum (pixels, size).
extern "C" void i2i_turn_max_backward(const void* maps, const void* grad, void* result, int is_double,
                                      int64_t pixels, int64_t size, int threads) {
  if (is_double) {
    turn_max_backward(as<double>(maps), as<double>(grad),
                      as<double>(result), pixels, size, threads);
  } else {
    turn_max_backward(as<float>(maps), as<float>(grad),
                      as<float>(result), pixels, size, threads);
  }
}
