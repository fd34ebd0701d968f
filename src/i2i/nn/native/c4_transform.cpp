// Analysis and synthesis of the C4-spectral convolution in one pass over the maps each; the
// mathematics is in c4_spectral.py, whose torch form computes the same.
//
// A map of one field, turn pair and vector of images is transformed where it lies in the cache:
//   x(r, c) -> sums and differences of the turns g and g + 2
//           -> cosines and sines along the columns, then along the rows (M + 1 of each)
//           -> real and imaginary parts at the orbits' frequencies, by sums of those products.
// Cells are counted from the middle of the map, so that cosines see only the even part of a line and
// sines the odd part: half the products.
//
// Built by hatch_build.py; called from native/__init__.py, which documents the arrays.

#include <cstdint>
#include <cstring>
#include <initializer_list>

#include "lanes.h"

namespace {

using namespace i2i;

constexpr int kTurns = 4;

// ---- one map of H x H cells and its products of cosines and sines ----

template <class T, int H, int M>
struct Products {
  typedef typename Lane<T>::Vec Vec;
  static constexpr int kHalf = (H + 1) / 2;
  static constexpr int kCount = (M + 1) * (M + 1);
  // At row frequency * (M + 1) + column frequency; in cs the rows' factor is the cosine.
  Vec cc[kCount], cs[kCount], sc[kCount], ss[kCount];

  // waves[kind][frequency][distance from the middle].
  typedef T Waves[2][M + 1][kHalf];

  static inline void line_to_waves(const Vec* line, int step, const Waves& waves, Vec* cosines,
                                   Vec* sines, int out_step) {
    Vec even[kHalf], odd[kHalf];
    for (int j = 0; j < kHalf; ++j) {
      const Vec& high = line[(H / 2 + j) * step];
      const Vec& low = line[((H - 1) / 2 - j) * step];
      const bool middle = H % 2 == 1 && j == 0;
      even[j] = middle ? high : high + low;
      odd[j] = high - low;
    }
    for (int w = 0; w <= M; ++w) {
      Vec c = waves[0][w][0] * even[0], s = waves[1][w][0] * odd[0];
      for (int j = 1; j < kHalf; ++j) {
        c += waves[0][w][j] * even[j];
        s += waves[1][w][j] * odd[j];
      }
      cosines[w * out_step] = c;
      sines[w * out_step] = s;
    }
  }

  static inline void waves_to_line(const Vec* cosines, const Vec* sines, int step,
                                   const Waves& waves, Vec* line, int out_step) {
    for (int j = 0; j < kHalf; ++j) {
      Vec even = waves[0][0][j] * cosines[0], odd = waves[1][0][j] * sines[0];
      for (int w = 1; w <= M; ++w) {
        even += waves[0][w][j] * cosines[w * step];
        odd += waves[1][w][j] * sines[w * step];
      }
      line[(H / 2 + j) * out_step] = even + odd;
      line[((H - 1) / 2 - j) * out_step] = even - odd;  // in the middle the odd part is 0
    }
  }

  void from_map(const Vec* map, const Waves& waves) {
    Vec cosines[M + 1][H], sines[M + 1][H];
    for (int r = 0; r < H; ++r) {
      line_to_waves(map + r * H, 1, waves, &cosines[0][r], &sines[0][r], H);
    }
    for (int w = 0; w <= M; ++w) {
      line_to_waves(cosines[w], 1, waves, cc + w, sc + w, M + 1);
      line_to_waves(sines[w], 1, waves, cs + w, ss + w, M + 1);
    }
  }

  void to_map(Vec* map, const Waves& waves) const {
    Vec cosines[M + 1][H], sines[M + 1][H];
    for (int w = 0; w <= M; ++w) {
      waves_to_line(cc + w, sc + w, M + 1, waves, cosines[w], 1);
      waves_to_line(cs + w, ss + w, M + 1, waves, sines[w], 1);
    }
    for (int r = 0; r < H; ++r) {
      waves_to_line(&cosines[0][r], &sines[0][r], H, waves, map + r * H, 1);
    }
  }

  void clear() {
    for (Vec* part : {cc, cs, sc, ss}) std::memset(part, 0, sizeof(cc));
  }
};

// ---- spectra ----

struct Shape {
  int64_t orbits, fields, batch;
  bool fields_first;

  // Row of a block's columns: (half, slot, field), or (field, half, slot).
  int64_t row(int half, int slot, int64_t field) const {
    const int part = half * 2 + slot;
    return fields_first ? field * kTurns + part : part * fields + field;
  }
  int64_t cell(int64_t pixel, int turn, int64_t field, int64_t image) const {
    return ((pixel * kTurns + turn) * fields + field) * batch + image;
  }
  int images_from(int64_t image, int most) const {
    return batch - image < most ? static_cast<int>(batch - image) : most;
  }
  int64_t at(int64_t orbit, int64_t row, int column, int64_t image) const {
    return ((orbit * kTurns * fields + row) * kTurns + column) * batch + image;
  }
};

// At R w (turn 1) the fields are numbered one further: slot 0 holds g = 1, slot 1 holds g = 2, which
// is g = 0 again, with the opposite sign for differences.
struct Place {
  int slot, column, sign;
  Place(int half, int g, int turn)
      : slot(turn ? 1 - g : g), column(turn ? 0 : 2), sign(turn && half && g == 0 ? -1 : 1) {}
};

constexpr double kSqrtHalf = 0.70710678118654752440;

// One frequency: where its products stand, and the signs of its two parts.
template <class T>
struct Frequency {
  int at;
  T a, b, ab;
};

template <class T, int M>
struct Frequencies {
  Frequency<T> list[2][(2 * M + 1) * (2 * M + 1) / kTurns];
  // `table`: (orbits, w | R w, |a|, |b|, sign of a, sign of b).
  Frequencies(const int32_t* table, int64_t orbits) {
    for (int64_t n = 0; n < orbits; ++n) {
      for (int turn = 0; turn < 2; ++turn) {
        const int32_t* w = table + (n * 2 + turn) * 4;
        list[turn][n] = {w[0] * (M + 1) + w[1], T(w[2]), T(w[3]), T(w[2] * w[3])};
      }
    }
  }
};

template <class T, class S, int H, int M>
void analyse(const T* maps, S* main, S* zero, const Shape& shape, const int32_t* frequency_table,
             const void* wave_table, int threads) {
  typedef Products<T, H, M> P;
  typedef typename P::Vec Vec;
  constexpr int size = Lane<T>::size;
  const auto& waves = *static_cast<const typename P::Waves*>(wave_table);
  const Frequencies<T, M> frequencies(frequency_table, shape.orbits);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t field = 0; field < shape.fields; ++field) {
    Vec mixed[2][kGroup][H * H];
    P products[kGroup];
    Vec a[kGroup], b[kGroup];
    for (int64_t image = 0; image < shape.batch; image += kGroup * size) {
      const int images = shape.images_from(image, kGroup * size);
      for (int g = 0; g < 2; ++g) {
        for (int p = 0; p < H * H; ++p) {
          load<T>(maps + shape.cell(p, g, field, image), images, a);
          load<T>(maps + shape.cell(p, g + 2, field, image), images, b);
          for (int v = 0; v * size < images; ++v) {
            mixed[0][v][p] = a[v] + b[v];
            mixed[1][v][p] = a[v] - b[v];
          }
        }
        for (int half = 0; half < 2; ++half) {
          for (int v = 0; v * size < images; ++v) products[v].from_map(mixed[half][v], waves);
          for (int turn = 0; turn < 2; ++turn) {
            const Place place(half, g, turn);
            const T sign = place.sign;
            const int64_t row = shape.row(half, place.slot, field);
            for (int64_t n = 0; n < shape.orbits; ++n) {
              const Frequency<T>& w = frequencies.list[turn][n];
              for (int v = 0; v * size < images; ++v) {
                const P& of = products[v];
                const Vec real = sign * of.cc[w.at] - (sign * w.ab) * of.ss[w.at];
                const Vec imaginary = -(sign * w.a) * of.sc[w.at] - (sign * w.b) * of.cs[w.at];
                a[v] = half ? imaginary : real;
                b[v] = half ? -real : imaginary;
              }
              S* to = main + shape.at(n, row, place.column, image);
              store<T>(to, images, a);
              store<T>(to + shape.batch, images, b);
            }
          }
          for (int v = 0; v * size < images; ++v) a[v] = T(kSqrtHalf) * products[v].cc[0];
          store<T>(zero + shape.row(half, g, field) * shape.batch + image, images, a);
        }
      }
    }
    finish_streams();
  }
}

template <class T, class S, int H, int M>
void synthesise(const S* main, const S* zero, T* maps, const Shape& shape,
                const int32_t* frequency_table, const void* wave_table, int threads) {
  typedef Products<T, H, M> P;
  typedef typename P::Vec Vec;
  constexpr int size = Lane<T>::size;
  const auto& waves = *static_cast<const typename P::Waves*>(wave_table);
  const Frequencies<T, M> frequencies(frequency_table, shape.orbits);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t field = 0; field < shape.fields; ++field) {
    Vec mixed[2][kGroup][H * H];
    P products[kGroup];
    Vec a[kGroup], b[kGroup];
    for (int64_t image = 0; image < shape.batch; image += kGroup * size) {
      const int images = shape.images_from(image, kGroup * size);
      for (int g = 0; g < 2; ++g) {
        for (int half = 0; half < 2; ++half) {
          for (int v = 0; v * size < images; ++v) products[v].clear();
          for (int turn = 0; turn < 2; ++turn) {
            const Place place(half, g, turn);
            const T sign = place.sign;
            const int64_t row = shape.row(half, place.slot, field);
            for (int64_t n = 0; n < shape.orbits; ++n) {
              const Frequency<T>& w = frequencies.list[turn][n];
              const S* from = main + shape.at(n, row, place.column, image);
              load<T>(from, images, a);
              load<T>(from + shape.batch, images, b);
              for (int v = 0; v * size < images; ++v) {
                P& of = products[v];
                const Vec real = half ? -b[v] : a[v], imaginary = half ? a[v] : b[v];
                of.cc[w.at] += sign * real;
                of.ss[w.at] -= (sign * w.ab) * real;
                of.sc[w.at] -= (sign * w.a) * imaginary;
                of.cs[w.at] -= (sign * w.b) * imaginary;
              }
            }
          }
          load<T>(zero + shape.row(half, g, field) * shape.batch + image, images, a);
          for (int v = 0; v * size < images; ++v) {
            products[v].cc[0] = T(kSqrtHalf) * a[v];
            products[v].to_map(mixed[half][v], waves);
          }
        }
        for (int p = 0; p < H * H; ++p) {
          for (int v = 0; v * size < images; ++v) {
            a[v] = mixed[0][v][p] + mixed[1][v][p];
            b[v] = mixed[0][v][p] - mixed[1][v][p];
          }
          store<T>(maps + shape.cell(p, g, field, image), images, a);
          store<T>(maps + shape.cell(p, g + 2, field, image), images, b);
        }
      }
    }
    finish_streams();
  }
}

// ---- the sizes and types that are built ----

struct Call {
  const void* source;
  void* target;
  void* zero;  // read by synthesis, written by analysis
  Shape shape;
  const int32_t* frequencies;
  const void* waves;
  int threads;
};

struct Analyse : Call {
  template <class T, class S, int H, int M>
  void run() const {
    analyse<T, S, H, M>(static_cast<const T*>(source), static_cast<S*>(target),
                        static_cast<S*>(zero), shape, frequencies, waves, threads);
  }
};

struct Synthesise : Call {
  template <class T, class S, int H, int M>
  void run() const {
    synthesise<T, S, H, M>(static_cast<const S*>(source), static_cast<const S*>(zero),
                           static_cast<T*>(target), shape, frequencies, waves, threads);
  }
};

// 0: float; 1: float, with a spectrum of bfloat16; 2: double.
template <int H, int M, class Act>
int for_type(int type, const Act& act) {
  if (type == 0) act.template run<float, float, H, M>();
  if (type == 1) act.template run<float, uint16_t, H, M>();
  if (type == 2) act.template run<double, double, H, M>();
  return 0;
}

template <class Act>
int for_size(int map_size, int padded_size, int type, const Act& act) {
  switch (map_size * 100 + padded_size) {
    case 405: return for_type<4, 2>(type, act);
    case 507: return for_type<5, 3>(type, act);
    case 809: return for_type<8, 4>(type, act);
    case 911: return for_type<9, 5>(type, act);
    case 1617: return for_type<16, 8>(type, act);
    case 1719: return for_type<17, 9>(type, act);
    default: return 1;
  }
}

}  // namespace

extern "C" {

int i2i_analyse(const void* maps, void* main, void* zero, int map_size, int padded_size, int type,
                int64_t orbits, int64_t fields, int64_t batch, int fields_first,
                const int32_t* frequencies, const void* waves, int threads) {
  const Shape shape{orbits, fields, batch, fields_first != 0};
  return for_size(map_size, padded_size, type,
                  Analyse{{maps, main, zero, shape, frequencies, waves, threads}});
}

int i2i_synthesise(const void* main, void* zero, void* maps, int map_size, int padded_size, int type,
                   int64_t orbits, int64_t fields, int64_t batch, int fields_first,
                   const int32_t* frequencies, const void* waves, int threads) {
  const Shape shape{orbits, fields, batch, fields_first != 0};
  return for_size(map_size, padded_size, type,
                  Synthesise{{main, maps, zero, shape, frequencies, waves, threads}});
}
}
