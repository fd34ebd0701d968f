// Batch norm of pixel-major maps, the sum with a shortcut and the clipping after it, and their
// gradients: the rows of one field are read once from memory, and again from the cache.
//
//   y = relu(scale (x - mean) + bias + shortcut),  scale = weight / sqrt(var + eps)
//
// Moments are summed in double precision, row by row.

#include <cmath>
#include <cstdint>

#include "lanes.h"

namespace {

using namespace i2i;

// Maps (rows, fields, batch): where the images of a row and field begin.
struct Rows {
  int64_t rows, fields, batch;
  int64_t at(int64_t row, int64_t field) const { return (row * fields + field) * batch; }
  int left(int64_t image, int size) const {
    return batch - image < size ? static_cast<int>(batch - image) : size;
  }
  double count() const { return static_cast<double>(rows) * batch; }
};

// As many numbers in double precision.
template <class T>
struct Widened;
template <>
struct Widened<float> {
  typedef double Vec __attribute__((vector_size(2 * kLineBytes)));
};
template <>
struct Widened<double> {
  typedef double Vec __attribute__((vector_size(kLineBytes)));
};

// Sums over rows and images of two functions of where a vector begins and how much of it counts;
// what they add past the end has to be zero.
template <class T, class Terms>
inline void add_up(const Rows& shape, int64_t field, const Terms& terms, double (&sums)[2]) {
  constexpr int size = Lane<T>::size;
  typedef typename Widened<T>::Vec Wide;
  Wide totals[2] = {};
  for (int64_t row = 0; row < shape.rows; ++row) {
    typename Lane<T>::Vec first = {}, second = {};
    const int64_t at = shape.at(row, field);
    for (int64_t image = 0; image < shape.batch; image += size) {
      terms(at + image, shape.left(image, size), first, second);
    }
    totals[0] += __builtin_convertvector(first, Wide);
    totals[1] += __builtin_convertvector(second, Wide);
  }
  for (int part = 0; part < 2; ++part) {
    sums[part] = 0;
    for (int i = 0; i < size; ++i) sums[part] += totals[part][i];
  }
}

template <class T>
inline typename Lane<T>::Vec keep(typename Lane<T>::Vec v, int count) {
  for (int i = count; i < Lane<T>::size; ++i) v[i] = 0;
  return v;
}

template <class T>
void forward(const T* x, const T* shortcut, const T* weight, const T* bias, double* mean,
             double* variance, T* y, double epsilon, bool relu, bool of_batch, const Rows& shape,
             int threads) {
  typedef typename Lane<T>::Vec Vec;
  constexpr int size = Lane<T>::size;
  const bool in_lines = shape.batch % size == 0 && is_line_start(y);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t field = 0; field < shape.fields; ++field) {
    if (of_batch) {
      double sums[2];
      add_up<T>(shape, field, [&](int64_t at, int count, Vec& first, Vec&) {
        first += load_one<T>(x + at, count);
      }, sums);
      mean[field] = sums[0] / shape.count();
      const T middle = static_cast<T>(mean[field]);
      add_up<T>(shape, field, [&](int64_t at, int count, Vec& first, Vec& second) {
        Vec centred = load_one<T>(x + at, count) - middle;
        if (count < size) centred = keep<T>(centred, count);
        first += centred;  // what rounding the mean has left
        second += centred * centred;
      }, sums);
      const double rest = sums[0] / shape.count();
      variance[field] = sums[1] / shape.count() - rest * rest;
    }
    const double factor = weight[field] / std::sqrt(variance[field] + epsilon);
    const T scale = static_cast<T>(factor), middle = static_cast<T>(mean[field]);
    const T shift = static_cast<T>(bias[field] + (middle - mean[field]) * factor);
    for (int64_t row = 0; row < shape.rows; ++row) {
      const int64_t start = shape.at(row, field);
      for (int64_t image = 0; image < shape.batch; image += size) {
        const int64_t at = start + image;
        const int count = shape.left(image, size);
        Vec value = scale * (load_one<T>(x + at, count) - middle) + shift;
        if (shortcut) value += load_one<T>(shortcut + at, count);
        if (relu) value = value < 0 ? Vec{} : value;  // keeps what is not a number
        store_one<T>(y + at, count, value, in_lines);
      }
    }
    finish_streams();
  }
}

template <class T>
void backward(const T* grad, const T* y, const T* x, const T* weight, const double* mean,
              const double* variance, T* of_x, T* of_shortcut, double* of_weight, double* of_bias,
              double epsilon, const Rows& shape, int threads) {
  typedef typename Lane<T>::Vec Vec;
  constexpr int size = Lane<T>::size;
  const bool in_lines = shape.batch % size == 0 && is_line_start(of_x) &&
                        (!of_shortcut || is_line_start(of_shortcut));
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t field = 0; field < shape.fields; ++field) {
    const auto upstream = [&](int64_t at, int count) {
      const Vec g = load_one<T>(grad + at, count);
      return y ? (load_one<T>(y + at, count) <= 0 ? Vec{} : g) : g;  // past the end both are zero
    };
    const double inverse = 1 / std::sqrt(variance[field] + epsilon);
    const T middle = static_cast<T>(mean[field]);
    double sums[2];
    add_up<T>(shape, field, [&](int64_t at, int count, Vec& first, Vec& second) {
      const Vec g = upstream(at, count);
      first += g;
      second += g * (load_one<T>(x + at, count) - middle);  // past the end g is zero
    }, sums);
    of_bias[field] = sums[0];
    of_weight[field] = sums[1] * inverse;
    const double factor = weight[field] * inverse;
    const T scale = static_cast<T>(factor);
    const T slope = static_cast<T>(-factor * inverse * inverse * sums[1] / shape.count());
    const T shift = static_cast<T>(-factor * sums[0] / shape.count());
    for (int64_t row = 0; row < shape.rows; ++row) {
      const int64_t start = shape.at(row, field);
      for (int64_t image = 0; image < shape.batch; image += size) {
        const int64_t at = start + image;
        const int count = shape.left(image, size);
        const Vec g = upstream(at, count);
        const Vec centred = load_one<T>(x + at, count) - middle;
        store_one<T>(of_x + at, count, scale * g + slope * centred + shift, in_lines);
        if (of_shortcut) store_one<T>(of_shortcut + at, count, g, in_lines);
      }
    }
    finish_streams();
  }
}

template <class T>
const T* as(const void* pointer) {
  return static_cast<const T*>(pointer);
}

}  // namespace

extern "C" {

void i2i_norm(const void* x, const void* shortcut, const void* weight, const void* bias,
              double* mean, double* variance, void* y, double epsilon, int relu, int of_batch,
              int is_double, int64_t rows, int64_t fields, int64_t batch, int threads) {
  const Rows shape{rows, fields, batch};
  if (is_double) {
    forward(as<double>(x), as<double>(shortcut), as<double>(weight), as<double>(bias), mean,
            variance, static_cast<double*>(y), epsilon, relu != 0, of_batch != 0, shape, threads);
  } else {
    forward(as<float>(x), as<float>(shortcut), as<float>(weight), as<float>(bias), mean, variance,
            static_cast<float*>(y), epsilon, relu != 0, of_batch != 0, shape, threads);
  }
}

void i2i_norm_backward(const void* grad, const void* y, const void* x, const void* weight,
                       const double* mean, const double* variance, void* of_x, void* of_shortcut,
                       double* of_weight, double* of_bias, double epsilon, int is_double,
                       int64_t rows, int64_t fields, int64_t batch, int threads) {
  const Rows shape{rows, fields, batch};
  if (is_double) {
    backward(as<double>(grad), as<double>(y), as<double>(x), as<double>(weight), mean, variance,
             static_cast<double*>(of_x), static_cast<double*>(of_shortcut), of_weight, of_bias,
             epsilon, shape, threads);
  } else {
    backward(as<float>(grad), as<float>(y), as<float>(x), as<float>(weight), mean, variance,
             static_cast<float*>(of_x), static_cast<float*>(of_shortcut), of_weight, of_bias,
             epsilon, shape, threads);
  }
}
}
