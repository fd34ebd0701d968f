// Batch norm of pixel-major maps, the sum with a shortcut and the clipping after it, and their
// gradients. The rows of one field are read once and kept side by side: where they are, they lie
// multiples of 4 KiB apart with 64 images, and would drive each other out of the caches.
//
//   y = relu(scale (x - mean) + bias + shortcut),  scale = weight / sqrt(var + eps)
//
// Moments are summed in double precision.

#include <cmath>
#include <cstdint>
#include <vector>

#include "lanes.h"

namespace {

using namespace i2i;

constexpr int kTogether = 4;  // fields whose rows are read side by side

// Maps (rows, fields, batch), seen by a few fields at a time.
struct Rows {
  int64_t rows, fields, batch;
  double count() const { return static_cast<double>(rows) * batch; }
  int together(int64_t field) const {
    return fields - field < kTogether ? static_cast<int>(fields - field) : kTogether;
  }

  // Calls act(field - first, where a vector begins, its number, how much of it counts).
  template <class T, class Act>
  inline void each_vector(int64_t first, const Act& act) const {
    constexpr int size = Lane<T>::size;
    const int some = together(first);
    int64_t number = 0;
    for (int64_t row = 0; row < rows; ++row) {
      for (int f = 0; f < some; ++f) {
        const int64_t start = (row * fields + first + f) * batch;
        for (int64_t image = 0; image < batch; image += size) {
          const int64_t left = batch - image;
          act(f, start + image, number++, left < size ? static_cast<int>(left) : size);
        }
      }
    }
  }

  // Numbers that the vectors of a few fields hold, with what fills up the last of each row.
  int64_t kept(int size) const { return kTogether * rows * ((batch + size - 1) / size * size); }
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

// Two sums of vectors for each field, in double precision.
template <class T>
class Sums {
 public:
  typedef typename Widened<T>::Vec Wide;

  void add(int field, typename Lane<T>::Vec first, typename Lane<T>::Vec second) {
    totals_[field][0] += __builtin_convertvector(first, Wide);
    totals_[field][1] += __builtin_convertvector(second, Wide);
  }
  double operator()(int field, int which) const {
    double sum = 0;
    for (int i = 0; i < Lane<T>::size; ++i) sum += totals_[field][which][i];
    return sum;
  }

 private:
  Wide totals_[kTogether][2] = {};
};

template <class T>
inline typename Lane<T>::Vec keep(typename Lane<T>::Vec v, int count) {
  for (int i = count; i < Lane<T>::size; ++i) v[i] = 0;
  return v;
}

// Mean and variance of some fields, whose vectors are written to `kept`.
template <class T>
void moments_of(const T* x, T* kept, const Rows& shape, int64_t first, double* mean,
                double* variance) {
  typedef typename Lane<T>::Vec Vec;
  constexpr int size = Lane<T>::size;
  const int some = shape.together(first);
  Sums<T> sums, rest;
  shape.each_vector<T>(first, [&](int f, int64_t at, int64_t number, int count) {
    const Vec value = load_one<T>(x + at, count);
    store_one<T>(kept + number * size, size, value);
    sums.add(f, value, Vec{});
  });
  T middle[kTogether];
  for (int f = 0; f < some; ++f) {
    mean[first + f] = sums(f, 0) / shape.count();
    middle[f] = static_cast<T>(mean[first + f]);
  }
  shape.each_vector<T>(first, [&](int f, int64_t, int64_t number, int count) {
    Vec centred = load_one<T>(kept + number * size, size) - middle[f];
    if (count < size) centred = keep<T>(centred, count);
    rest.add(f, centred, centred * centred);  // the first is what rounding the mean has left
  });
  for (int f = 0; f < some; ++f) {
    const double error = rest(f, 0) / shape.count();
    variance[first + f] = rest(f, 1) / shape.count() - error * error;
  }
}

// `y` may be null: then only the moments are wanted.
template <class T>
void forward(const T* x, const T* shortcut, const T* weight, const T* bias, double* mean,
             double* variance, T* y, double epsilon, bool relu, bool of_batch, const Rows& shape,
             int threads) {
  typedef typename Lane<T>::Vec Vec;
  constexpr int size = Lane<T>::size;
  const bool in_lines = shape.batch % size == 0 && is_line_start(y);
#pragma omp parallel num_threads(threads)
  {
    std::vector<T> memory(of_batch ? shape.kept(size) : 0);
#pragma omp for schedule(static)
    for (int64_t first = 0; first < shape.fields; first += kTogether) {
      if (of_batch) moments_of(x, memory.data(), shape, first, mean, variance);
      if (!y) continue;
      T scale[kTogether], middle[kTogether], shift[kTogether];
      for (int f = 0; f < shape.together(first); ++f) {
        const double factor = weight[first + f] / std::sqrt(variance[first + f] + epsilon);
        scale[f] = static_cast<T>(factor), middle[f] = static_cast<T>(mean[first + f]);
        shift[f] = static_cast<T>(bias[first + f] + (middle[f] - mean[first + f]) * factor);
      }
      shape.each_vector<T>(first, [&](int f, int64_t at, int64_t number, int count) {
        Vec value = of_batch ? load_one<T>(memory.data() + number * size, size)
                             : load_one<T>(x + at, count);
        value = scale[f] * (value - middle[f]) + shift[f];
        if (shortcut) value += load_one<T>(shortcut + at, count);
        if (relu) value = value < 0 ? Vec{} : value;  // keeps what is not a number
        store_one<T>(y + at, count, value, in_lines);
      });
      finish_streams();
    }
  }
}

// Of the batch norm's gradient: what is read, where it is written, and over how many numbers of a
// field the moments were taken (in all processes).
template <class T>
struct Backward {
  const T *grad, *y, *x, *weight;
  const double *mean, *variance;
  double* sums;  // (2, fields): of the gradient, and of its product with the centred maps
  T *of_x, *of_shortcut;
  double epsilon, count;
  Rows shape;

  // The gradient before the clipping; past the end it is zero.
  typename Lane<T>::Vec upstream(int64_t at, int some) const {
    const auto g = load_one<T>(grad + at, some);
    return y ? (load_one<T>(y + at, some) <= 0 ? typename Lane<T>::Vec{} : g) : g;
  }

  // Sums of some fields, whose vectors (upstream, centred) are written to `kept`.
  void add_up(int64_t first, const T* middle, T* kept) const {
    constexpr int size = Lane<T>::size;
    Sums<T> of_fields;
    shape.each_vector<T>(first, [&](int f, int64_t at, int64_t number, int some) {
      const auto g = upstream(at, some), centred = load_one<T>(x + at, some) - middle[f];
      store_one<T>(kept + 2 * number * size, size, g);
      store_one<T>(kept + (2 * number + 1) * size, size, centred);
      of_fields.add(f, g, g * centred);
    });
    for (int f = 0; f < shape.together(first); ++f) {
      for (int which : {0, 1}) sums[which * shape.fields + first + f] = of_fields(f, which);
    }
  }

  // Gradients of some fields from their sums; `kept` may be null.
  void apply(int64_t first, const T* middle, const T* kept) const {
    constexpr int size = Lane<T>::size;
    const bool in_lines = shape.batch % size == 0 && is_line_start(of_x) &&
                          (!of_shortcut || is_line_start(of_shortcut));
    T scale[kTogether], slope[kTogether], shift[kTogether];
    for (int f = 0; f < shape.together(first); ++f) {
      const double inverse = 1 / std::sqrt(variance[first + f] + epsilon);
      const double factor = weight[first + f] * inverse / count;
      scale[f] = static_cast<T>(weight[first + f] * inverse);
      slope[f] = static_cast<T>(-factor * inverse * inverse * sums[shape.fields + first + f]);
      shift[f] = static_cast<T>(-factor * sums[first + f]);
    }
    shape.each_vector<T>(first, [&](int f, int64_t at, int64_t number, int some) {
      const auto g = kept ? load_one<T>(kept + 2 * number * size, size) : upstream(at, some);
      const auto centred = kept ? load_one<T>(kept + (2 * number + 1) * size, size)
                                : load_one<T>(x + at, some) - middle[f];
      store_one<T>(of_x + at, some, scale[f] * g + slope[f] * centred + shift[f], in_lines);
      if (of_shortcut) store_one<T>(of_shortcut + at, some, g, in_lines);
    });
    finish_streams();
  }

  // Without `sum` the sums are given, without `of_x` only they are wanted.
  void run(bool sum, int threads) const {
#pragma omp parallel num_threads(threads)
    {
      std::vector<T> memory(sum ? 2 * shape.kept(Lane<T>::size) : 0);
#pragma omp for schedule(static)
      for (int64_t first = 0; first < shape.fields; first += kTogether) {
        T middle[kTogether];
        for (int f = 0; f < shape.together(first); ++f) middle[f] = static_cast<T>(mean[first + f]);
        if (sum) add_up(first, middle, memory.data());
        if (of_x) apply(first, middle, sum ? memory.data() : nullptr);
      }
    }
  }
};

}  // namespace

extern "C" {

void i2i_norm(const void* x, const void* shortcut, const void* weight, const void* bias,
              double* mean, double* variance, void* y, double epsilon, int relu, int of_batch,
              int is_double, int64_t rows, int64_t fields, int64_t batch, int threads) {
  const Rows shape{rows, fields, batch};
  if (is_double) {
    forward(as<double>(x), as<double>(shortcut), as<double>(weight), as<double>(bias), mean,
            variance, as<double>(y), epsilon, relu != 0, of_batch != 0, shape, threads);
  } else {
    forward(as<float>(x), as<float>(shortcut), as<float>(weight), as<float>(bias), mean, variance,
            as<float>(y), epsilon, relu != 0, of_batch != 0, shape, threads);
  }
}

void i2i_norm_backward(const void* grad, const void* y, const void* x, const void* weight,
                       const double* mean, const double* variance, double* sums, void* of_x,
                       void* of_shortcut, double epsilon, double count, int sum, int is_double,
                       int64_t rows, int64_t fields, int64_t batch, int threads) {
  const Rows shape{rows, fields, batch};
  if (is_double) {
    const Backward<double> backward{as<double>(grad), as<double>(y), as<double>(x),
                                    as<double>(weight), mean, variance, sums, as<double>(of_x),
                                    as<double>(of_shortcut), epsilon, count, shape};
    backward.run(sum != 0, threads);
  } else {
    const Backward<float> backward{as<float>(grad), as<float>(y), as<float>(x), as<float>(weight),
                                   mean, variance, sums, as<float>(of_x), as<float>(of_shortcut),
                                   epsilon, count, shape};
    backward.run(sum != 0, threads);
  }
}
}
