// Patches of images, row by row: what the kernel of the first convolution sees at each place.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "lanes.h"

extern "C" {

// In the order in which native/stem.py gives them.
struct I2iStem {
  int64_t batch, colours, image_height, image_width;
  int64_t kernel, stride, padding;                // of the convolution
  int64_t window, window_stride, window_padding;  // of the max-pool
  int64_t height, width;                          // of the map between them
  int64_t out_height, out_width, channels;        // of the result
};
}

namespace i2i {

// A tile of places x vectors of channels that is summed in registers.
#if defined(__AVX512F__)
constexpr int kPlaces = 8, kVectors = 2;
#else
constexpr int kPlaces = 4, kVectors = 1;
#endif

template <class T>
using Vector = typename Lane<T>::Vec;

inline int64_t round_up(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

// The last few rows of something that is made row by row; zero at the beginning.
template <class T>
class Ring {
 public:
  Ring(int64_t rows, int64_t row_size)
      : rows_(rows), size_(row_size), memory_(rows * row_size + kLineBytes / sizeof(T)) {
    while (!is_line_start(memory_.data() + start_)) ++start_;
  }
  T* first() { return memory_.data() + start_; }
  int64_t offset(int64_t y) const { return y % rows_ * size_; }
  T* row(int64_t y) { return first() + offset(y); }

 private:
  int64_t rows_, size_, start_ = 0;
  std::vector<T> memory_;
};

// Makes rows of patches (place, depth): K numbers and a 1, and after them what happens to be there.
// Behind the places of a row there is room for one more, which the last window's stride may reach.
template <class T>
class Patches {
 public:
  explicit Patches(const I2iStem& shape)
      : shape_(shape),
        length_(shape.image_width + 2 * shape.padding + std::max(shape.kernel, kWhole)),
        lines_(shape.colours * shape.kernel * length_),
        count(count_of(shape)),
        depth(depth_of(shape)),
        places(round_up(shape.width, kPlaces)),
        row_size((places + 1) * depth) {}

  static int64_t count_of(const I2iStem& shape) {
    return shape.colours * shape.kernel * shape.kernel;
  }
  static int64_t depth_of(const I2iStem& shape) {
    return round_up(count_of(shape) + 1, kVectors * Lane<T>::size);
  }

  void fill(const T* image, int64_t y, T* to) {
    const int64_t k = shape_.kernel, lines = shape_.colours * k;
    for (int64_t line = 0; line < lines; ++line) {
      read_line(image, line / k, y * shape_.stride + line % k - shape_.padding,
                lines_.data() + line * length_);
    }
    // Whole vectors where what they write too much is written again or never read.
    const bool whole = k <= kWhole && count - k + kWhole <= depth;
    for (int64_t x = 0; x < shape_.width; ++x, to += depth) {
      const T* from = lines_.data() + x * shape_.stride;
      for (int64_t line = 0; line < lines; ++line) {
        if (whole) {
          std::memcpy(to + line * k, from + line * length_, kWhole * sizeof(T));
        } else {
          std::copy(from + line * length_, from + line * length_ + k, to + line * k);
        }
      }
      to[count] = 1;
    }
  }

 private:
  static constexpr int64_t kWhole = 8;

  void read_line(const T* image, int64_t colour, int64_t y, T* to) {
    if (y < 0 || y >= shape_.image_height) {
      std::fill(to, to + length_, T(0));
      return;
    }
    // The ends of every line are zero from the beginning.
    const T* from = image + (colour * shape_.image_height + y) * shape_.image_width;
    std::copy(from, from + shape_.image_width, to + shape_.padding);
  }

  const I2iStem& shape_;
  const int64_t length_;
  std::vector<T> lines_;

 public:
  const int64_t count, depth, places, row_size;
};

template <class T>
const T* image_at(const T* images, int64_t image, const I2iStem& shape) {
  return images + image * shape.colours * shape.image_height * shape.image_width;
}

}  // namespace i2i
