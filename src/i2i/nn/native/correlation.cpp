// The correlation of signals on half a sphere with features that the group's elements move, and its
// gradients, an image at a time: what lies between the products stays in the cache.
//
//   product[v][u][j] = sum_i signal[v][i][j] sphere[u][i]
//   out[g][j]        = sum_v product[v][moved[g][v]][j]
//
// v: place of the signal, u: place of the sphere, i: feature, j: output, g: element of the group.
// A place of the signal meets only places that the group moves to each other: of the 42 vertices of
// a mesh the 12 corners or the 30 middles of edges. Products with others are not made.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "patches.h"
#include "turning.h"

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
constexpr int kSide = 8, kAcross = 3;
#else
constexpr int kSide = 4, kAcross = 1;
#endif

// sums over k of a[row][k] b[k][column], for kSide rows and a few vectors of columns. Rows past
// `count` are the last one again.
template <class T, int kVectors>
struct Tile {
  static constexpr int size = Lane<T>::size;
  Vector<T> sums[kSide][kVectors] = {};

  inline void add(const T* a, int64_t a_row, int64_t a_column, int count, const T* b,
                  int64_t b_row, int64_t depth) {
    const T* rows[kSide];
#pragma GCC unroll 8
    for (int r = 0; r < kSide; ++r) rows[r] = a + std::min(r, count - 1) * a_row;
    int64_t at = 0;
    for (int64_t k = 0; k < depth; ++k, at += a_column, b += b_row) {
      Vector<T> row[kVectors];
#pragma GCC unroll 3
      for (int v = 0; v < kVectors; ++v) row[v] = load_one<T>(b + v * size, size);
#pragma GCC unroll 8
      for (int r = 0; r < kSide; ++r) {
        const T value = rows[r][at];
#pragma GCC unroll 3
        for (int v = 0; v < kVectors; ++v) sums[r][v] += value * row[v];
      }
    }
  }

  // Column by column, `step` apart, `count` numbers of each, up to the `end`th. More are written,
  // which the next columns write over, but not past the last one's.
  void store_turned(T* to, int64_t step, int64_t end, int count) {
#pragma GCC unroll 3
    for (int v = 0; v < kVectors; ++v) {
      Vector<T> lines[kSide];
#pragma GCC unroll 8
      for (int r = 0; r < kSide; ++r) lines[r] = sums[r][v];
      turn<T, kSide>(lines);
      const T* from = reinterpret_cast<const T*>(lines);
      const int64_t columns = std::min<int64_t>(size, end - v * size);
      for (int64_t c = 0; c < columns; ++c, from += kSide, to += step) {
        if ((end - 1 - v * size - c) * step + count >= kSide) {
          std::memcpy(to, from, kSide * sizeof(T));
        } else {
          std::copy(from, from + count, to);
        }
      }
    }
  }
};

// Calls act(first, tile) for all columns, a tile of empty sums at a time.
template <class T, class Act>
void each_tile(int64_t columns, const Act& act) {
  constexpr int size = Lane<T>::size;
  for (int64_t first = 0; first < columns;) {
    const int64_t left = (columns - first + size - 1) / size;
    if (kAcross > 2 && left > 2) {
      act(first, Tile<T, kAcross>()), first += kAcross * size;
    } else if (kAcross > 1 && left > 1) {
      act(first, Tile<T, (kAcross > 1 ? 2 : 1)>()), first += 2 * size;
    } else {
      act(first, Tile<T, 1>()), first += size;
    }
  }
}

// Calls act(first, how many) for the rows, kSide at a time. The last ones first: if they are fewer,
// what `store_turned` writes too much belongs to the first ones.
template <class Act>
void each_rows(int64_t rows, const Act& act) {
  for (int64_t first = (rows - 1) / kSide * kSide; first >= 0; first -= kSide) {
    act(first, static_cast<int>(std::min<int64_t>(kSide, rows - first)));
  }
}

// to[j] += from[j], a multiple of kSide of them.
template <class T>
inline void add_row(const T* from, T* to, int64_t count) {
  typedef T Row __attribute__((vector_size(kSide * sizeof(T))));
  for (int64_t j = 0; j < count; j += kSide) {
    Row sum, more;
    std::memcpy(&sum, to + j, sizeof(sum)), std::memcpy(&more, from + j, sizeof(more));
    sum += more;
    std::memcpy(to + j, &sum, sizeof(sum));
  }
}

// Places of the signal that meet the same places of the sphere, first to end.
struct Meeting {
  int64_t first, end;
  std::vector<int64_t> signal;
  int64_t places() const { return end - first; }
};

std::vector<Meeting> meetings_of(const int32_t* moved, const I2iCorrelation& shape) {
  std::vector<Meeting> all;
  for (int64_t v = 0; v < shape.length; ++v) {
    const int32_t* at = moved + v * shape.elements;
    const auto [least, most] = std::minmax_element(at, at + shape.elements);
    const int64_t first = *least, end = *most + 1;
    const auto known = std::find_if(all.begin(), all.end(), [&](const Meeting& meeting) {
      return meeting.first == first && meeting.end == end;
    });
    (known == all.end() ? all.insert(known, {first, end, {}}) : known)->signal.push_back(v);
  }
  return all;
}

template <class T>
struct Correlation {
  static constexpr int size = Lane<T>::size;
  I2iCorrelation shape;
  const int32_t* moved;  // (length, elements)
  std::vector<Meeting> meetings;
  int64_t wide, deep, outputs;  // places, features and outputs, filled up

  Correlation(const I2iCorrelation& given, const int32_t* moved)
      : shape(given), moved(moved), meetings(meetings_of(moved, given)),
        wide(round_up(given.places, size)), deep(round_up(given.features, size)),
        outputs(round_up(given.outputs, kSide)) {}

  int64_t of_signal() const { return shape.length * shape.features * shape.outputs; }
  int64_t of_out() const { return shape.elements * shape.outputs; }
  int64_t at(int64_t v) const { return v * shape.features * shape.outputs; }
  // Of the gradient of a sphere: the places of each meeting, filled up.
  int64_t of_total() const {
    int64_t sum = 0;
    for (const Meeting& meeting : meetings) sum += round_up(meeting.places(), size);
    return shape.features * sum;
  }

  // `turned`: the sphere (feature, place). `products`: of one place of the signal.
  void forward(const T* signal, const T* turned, T* products, T* sums, T* out) const {
    std::fill(sums, sums + shape.elements * outputs, T(0));
    for (const Meeting& meeting : meetings) {
      for (int64_t v : meeting.signal) {
        each_rows(shape.outputs, [&](int64_t j, int count) {
          each_tile<T>(meeting.places(), [&](int64_t u, auto tile) {
            tile.add(signal + at(v) + j, 1, shape.outputs, count, turned + meeting.first + u, wide,
                     shape.features);
            tile.store_turned(products + u * outputs + j, outputs, meeting.places() - u, kSide);
          });
        });
        for (int64_t g = 0; g < shape.elements; ++g) {
          const int64_t u = moved[v * shape.elements + g] - meeting.first;
          add_row(products + u * outputs, sums + g * outputs, outputs);
        }
      }
    }
    for (int64_t g = 0; g < shape.elements; ++g) {
      std::copy(sums + g * outputs, sums + g * outputs + shape.outputs, out + g * shape.outputs);
    }
  }

  // The gradient of the products of one place of the signal, (place, output); `grad` filled up.
  void of_products(const T* grad, int64_t v, const Meeting& meeting, T* to) const {
    std::fill(to, to + meeting.places() * outputs, T(0));
    for (int64_t g = 0; g < shape.elements; ++g) {
      const int64_t u = moved[v * shape.elements + g] - meeting.first;
      add_row(grad + g * outputs, to + u * outputs, outputs);
    }
  }

  // The gradient of one place of the signal; `sphere` (place, feature).
  void of_place(const T* upstream, const T* sphere, const Meeting& meeting, T* to) const {
    each_rows(shape.outputs, [&](int64_t j, int count) {
      each_tile<T>(shape.features, [&](int64_t i, auto tile) {
        tile.add(upstream + j, 1, outputs, count, sphere + meeting.first * deep + i, deep,
                 meeting.places());
        tile.store_turned(to + i * shape.outputs + j, shape.outputs, shape.features - i, count);
      });
    });
  }

  // Adds to the gradient of the sphere at a meeting's places, (feature, place filled up).
  // `upstream`: (place of the signal, output, place filled up).
  void of_sphere(const T* upstream, const T* signal, const Meeting& meeting, T* total) const {
    const int64_t width = round_up(meeting.places(), size);
    each_rows(shape.features, [&](int64_t i, int count) {
      each_tile<T>(meeting.places(), [&](int64_t u, auto tile) {
        const T* from = upstream + u;
        for (int64_t v : meeting.signal) {
          tile.add(signal + at(v) + i * shape.outputs, shape.outputs, 1, count, from, width,
                   shape.outputs);
          from += shape.outputs * width;
        }
        for (int r = 0; r < count; ++r) {
          T* to = total + (i + r) * width + u;
          for (const auto& sums : tile.sums[r]) {
            store_one<T>(to, size, load_one<T>(to, size) + sums), to += size;
          }
        }
      });
    });
  }

  // Adds what a total holds to the gradient (place, feature).
  void add_total(const T* total, T* of_spheres) const {
    for (const Meeting& meeting : meetings) {
      const int64_t width = round_up(meeting.places(), size);
      for (int64_t i = 0; i < shape.features; ++i, total += width) {
        for (int64_t u = 0; u < meeting.places(); ++u) {
          of_spheres[(meeting.first + u) * shape.features + i] += total[u];
        }
      }
    }
  }
};

// Of one thread, and what it does with an image. The gradients may be null.
template <class T>
struct Gradients {
  const Correlation<T>& correlation;
  const I2iCorrelation& shape = correlation.shape;
  Ring<T> grad{1, shape.elements * correlation.outputs};
  Ring<T> upstream{1, correlation.wide * correlation.outputs};
  Ring<T> across{1, shape.length * shape.outputs * correlation.wide};

  void add(const T* of_out, const T* signal, const T* sphere, T* of_signal, T* total) {
    for (int64_t g = 0; g < shape.elements; ++g) {
      const T* from = of_out + g * shape.outputs;
      std::copy(from, from + shape.outputs, grad.first() + g * correlation.outputs);
    }
    for (const Meeting& meeting : correlation.meetings) {
      const int64_t width = round_up(meeting.places(), Lane<T>::size);
      T* row = across.first();
      for (int64_t v : meeting.signal) {
        const T* from = upstream.first();
        correlation.of_products(grad.first(), v, meeting, upstream.first());
        if (of_signal) {
          correlation.of_place(from, sphere, meeting, of_signal + correlation.at(v));
        }
        for (int64_t j = 0; total && j < shape.outputs; ++j, row += width) {
          for (int64_t u = 0; u < meeting.places(); ++u) row[u] = from[u * correlation.outputs + j];
        }
      }
      if (!total) continue;
      correlation.of_sphere(across.first(), signal, meeting, total);
      total += shape.features * width;
    }
  }
};

// Spheres (place, feature) with rows of `wide` numbers, as they are or (feature, place), and behind
// them a vector: the places of a meeting need not begin with one.
template <class T>
Ring<T> filled_up(const T* spheres, const I2iCorrelation& shape, int64_t wide, bool turned) {
  const int64_t rows = turned ? shape.features : shape.places;
  Ring<T> result(shape.spheres, rows * wide + Lane<T>::size);
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
    Ring<T> products(1, correlation.wide * correlation.outputs);
    Ring<T> sums(1, shape.elements * correlation.outputs);
#pragma omp for schedule(static)
    for (int64_t b = 0; b < shape.batch; ++b) {
      correlation.forward(signal + b * correlation.of_signal(), turned.row(index ? index[b] : 0),
                          products.first(), sums.first(), out + b * correlation.of_out());
    }
  }
}

// `of_spheres` has to be zero. Either gradient may be null.
template <class T>
void backward(const T* grad, const T* signal, const T* spheres, const int64_t* index,
              const int32_t* moved, T* of_signal, T* of_spheres, const I2iCorrelation& shape,
              int threads) {
  const Correlation<T> correlation(shape, moved);
  Ring<T> rows = filled_up(spheres, shape, correlation.deep, false);
  const int parts = static_cast<int>(std::min<int64_t>(threads, shape.batch));
  std::vector<Ring<T>> totals;
  for (int part = 0; of_spheres && part < parts; ++part) {
    totals.emplace_back(shape.spheres, correlation.of_total());
  }
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int part = 0; part < parts; ++part) {
    Gradients<T> gradients{correlation};
    const int64_t end = shape.batch * (part + 1) / parts;
    for (int64_t b = shape.batch * part / parts; b < end; ++b) {
      const int64_t which = index ? index[b] : 0, at = b * correlation.of_signal();
      gradients.add(grad + b * correlation.of_out(), signal + at, rows.row(which),
                    of_signal ? of_signal + at : nullptr,
                    of_spheres ? totals[part].row(which) : nullptr);
    }
  }
#pragma omp parallel for num_threads(threads)
  for (int64_t s = 0; s < (of_spheres ? shape.spheres : 0); ++s) {
    T* to = of_spheres + s * shape.places * shape.features;
    for (Ring<T>& total : totals) correlation.add_total(total.row(s), to);
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
