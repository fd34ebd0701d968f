// The blocks of the C4-spectral convolution from the filters' coefficients, and the gradient of the
// coefficients from the gradient of the blocks: two products with one small matrix, made where the
// coefficients of one output field lie in the cache. What is written has nine times their size.
//
//   block[n][o][r][i]    = sum_k matrix[n][k][r] coefficient[o][k][i]
//   gradient[o][k][i]   += sum_n sum_r matrix[n][k][r] dblock[n][o][r][i]
//
// n: orbit, o and i: fields out and in, r: the 16 entries of a pair's block, k: coefficient. With the
// band-limited basis four in five of the matrix's entries are zero: they are left out.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "lanes.h"

namespace {

using namespace i2i;

constexpr int kEntries = 16;

// A row of sums: each term is a factor times a row.
template <class T>
struct Term {
  int64_t row;
  T factor;
};

// What the matrix is other than zero: the terms of each orbit's entries, or of its coefficients.
template <class T>
class Terms {
 public:
  Terms(const T* matrix, int64_t orbits, int64_t count, bool of_entries)
      : sums_(of_entries ? kEntries : count) {
    for (int64_t n = 0; n < orbits; ++n) {
      for (int64_t sum = 0; sum < sums_; ++sum) {
        begins_.push_back(terms_.size());
        for (int64_t row = 0; row < (of_entries ? count : kEntries); ++row) {
          const int64_t k = of_entries ? row : sum, r = of_entries ? sum : row;
          const T factor = matrix[(n * count + k) * kEntries + r];
          if (factor != 0) terms_.push_back({row, factor});
        }
      }
    }
    begins_.push_back(terms_.size());
  }

  // to[s][i] = sum of factor * from[row][i] over the terms of sum s, added to what is there if `add`.
  void apply(int64_t orbit, const T* from, T* to, int64_t width, bool add) const {
    for (int64_t s = 0; s < sums_; ++s) {
      const Term<T>* begin = terms_.data() + begins_[orbit * sums_ + s];
      const Term<T>* end = terms_.data() + begins_[orbit * sums_ + s + 1];
      constexpr int size = Lane<T>::size;
      int64_t i = 0;
      for (; i + kGroup * size <= width; i += kGroup * size) {
        columns<kGroup>(begin, end, from + i, to + s * width + i, width, size, add);
      }
      for (; i < width; i += size) {
        const int count = static_cast<int>(std::min<int64_t>(width - i, size));
        columns<1>(begin, end, from + i, to + s * width + i, width, count, add);
      }
    }
  }

 private:
  template <int kVectors>
  static inline __attribute__((always_inline)) void columns(const Term<T>* begin, const Term<T>* end, const T* from, T* to, int64_t width,
                      int count, bool add) {
    constexpr int size = Lane<T>::size;
    typename Lane<T>::Vec sums[kVectors] = {};
    if (add) {
      for (int v = 0; v < kVectors; ++v) sums[v] = load_one<T>(to + v * size, count);
    }
    for (const Term<T>* term = begin; term != end; ++term) {
      const T* row = from + term->row * width;
#pragma GCC unroll 4
      for (int v = 0; v < kVectors; ++v) sums[v] += term->factor * load_one<T>(row + v * size, count);
    }
    for (int v = 0; v < kVectors; ++v) store_one<T>(to + v * size, count, sums[v]);
  }

  int64_t sums_;
  std::vector<Term<T>> terms_;
  std::vector<size_t> begins_;
};

// `count` numbers between types; what is written past the caches if it begins with a line.
template <class T, class S>
void write_out(const T* from, S* to, int64_t count) {
  constexpr int size = kGroup * Lane<T>::size;
  for (int64_t i = 0; i < count; i += size) {
    typename Lane<T>::Vec group[kGroup] = {};
    const int some = static_cast<int>(std::min<int64_t>(count - i, size));
    load<T>(from + i, some, group);
    store<T>(to + i, some, group);
  }
}

template <class T, class S>
void read_in(const S* from, T* to, int64_t count) {
  constexpr int size = Lane<T>::size;
  for (int64_t i = 0; i < count; i += size) {
    const int some = static_cast<int>(std::min<int64_t>(count - i, size));
    store_one<T>(to + i, some, load_one<T>(from + i, some));
  }
}

template <class T, class S>
void blocks_of(const T* coefficients, const T* matrix, S* blocks, int64_t orbits, int64_t outs,
               int64_t ins, int64_t count, int threads) {
  const Terms<T> terms(matrix, orbits, count, true);
#pragma omp parallel num_threads(threads)
  {
    std::vector<T> block(kEntries * ins);
#pragma omp for schedule(static)
    for (int64_t o = 0; o < outs; ++o) {
      for (int64_t n = 0; n < orbits; ++n) {
        terms.apply(n, coefficients + o * count * ins, block.data(), ins, false);
        write_out(block.data(), blocks + (n * outs + o) * kEntries * ins, kEntries * ins);
      }
      finish_streams();
    }
  }
}

template <class T, class S>
void gradient_of(const S* blocks, const T* matrix, T* gradient, int64_t orbits, int64_t outs,
                 int64_t ins, int64_t count, int threads) {
  const Terms<T> terms(matrix, orbits, count, false);
#pragma omp parallel num_threads(threads)
  {
    std::vector<T> block(kEntries * ins);
#pragma omp for schedule(static)
    for (int64_t o = 0; o < outs; ++o) {
      for (int64_t n = 0; n < orbits; ++n) {
        read_in(blocks + (n * outs + o) * kEntries * ins, block.data(), kEntries * ins);
        terms.apply(n, block.data(), gradient + o * count * ins, ins, true);
      }
    }
  }
}

// The types of coefficients and blocks: 0 float, 1 float and blocks of bfloat16, 2 double.
template <class Act>
void for_types(int type, const Act& act) {
  if (type == 0) {
    act(float(), float());
  } else if (type == 1) {
    act(float(), uint16_t());
  } else {
    act(double(), double());
  }
}

}  // namespace

extern "C" {

void i2i_blocks(const void* coefficients, const void* matrix, void* blocks, int type,
                int64_t orbits, int64_t outs, int64_t ins, int64_t count, int threads) {
  for_types(type, [&](auto number, auto entry) {
    typedef decltype(number) T;
    blocks_of(as<T>(coefficients), as<T>(matrix), as<decltype(entry)>(blocks), orbits, outs, ins,
              count, threads);
  });
}

void i2i_coefficient_gradient(const void* blocks, const void* matrix, void* gradient, int type,
                              int64_t orbits, int64_t outs, int64_t ins, int64_t count,
                              int threads) {
  for_types(type, [&](auto number, auto entry) {
    typedef decltype(number) T;
    gradient_of(as<decltype(entry)>(blocks), as<T>(matrix), as<T>(gradient), orbits, outs, ins,
                count, threads);
  });
}
}
