// Vectors of 64 bytes, and how they are read from and written to memory.

#pragma once

#include <cstdint>
#include <cstring>
#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace i2i {

constexpr int kLineBytes = 64;
constexpr int kGroup = 4;  // vectors of images that are read and written together, side by side

template <class T>
struct Lane {
  static constexpr int size = kLineBytes / sizeof(T);
  typedef T Vec __attribute__((vector_size(kLineBytes)));
};
typedef Lane<float>::Vec Floats;
typedef uint32_t Bits __attribute__((vector_size(kLineBytes)));
typedef uint16_t Halves __attribute__((vector_size(kLineBytes / 2)));

template <class T>
inline const T* as(const void* pointer) {
  return static_cast<const T*>(pointer);
}

template <class T>
inline T* as(void* pointer) {
  return static_cast<T*>(pointer);
}

// ---- vectors in memory: as they are, or float as bfloat16 (uint16) ----

inline Floats to_memory(Floats v, const float*) { return v; }
inline Lane<double>::Vec to_memory(Lane<double>::Vec v, const double*) { return v; }

// To nearest, ties to even, as torch rounds; what is not a number stays so.
inline Halves to_memory(Floats v, const uint16_t*) {
  Bits bits;
  std::memcpy(&bits, &v, sizeof(bits));
  bits += 0x7fff + ((bits >> 16) & 1);
  const Bits is_nan = (Bits)(v != v);
  bits = (is_nan & 0x7fc00000u) | (~is_nan & bits);
  return __builtin_convertvector(bits >> 16, Halves);
}

inline Floats from_memory(Floats v) { return v; }
inline Lane<double>::Vec from_memory(Lane<double>::Vec v) { return v; }

inline Floats from_memory(Halves half) {
  const Bits bits = __builtin_convertvector(half, Bits) << 16;
  Floats v;
  std::memcpy(&v, &bits, sizeof(v));
  return v;
}

// Past the caches. With 64 images the orbits of a spectrum lie a multiple of 4 KiB apart: in a cache
// they would drive each other out, and what is read between them as well.
inline void stream_line(void* to, const void* line) {
#if defined(__AVX512F__)
  _mm512_stream_si512(static_cast<__m512i*>(to), _mm512_loadu_si512(line));
#elif defined(__AVX__)
  for (int part = 0; part < 2; ++part) {
    _mm256_stream_si256(static_cast<__m256i*>(to) + part,
                        _mm256_loadu_si256(static_cast<const __m256i*>(line) + part));
  }
#else
  std::memcpy(to, line, kLineBytes);
#endif
}

inline void finish_streams() {
#if defined(__AVX__)
  _mm_sfence();
#endif
}

// `count` values; a vector that they do not fill is filled up with zeros.
template <class T, class S>
inline typename Lane<T>::Vec load_one(const S* from, int count) {
  decltype(to_memory(typename Lane<T>::Vec(), from)) part;
  if (count >= Lane<T>::size) {
    std::memcpy(&part, from, sizeof(part));
  } else {
    part = decltype(part){};
    std::memcpy(&part, from, count * sizeof(S));
  }
  return from_memory(part);
}

inline bool is_line_start(const void* at) {
  return reinterpret_cast<uintptr_t>(at) % kLineBytes == 0;
}

template <class T, class S>
inline void store_one(S* to, int count, typename Lane<T>::Vec v, bool is_line = false) {
  const auto part = to_memory(v, to);
  if (is_line && sizeof(part) == kLineBytes) {
    stream_line(to, &part);
  } else if (count >= Lane<T>::size) {
    std::memcpy(to, &part, sizeof(part));
  } else {
    std::memcpy(to, &part, count * sizeof(S));
  }
}

// The same for `count` values in several vectors.
template <class T, class S, class Vec>
inline void load(const S* from, int count, Vec (&group)[kGroup]) {
  constexpr int size = Lane<T>::size;
  for (int v = 0; v * size < count; ++v) group[v] = load_one<T>(from + v * size, count - v * size);
}

template <class T, class S, class Vec>
inline void store(S* to, int count, const Vec (&group)[kGroup]) {
  constexpr int size = Lane<T>::size;
  if (count == kGroup * size && is_line_start(to)) {
    decltype(to_memory(Vec(), to)) parts[kGroup];
    for (int v = 0; v < kGroup; ++v) parts[v] = to_memory(group[v], to);
    for (unsigned at = 0; at < sizeof(parts); at += kLineBytes) {
      stream_line(reinterpret_cast<char*>(to) + at, reinterpret_cast<const char*>(parts) + at);
    }
    return;
  }
  for (int v = 0; v * size < count; ++v) store_one<T>(to + v * size, count - v * size, group[v]);
}

}  // namespace i2i
