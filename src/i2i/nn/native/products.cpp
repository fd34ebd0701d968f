// Products of matrices: the blocks of the C4-spectral convolution with spectra, and their gradients.
//
//   c[n][i][j] = sum_k a[n][i][k] b[n][k][j]        (+ bias[j], clipped at 0)
//
// Torch's own products are MKL's, which leaves half of the registers of a processor with AVX-512
// unused unless Intel made it. Here a tile of c is summed in registers over up to kDepth k's; what it
// is made of has been put in order for it. Every number is the same sum, whatever the threads.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "turning.h"

extern "C" {

// In the order in which native/products.py gives them; steps from one number to the next.
struct I2iProducts {
  int64_t count, rows, depth, columns;
  int64_t a_step, a_row, a_column;
  int64_t b_step, b_row, b_column;
  int64_t c_step, c_row;  // columns of c lie side by side
};
}

namespace {

using namespace i2i;

#if defined(__AVX512F__)
constexpr int kTileRows = 12, kTileVectors = 2;
#else
constexpr int kTileRows = 6, kTileVectors = 1;
#endif
constexpr int kRowsAtOnce = 3;       // that one pointer reaches: a processor has few of them
constexpr int kTilesAtOnce = 4;      // of a, put in order together: whole lines are read
constexpr int64_t kDepth = 640;      // of a tile's sums
constexpr int64_t kWidth = 512;      // columns of b that are put in order together

template <class T>
constexpr int kTileColumns = kTileVectors * Lane<T>::size;

template <class T>
struct Matrix {
  const T* first;
  int64_t row, column;  // steps
  const T* at(int64_t i, int64_t j) const { return first + i * row + j * column; }
  Matrix from(int64_t i, int64_t j) const { return {at(i, j), row, column}; }
};

// What a tile's sums become: more of what is there, and, when they are whole, what follows them.
template <class T>
struct Finish {
  bool add;
  const T* bias;  // of the tile's columns, or none
  bool relu;
  Finish from(int64_t column) const { return {add, bias ? bias + column : nullptr, relu}; }
  // `count` sums, in T or in vectors of it.
  template <class V>
  V operator()(V sum, const T* there, int64_t column, int count) const {
    if (add) sum += load_as(V(), there, count);
    if (bias) sum += load_as(V(), bias + column, count);
    return relu ? (sum < 0 ? V{} : sum) : sum;  // keeps what is not a number
  }

 private:
  static T load_as(T, const T* from, int) { return *from; }
  static typename Lane<T>::Vec load_as(typename Lane<T>::Vec, const T* from, int count) {
    return load_one<T>(from, count);
  }
};

// Room of this thread, which it keeps; begins with a line.
template <class T, int kUse>
T* room(int64_t size) {
  static thread_local std::vector<T> memory;
  const size_t wanted = size + kLineBytes / sizeof(T);
  if (memory.size() < wanted) memory.resize(wanted);
  T* first = memory.data();
  while (!is_line_start(first)) ++first;
  return first;
}

// A tile of c, or the part of it in its first kVectors. Ordered: a[k][i] of whole tiles; otherwise
// rows of a matrix.
template <class T, bool kOrdered, int kVectors>
void tile(const T* a, int64_t row_step, const T* b, int64_t depth, T* c, int64_t pitch,
          const Finish<T>& finish) {
  constexpr int size = Lane<T>::size;
  typename Lane<T>::Vec sums[kTileRows][kVectors] = {};
  const int64_t step = kOrdered ? 1 : row_step;
  const T* rows[kTileRows / kRowsAtOnce];
#pragma GCC unroll 12
  for (int i = 0; i < kTileRows / kRowsAtOnce; ++i) rows[i] = a + i * kRowsAtOnce * step;
  for (int64_t k = 0; k < depth; ++k) {
    typename Lane<T>::Vec row[kVectors];
#pragma GCC unroll 2
    for (int v = 0; v < kVectors; ++v) {
      row[v] = load_one<T>(b + k * kTileVectors * size + v * size, size);
    }
#pragma GCC unroll 12
    for (int i = 0; i < kTileRows; ++i) {
      const T value = rows[i / kRowsAtOnce][i % kRowsAtOnce * step];
#pragma GCC unroll 2
      for (int v = 0; v < kVectors; ++v) sums[i][v] += value * row[v];
    }
#pragma GCC unroll 12
    for (auto& at : rows) at += kOrdered ? kTileRows : 1;
  }
  for (int i = 0; i < kTileRows; ++i) {
    for (int v = 0; v < kVectors; ++v) {
      T* at = c + i * pitch + v * size;
      store_one<T>(at, size, finish(sums[i][v], at, v * size, size));
    }
  }
}

// Columns that lie one after the other in memory, `step` apart, to rows `width` apart; a vector each.
template <class T>
void turn_over(const T* from, int64_t step, T* to, int64_t width) {
  constexpr int size = Lane<T>::size;
  typename Lane<T>::Vec lines[size];
  for (int i = 0; i < size; ++i) lines[i] = load_one<T>(from + i * step, size);
  turn<T, size>(lines);
  for (int i = 0; i < size; ++i) store_one<T>(to + i * width, size, lines[i]);
}

// Columns of b as tiles want them: (tile, k, column), filled up with zeros.
template <class T>
void order_right(const Matrix<T>& b, int64_t depth, int64_t columns, T* to) {
  constexpr int width = kTileColumns<T>;
  for (int64_t j = 0; j < columns; j += width) {
    const int count = static_cast<int>(std::min<int64_t>(width, columns - j));
    int64_t k = 0;
    constexpr int size = Lane<T>::size;
    for (; b.row == 1 && count == width && k + size <= depth; k += size, to += size * width) {
      for (int c = 0; c < width; c += size) turn_over(b.at(k, j + c), b.column, to + c, width);
    }
    for (; k < depth; ++k, to += width) {
      const T* from = b.at(k, j);
      if (b.column == 1) {
        std::copy(from, from + count, to);
      } else {
        for (int c = 0; c < count; ++c) to[c] = from[c * b.column];
      }
      std::fill(to + count, to + width, T(0));
    }
  }
}

// Rows of a as tiles want them: (tile, k, row), filled up with zeros.
template <class T>
void order_left(const Matrix<T>& a, int64_t depth, int64_t rows, T* to) {
  constexpr int64_t line = kLineBytes / sizeof(T), ahead = kTilesAtOnce * kTileRows;
  for (int64_t k = 0; k < depth; ++k, to += kTileRows) {
    T* of_tile = to;
    // What comes next lies pages apart: a processor does not see it coming.
    if (a.row == 1) {
      for (int64_t i = 0; i < ahead; i += line) __builtin_prefetch(a.at(ahead + i, k), 0, 2);
    }
    for (int64_t i = 0; i < rows; i += kTileRows, of_tile += depth * kTileRows) {
      const T* from = a.at(i, k);
      const int count = static_cast<int>(std::min<int64_t>(kTileRows, rows - i));
      if (a.row == 1 && count == kTileRows) {
        std::memcpy(of_tile, from, kTileRows * sizeof(T));
        continue;
      }
      for (int r = 0; r < count; ++r) of_tile[r] = from[r * a.row];
      std::fill(of_tile + count, of_tile + kTileRows, T(0));
    }
  }
}

// A tile's rows of c: `a` ordered or, with rows a step apart, as it is.
template <class T, bool kOrdered>
void tiles_of_rows(const T* a, int64_t row_step, const T* b, int64_t depth, int rows,
                   int64_t columns, T* c, int64_t pitch, const Finish<T>& finish) {
  constexpr int width = kTileColumns<T>;
  for (int64_t j = 0; j < columns; j += width, b += depth * width) {
    const int count = static_cast<int>(std::min<int64_t>(width, columns - j));
    const bool is_narrow = count <= Lane<T>::size;
    const auto sum = is_narrow ? tile<T, kOrdered, 1> : tile<T, kOrdered, kTileVectors>;
    if (rows == kTileRows && count == (is_narrow ? Lane<T>::size : width)) {
      sum(a, row_step, b, depth, c + j, pitch, finish.from(j));
      continue;
    }
    alignas(kLineBytes) T edge[kTileRows * width];
    sum(a, row_step, b, depth, edge, width, {false, nullptr, false});
    for (int i = 0; i < rows; ++i) {
      T* at = c + i * pitch + j;
      for (int x = 0; x < count; ++x) at[x] = finish(edge[i * width + x], at + x, j + x, 1);
    }
  }
}

template <class T>
void rows_of(const Matrix<T>& a, const T* b, int64_t depth, int64_t rows, int64_t columns, T* c,
             int64_t pitch, const Finish<T>& finish) {
  constexpr int64_t together = kTilesAtOnce * kTileRows;
  T* ordered = room<T, 0>(together * kDepth);
  for (int64_t i = 0; i < rows; i += together) {
    const int64_t some = std::min(together, rows - i);
    const bool as_it_is = a.column == 1 && some % kTileRows == 0;
    if (!as_it_is) order_left(a.from(i, 0), depth, some, ordered);
    for (int64_t r = 0; r < some; r += kTileRows) {
      const int count = static_cast<int>(std::min<int64_t>(kTileRows, some - r));
      T* to = c + (i + r) * pitch;
      if (as_it_is) {
        // A new row is far from the last one: a processor does not see it coming.
        for (int64_t next = 0; next < kTileRows; ++next) {
          const T* row = a.at(i + r + kTileRows + next, 0);
          for (int64_t k = 0; k < depth; k += kLineBytes / sizeof(T)) {
            __builtin_prefetch(row + k, 0, 2);
          }
        }
        tiles_of_rows<T, false>(a.at(i + r, 0), a.row, b, depth, count, columns, to, pitch,
                                finish);
      } else {
        tiles_of_rows<T, true>(ordered + r * depth, 0, b, depth, count, columns, to, pitch,
                               finish);
      }
    }
  }
}

template <class T>
void product(const Matrix<T>& a, const Matrix<T>& b, T* c, const T* bias, bool relu,
             const I2iProducts& shape, int64_t rows) {
  T* right = room<T, 1>(kDepth * (kWidth + kTileColumns<T>));
  for (int64_t j = 0; j < shape.columns; j += kWidth) {
    const int64_t width = std::min(kWidth, shape.columns - j);
    for (int64_t k = 0; k < shape.depth; k += kDepth) {
      const int64_t depth = std::min(kDepth, shape.depth - k);
      order_right(b.from(k, j), depth, width, right);
      const bool last = k + depth == shape.depth;
      const Finish<T> finish{k > 0, last && bias ? bias + j : nullptr, last && relu};
      rows_of(a.from(0, k), right, depth, rows, width, c + j, shape.c_row, finish);
    }
  }
}

template <class T>
void products(const T* a, const T* b, T* c, const T* bias, bool relu, const I2iProducts& shape,
              int threads) {
  // Parts of a product's rows where there are fewer products than threads can share.
  const int64_t tiles = (shape.rows + kTileRows - 1) / kTileRows;
  const int64_t wanted = shape.count == 1 ? threads : (2 * threads - 1) / shape.count + 1;
  const int64_t parts = std::min(threads == 1 ? 1 : wanted, tiles);
#pragma omp parallel for num_threads(threads) schedule(dynamic)
  for (int64_t task = 0; task < shape.count * parts; ++task) {
    const int64_t n = task / parts, part = task % parts;
    const int64_t first = tiles * part / parts * kTileRows;
    const int64_t end = std::min(shape.rows, tiles * (part + 1) / parts * kTileRows);
    const Matrix<T> left{a + n * shape.a_step, shape.a_row, shape.a_column};
    const Matrix<T> right{b + n * shape.b_step, shape.b_row, shape.b_column};
    product(left.from(first, 0), right, c + n * shape.c_step + first * shape.c_row, bias, relu,
            shape, end - first);
  }
}

}  // namespace

extern "C" {

// Whether these products are worth taking: see above.
int i2i_has_fast_products() {
#if defined(__AVX512F__)
  __builtin_cpu_init();
  return !__builtin_cpu_is("intel");
#else
  return 0;
#endif
}

void i2i_products(const void* a, const void* b, void* c, const void* bias, int relu,
                  const I2iProducts* shape, int is_double, int threads) {
  if (is_double) {
    products(as<double>(a), as<double>(b), as<double>(c), as<double>(bias), relu, *shape, threads);
  } else {
    products(as<float>(a), as<float>(b), as<float>(c), as<float>(bias), relu, *shape, threads);
  }
}
}
