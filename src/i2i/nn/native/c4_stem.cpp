// The first convolution with its batch norm folded in, max-pool and ReLU, and the gradient of its
// kernel, without the map between them: a few rows of it are in the cache at a time.
//
// A patch is what the kernel sees of the image at one place, and a 1 after it:
//
//   y[c] = sum_k weight[k][c] patch[k],    k = 0 .. K, the last weight being the bias,
//   out[c] = max(0, max of y[c] over a window),
//   gradient[c][k] = sum over windows of upstream[c] patch[k] at the place of the maximum.
//
// So the gradient takes one product for each window, not one for each place.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "patches.h"

namespace {

using namespace i2i;

constexpr int kTogether = 4;       // rows of moments, or channels' gradients, side by side
constexpr uint8_t kClipped = 255;  // instead of the place of the maximum

// What a window sees along one side of the map; `start` counts what lies outside as well.
struct Span {
  int64_t start, first, end;
};

Span span(int64_t index, const I2iStem& shape, int64_t side) {
  const int64_t start = index * shape.window_stride - shape.window_padding;
  return {start, std::max<int64_t>(start, 0), std::min(start + shape.window, side)};
}

// ---- forward ----

// The kernel (channel, K + 1) turned over, its channels filled up with zeros to whole tiles.
template <class T>
Ring<T> turned_over(const T* weight, int64_t count, int64_t channels, int64_t padded) {
  Ring<T> result(count + 1, padded);
  for (int64_t c = 0; c < channels; ++c) {
    for (int64_t k = 0; k <= count; ++k) result.row(k)[c] = weight[c * (count + 1) + k];
  }
  return result;
}

// One row of the map (place, channel) from one row of patches.
template <class T>
void product_row(const Patches<T>& patches, const T* from, const T* weight, int64_t channels,
                 T* to) {
  constexpr int size = Lane<T>::size;
  for (int64_t x = 0; x < patches.places; x += kPlaces) {
    for (int64_t c = 0; c < channels; c += kVectors * size) {
      Vector<T> sums[kPlaces][kVectors] = {};
      for (int64_t k = 0; k <= patches.count; ++k) {
        Vector<T> row[kVectors];
#pragma GCC unroll 2
        for (int v = 0; v < kVectors; ++v) {
          row[v] = load_one<T>(weight + k * channels + c + v * size, size);
        }
#pragma GCC unroll 8
        for (int p = 0; p < kPlaces; ++p) {
          const T value = from[(x + p) * patches.depth + k];
#pragma GCC unroll 2
          for (int v = 0; v < kVectors; ++v) sums[p][v] += value * row[v];
        }
      }
#pragma GCC unroll 8
      for (int p = 0; p < kPlaces; ++p) {
#pragma GCC unroll 2
        for (int v = 0; v < kVectors; ++v) {
          store_one<T>(to + (x + p) * channels + c + v * size, size, sums[p][v]);
        }
      }
    }
  }
}

// One window of `count` channels: the first of the largest, as torch takes it.
template <class T>
void pool(Ring<T>& maps, const Span& rows, const Span& columns, int64_t window, int64_t channels,
          int64_t c, int count, T* out, uint8_t* where) {
  typedef std::conditional_t<sizeof(T) == 4, int32_t, int64_t> Index;
  typedef Index Indices __attribute__((vector_size(kLineBytes)));
  const auto place_of = [&](int64_t y, int64_t x) {
    return static_cast<Index>((y - rows.start) * window + x - columns.start);
  };
  Vector<T> best = Vector<T>{} - std::numeric_limits<T>::infinity();
  Indices place = Indices{} + place_of(rows.first, columns.first);
  for (int64_t y = rows.first; y < rows.end; ++y) {
    const T* row = maps.row(y) + c;
    for (int64_t x = columns.first; x < columns.end; ++x) {
      const auto value = load_one<T>(row + x * channels, Lane<T>::size);
      const Indices better = (value > best) | (value != value);
      best = better ? value : best;
      place = better ? Indices{} + place_of(y, x) : place;
    }
  }
  store_one<T>(out, count, best < 0 ? Vector<T>{} : best);  // keeps what is not a number
  if (!where) return;
  typedef uint8_t Bytes __attribute__((vector_size(Lane<T>::size)));
  place = best > 0 ? place : Indices{} + kClipped;
  const Bytes bytes = __builtin_convertvector(place, Bytes);
  std::memcpy(where, &bytes, count);
}

// A row that was made in the cache, past the caches where it is whole lines.
template <class T>
void stream(T* to, const T* from, int64_t count) {
  if (!is_line_start(to) || count * sizeof(T) % kLineBytes) {
    std::copy(from, from + count, to);
    return;
  }
  for (int64_t i = 0; i < count; i += kLineBytes / sizeof(T)) stream_line(to + i, from + i);
}

template <class T>
void forward(const T* images, const T* weight, T* out, uint8_t* where, const I2iStem& shape,
             int threads) {
  constexpr int size = Lane<T>::size;
  const int64_t channels = round_up(shape.channels, kVectors * size);
  const int64_t row = shape.out_width * shape.channels;
  Ring<T> kernel = turned_over(weight, Patches<T>::count_of(shape), shape.channels, channels);
  // Several bands of rows where there are fewer images than threads.
  const int64_t bands = shape.batch >= threads ? 1 : threads;
#pragma omp parallel num_threads(threads)
  {
    Patches<T> patches(shape);
    Ring<T> seen(1, patches.row_size), maps(shape.window, patches.places * channels);
    Ring<T> pooled(1, row);
    Ring<uint8_t> places(1, row);
#pragma omp for schedule(static)
    for (int64_t task = 0; task < shape.batch * bands; ++task) {
      const int64_t image = task / bands, band = task % bands;
      const int64_t end = shape.out_height * (band + 1) / bands;
      int64_t made = 0;
      for (int64_t oy = shape.out_height * band / bands; oy < end; ++oy) {
        const Span rows = span(oy, shape, shape.height);
        for (made = std::max(made, rows.first); made < rows.end; ++made) {
          patches.fill(image_at(images, image, shape), made, seen.first());
          product_row(patches, seen.first(), kernel.first(), channels, maps.row(made));
        }
        for (int64_t ox = 0; ox < shape.out_width; ++ox) {
          const Span columns = span(ox, shape, shape.width);
          for (int64_t c = 0; c < shape.channels; c += size) {
            const int count = static_cast<int>(std::min<int64_t>(shape.channels - c, size));
            const int64_t at = ox * shape.channels + c;
            pool(maps, rows, columns, shape.window, channels, c, count, pooled.first() + at,
                 where ? places.first() + at : nullptr);
          }
        }
        const int64_t at = (image * shape.out_height + oy) * row;
        stream(out + at, pooled.first(), row);
        if (where) stream(where + at, places.first(), row);
      }
      finish_streams();
    }
  }
}

// ---- backward ----

// Adds to total (channel, depth), of some channels, what one row of windows gives to one or two
// vectors of the kernel's gradient. `starts`: from a place to its patch in the row's first window.
template <class T, int kSide, int kUsed>
inline void add_windows(const T* grad, const uint8_t* where, const T* patches,
                        const int64_t* starts, int64_t depth, const I2iStem& shape, T* total) {
  constexpr int size = Lane<T>::size;
  const int64_t step = shape.window_stride * depth;
  Vector<T> sums[kSide][kUsed] = {};
  for (int64_t x = 0; x < shape.out_width; ++x) {
#pragma GCC unroll 4
    for (int i = 0; i < kSide; ++i) {
      const uint8_t place = where[x * shape.channels + i];
      const T value = place == kClipped ? T(0) : grad[x * shape.channels + i];
      const T* patch = patches + starts[place] + x * step;
#pragma GCC unroll 2
      for (int v = 0; v < kUsed; ++v) sums[i][v] += value * load_one<T>(patch + v * size, size);
    }
  }
  for (int i = 0; i < kSide; ++i) {
    for (int v = 0; v < kUsed; ++v) {
      T* at = total + i * depth + v * size;
      store_one<T>(at, size, load_one<T>(at, size) + sums[i][v]);
    }
  }
}

template <class T>
void add_row(const T* grad, const uint8_t* where, const T* patches, const int64_t* starts,
             int64_t depth, const I2iStem& shape, T* total) {
  constexpr int step = kVectors * Lane<T>::size;
  for (int64_t v = 0; v < depth; v += step) {
    int64_t c = 0;
    for (; c + kTogether <= shape.channels; c += kTogether) {
      add_windows<T, kTogether, kVectors>(grad + c, where + c, patches + v, starts, depth, shape,
                                          total + c * depth + v);
    }
    for (; c < shape.channels; ++c) {
      add_windows<T, 1, kVectors>(grad + c, where + c, patches + v, starts, depth, shape,
                                  total + c * depth + v);
    }
  }
}

template <class T>
void add_image(const T* image, const T* grad, const uint8_t* where, const I2iStem& shape,
               Patches<T>& patches, Ring<T>& seen, T* total) {
  int64_t starts[kClipped + 1] = {};  // what was clipped: any patch, times zero
  int64_t made = 0;
  for (int64_t oy = 0; oy < shape.out_height; ++oy) {
    const Span rows = span(oy, shape, shape.height);
    for (made = std::max(made, rows.first); made < rows.end; ++made) {
      patches.fill(image, made, seen.row(made));
    }
    for (int64_t y = rows.first; y < rows.end; ++y) {
      for (int64_t x = 0; x < shape.window; ++x) {
        starts[(y - rows.start) * shape.window + x] =
            seen.offset(y) + (x - shape.window_padding) * patches.depth;
      }
    }
    const int64_t at = oy * shape.out_width * shape.channels;
    add_row(grad + at, where + at, seen.first(), starts, patches.depth, shape, total);
  }
}

// `result` (channel, K + 1). Sums of one image in T, of the images in double precision.
template <class T>
void backward(const T* images, const T* grad, const uint8_t* where, double* result,
              const I2iStem& shape, int threads) {
  const int64_t depth = Patches<T>::depth_of(shape), count = Patches<T>::count_of(shape);
  const int64_t entries = shape.channels * depth;
  const int64_t windows = shape.out_height * shape.out_width * shape.channels;
  std::vector<double> totals(threads * entries);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int part = 0; part < threads; ++part) {
    Patches<T> patches(shape);
    Ring<T> seen(shape.window, patches.row_size);
    std::vector<T> of_image(entries);
    double* total = totals.data() + part * entries;
    const int64_t end = shape.batch * (part + 1) / threads;
    for (int64_t image = shape.batch * part / threads; image < end; ++image) {
      std::fill(of_image.begin(), of_image.end(), T(0));
      add_image(image_at(images, image, shape), grad + image * windows, where + image * windows,
                shape, patches, seen, of_image.data());
      for (int64_t i = 0; i < entries; ++i) total[i] += of_image[i];
    }
  }
  for (int64_t c = 0; c < shape.channels; ++c) {
    for (int64_t k = 0; k <= count; ++k) {
      double sum = 0;
      for (int part = 0; part < threads; ++part) sum += totals[part * entries + c * depth + k];
      result[c * (count + 1) + k] = sum;
    }
  }
}

// ---- moments ----

// Adds the products of all pairs of a row's patches, the lower triangle of (depth, depth) at least.
void add_products(const double* row, int64_t places, int64_t rows, int64_t depth, double* total) {
  constexpr int size = Lane<double>::size, step = kVectors * size;
  for (int64_t i = 0; i < rows; i += kTogether) {
    for (int64_t j = 0; j < i + kTogether; j += step) {
      Vector<double> sums[kTogether][kVectors] = {};
      for (int64_t x = 0; x < places; ++x) {
        const double* patch = row + x * depth;
#pragma GCC unroll 2
        for (int v = 0; v < kVectors; ++v) {
          const auto right = load_one<double>(patch + j + v * size, size);
#pragma GCC unroll 4
          for (int r = 0; r < kTogether; ++r) sums[r][v] += patch[i + r] * right;
        }
      }
      for (int r = 0; r < kTogether; ++r) {
        for (int v = 0; v < kVectors; ++v) {
          double* at = total + (i + r) * depth + j + v * size;
          store_one<double>(at, size, load_one<double>(at, size) + sums[r][v]);
        }
      }
    }
  }
}

// `result` (K + 1, K + 1): sum over images and places of patch[i] patch[j].
template <class T>
void moments(const T* images, double* result, const I2iStem& shape, int threads) {
  const int64_t depth = Patches<T>::depth_of(shape), count = Patches<T>::count_of(shape);
  const int64_t rows = round_up(count + 1, kTogether);
  std::vector<double> totals(threads * depth * depth);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
  for (int part = 0; part < threads; ++part) {
    Patches<T> patches(shape);
    Ring<T> seen(1, patches.row_size);
    Ring<double> wide(1, patches.row_size);
    const int64_t end = shape.batch * (part + 1) / threads;
    for (int64_t image = shape.batch * part / threads; image < end; ++image) {
      for (int64_t y = 0; y < shape.height; ++y) {
        patches.fill(image_at(images, image, shape), y, seen.first());
        std::copy(seen.first(), seen.first() + shape.width * depth, wide.first());
        add_products(wide.first(), shape.width, rows, depth,
                     totals.data() + part * depth * depth);
      }
    }
  }
  for (int64_t i = 0; i <= count; ++i) {
    for (int64_t j = 0; j <= i; ++j) {
      double sum = 0;
      for (int part = 0; part < threads; ++part) sum += totals[(part * depth + i) * depth + j];
      result[i * (count + 1) + j] = result[j * (count + 1) + i] = sum;
    }
  }
}

}  // namespace

extern "C" {

// `weight` (channels, K + 1); `out` and `where` (batch, out_height, out_width, channels).
void i2i_stem(const void* images, const void* weight, void* out, uint8_t* where,
              const I2iStem* shape, int is_double, int threads) {
  if (is_double) {
    forward(as<double>(images), as<double>(weight), as<double>(out), where, *shape,
            threads);
  } else {
    forward(as<float>(images), as<float>(weight), as<float>(out), where, *shape, threads);
  }
}

void i2i_stem_backward(const void* images, const void* grad, const uint8_t* where, double* result,
                       const I2iStem* shape, int is_double, int threads) {
  if (is_double) {
    backward(as<double>(images), as<double>(grad), where, result, *shape, threads);
  } else {
    backward(as<float>(images), as<float>(grad), where, result, *shape, threads);
  }
}

void i2i_stem_moments(const void* images, double* result, const I2iStem* shape, int is_double,
                      int threads) {
  if (is_double) {
    moments(as<double>(images), result, *shape, threads);
  } else {
    moments(as<float>(images), result, *shape, threads);
  }
}
}
