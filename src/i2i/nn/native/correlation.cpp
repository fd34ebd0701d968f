// The correlation of signals on half a sphere with features that the group's elements move, and its
// gradients, an image at a time: what lies between the products stays in the cache.
//
//   product[v][j][u] = sum_i signal[v][i][j] sphere[u][i]
//   out[g][j]        = sum_v product[v][j][moved[g][v]]
//
// v: place of the signal, u: place of the sphere, i: feature, j: output, g: element of the group.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "patches.h"

extern "C" {

// In the order in which native/correlation.py gives them.
struct I2iCorrelation {
  int64_t batch, length, features, outputs;  // of the signal
  int64_t spheres, places, elements;
};
}

namespace {

using namespace i2i;

#if defined(__AVX512F__)
constexpr int kSide = 8;
#else
constexpr int kSide = 2;
#endif
constexpr int kAcross = 3;  // vectors

// sums over k of a[row][k] b[k][column], for kSide rows and kAcross vectors of columns. Rows past
// `count` are the last one again.
template <class T>
struct Tile {
  static constexpr int width = kAcross * Lane<T>::size;
  Vector<T> sums[kSide][kAcross] = {};

  void add(const T* a, int64_t a_row, int64_t a_column, int count, const T* b, int64_t b_row,
           int64_t depth) {
    constexpr int size = Lane<T>::size;
    const T* rows[kSide];
    for (int r = 0; r < kSide; ++r) rows[r] = a + std::min(r, count - 1) * a_row;
    int64_t at = 0;
    for (int64_t k = 0; k < depth; ++k, at += a_column, b += b_row) {
      Vector<T> row[kAcross];
#pragma GCC unroll 3
      for (int v = 0; v < kAcross; ++v) row[v] = load_one<T>(b + v * size, size);
#pragma GCC unroll 8
      for (int r = 0; r < kSide; ++r) {
        const T value = rows[r][at];
#pragma GCC unroll 3
        for (int v = 0; v < kAcross; ++v) sums[r][v] += value * row[v];
      }
    }
  }

  void store(T* to, int64_t step, int count) const {
    for (int r = 0; r < count; ++r) {
      for (int v = 0; v < kAcross; ++v) {
        store_one<T>(to + r * step + v * Lane<T>::size, Lane<T>::size, sums[r][v]);
      }
    }
  }
};

template <class T>
struct Correlation {
  I2iCorrelation shape;
  const int32_t* moved;  // (length, elements)
  int64_t wide, deep;    // places and features, filled up to whole tiles

  Correlation(const I2iCorrelation& given, const int32_t* moved)
      : shape(given), moved(moved), wide(round_up(given.places, Tile<T>::width)),
        deep(round_up(given.features, Tile<T>::width)) {}

  int64_t of_signal() const { return shape.length * shape.features * shape.outputs; }
  int64_t of_out() const { return shape.elements * shape.outputs; }
  // Rows (place of the signal, output).
  int64_t rows() const { return shape.length * shape.outputs; }

  // Calls act(first, how many) for the outputs, kSide at a time; and for columns, a tile at a time.
  template <class Act>
  static void each(int64_t count, int64_t step, const Act& act) {
    for (int64_t first = 0; first < count; first += step) {
      act(first, static_cast<int>(std::min(step, count - first)));
    }
  }

  // `turned`: the sphere (feature, place); products (output, place) of one place of the signal.
  void forward(const T* signal, const T* turned, Ring<T>& products, Ring<T>& sums, T* out) const {
    std::fill(sums.first(), sums.first() + of_out(), T(0));
    for (int64_t v = 0; v < shape.length; ++v) {
      const T* from = signal + v * shape.features * shape.outputs;
      each(shape.outputs, kSide, [&](int64_t j, int count) {
        each(wide, Tile<T>::width, [&](int64_t u, int) {
          Tile<T> tile;
          tile.add(from + j, 1, shape.outputs, count, turned + u, wide, shape.features);
          tile.store(products.first() + j * wide + u, wide, count);
        });
      });
      const int32_t* at = moved + v * shape.elements;
      for (int64_t j = 0; j < shape.outputs; ++j) {
        const T* product = products.first() + j * wide;
        T* sum = sums.first() + j * shape.elements;
        for (int64_t g = 0; g < shape.elements; ++g) sum[g] += product[at[g]];
      }
    }
    for (int64_t g = 0; g < shape.elements; ++g) {
      for (int64_t j = 0; j < shape.outputs; ++j) {
        out[g * shape.outputs + j] = sums.first()[j * shape.elements + g];
      }
    }
  }

  // The gradient of the products, (row, place).
  void of_products(const T* grad, T* to) const {
    std::fill(to, to + rows() * wide, T(0));
    for (int64_t v = 0; v < shape.length; ++v) {
      for (int64_t g = 0; g < shape.elements; ++g) {
        T* at = to + v * shape.outputs * wide + moved[v * shape.elements + g];
        for (int64_t j = 0; j < shape.outputs; ++j) at[j * wide] += grad[g * shape.outputs + j];
      }
    }
  }

  // `sphere` (place, feature); the gradient of the signal.
  void backward_signal(const T* upstream, const T* sphere, T* of_signal) const {
    for (int64_t v = 0; v < shape.length; ++v) {
      T* to = of_signal + v * shape.features * shape.outputs;
      each(shape.outputs, kSide, [&](int64_t j, int count) {
        each(shape.features, Tile<T>::width, [&](int64_t i, int some) {
          alignas(kLineBytes) T part[kSide * Tile<T>::width];
          Tile<T> tile;
          tile.add(upstream + (v * shape.outputs + j) * wide, wide, 1, count, sphere + i, deep,
                   shape.places);
          tile.store(part, Tile<T>::width, count);
          for (int x = 0; x < some; ++x) {
            T* place = to + (i + x) * shape.outputs + j;
            for (int r = 0; r < count; ++r) place[r] = part[r * Tile<T>::width + x];
          }
        });
      });
    }
  }

  // Adds to the gradient of the sphere (place, feature). `turned`: room for the signal (row, feature).
  void backward_sphere(const T* upstream, const T* signal, T* turned, T* total) const {
    for (int64_t v = 0; v < shape.length; ++v) {
      for (int64_t i = 0; i < shape.features; ++i) {
        const T* from = signal + (v * shape.features + i) * shape.outputs;
        T* to = turned + v * shape.outputs * deep + i;
        for (int64_t j = 0; j < shape.outputs; ++j) to[j * deep] = from[j];
      }
    }
    each(shape.places, kSide, [&](int64_t u, int count) {
      each(deep, Tile<T>::width, [&](int64_t i, int) {
        Tile<T> tile;
        for (int r = 0; r < count; ++r) {
          for (int v = 0; v < kAcross; ++v) {
            tile.sums[r][v] =
                load_one<T>(total + (u + r) * deep + i + v * Lane<T>::size, Lane<T>::size);
          }
        }
        tile.add(upstream + u, 1, wide, count, turned + i, deep, rows());
        tile.store(total + u * deep + i, deep, count);
      });
    });
  }
};

// Spheres (place, feature) with rows of `wide` numbers, as they are or (feature, place).
template <class T>
Ring<T> filled_up(const T* spheres, const I2iCorrelation& shape, int64_t wide, bool turned) {
  const int64_t rows = turned ? shape.features : shape.places;
  Ring<T> result(shape.spheres, rows * wide);
  for (int64_t s = 0; s < shape.spheres; ++s) {
    for (int64_t u = 0; u < shape.places; ++u) {
      const T* from = spheres + (s * shape.places + u) * shape.features;
      for (int64_t i = 0; i < shape.features; ++i) {
        result.row(s)[turned ? i * wide + u : u * wide + i] = from[i];
      }
    }
  }
  return result;
}

template <class T>
void forward(const T* signal, const T* spheres, const int64_t* index, const int32_t* moved, T* out,
             const I2iCorrelation& shape, int threads) {
  const Correlation<T> correlation(shape, moved);
  Ring<T> turned = filled_up(spheres, shape, correlation.wide, true);
#pragma omp parallel num_threads(threads)
  {
    Ring<T> products(1, shape.outputs * correlation.wide), sums(1, correlation.of_out());
#pragma omp for schedule(static)
    for (int64_t b = 0; b < shape.batch; ++b) {
      correlation.forward(signal + b * correlation.of_signal(), turned.row(index ? index[b] : 0),
                          products, sums, out + b * correlation.of_out());
    }
  }
}

// `of_spheres` has to be zero. Either gradient may be null.
template <class T>
void backward(const T* grad, const T* signal, const T* spheres, const int64_t* index,
              const int32_t* moved, T* of_signal, T* of_spheres, const I2iCorrelation& shape,
              int threads) {
  const Correlation<T> correlation(shape, moved);
  const int64_t deep = correlation.deep, of_sphere = shape.places * deep;
  Ring<T> wide = filled_up(spheres, shape, deep, false);
  const int parts = static_cast<int>(std::min<int64_t>(threads, shape.batch));
  std::vector<Ring<T>> totals;
  for (int part = 0; of_spheres && part < parts; ++part) {
    totals.emplace_back(shape.spheres, of_sphere);
  }
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int part = 0; part < parts; ++part) {
    Ring<T> upstream(1, correlation.rows() * correlation.wide);
    Ring<T> turned(1, correlation.rows() * deep);
    const int64_t end = shape.batch * (part + 1) / parts;
    for (int64_t b = shape.batch * part / parts; b < end; ++b) {
      const int64_t which = index ? index[b] : 0, at = b * correlation.of_signal();
      correlation.of_products(grad + b * correlation.of_out(), upstream.first());
      if (of_signal) {
        correlation.backward_signal(upstream.first(), wide.row(which), of_signal + at);
      }
      if (of_spheres) {
        correlation.backward_sphere(upstream.first(), signal + at, turned.first(),
                                    totals[part].row(which));
      }
    }
  }
  if (!of_spheres) return;
  for (int64_t row = 0; row < shape.spheres * shape.places; ++row) {
    for (Ring<T>& total : totals) {
      const T* from = total.first() + row * deep;
      for (int64_t i = 0; i < shape.features; ++i) of_spheres[row * shape.features + i] += from[i];
    }
  }
}

}  // namespace

extern "C" {

void i2i_correlate(const void* signal, const void* spheres, const int64_t* index,
                   const int32_t* moved, void* out, const I2iCorrelation* shape, int is_double,
                   int threads) {
  if (is_double) {
    forward(as<double>(signal), as<double>(spheres), index, moved, as<double>(out), *shape,
            threads);
  } else {
    forward(as<float>(signal), as<float>(spheres), index, moved, as<float>(out), *shape, threads);
  }
}

void i2i_correlate_backward(const void* grad, const void* signal, const void* spheres,
                            const int64_t* index, const int32_t* moved, void* of_signal,
                            void* of_spheres, const I2iCorrelation* shape, int is_double,
                            int threads) {
  if (is_double) {
    backward(as<double>(grad), as<double>(signal), as<double>(spheres), index, moved,
             as<double>(of_signal), as<double>(of_spheres), *shape, threads);
  } else {
    backward(as<float>(grad), as<float>(signal), as<float>(spheres), index, moved,
             as<float>(of_signal), as<float>(of_spheres), *shape, threads);
  }
}
}
