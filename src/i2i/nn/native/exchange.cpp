// What processes of one machine tell each other through memory that they share: microseconds instead
// of a message's way through the kernel, which a training step would wait for forty times.
//
// Every process has a counter and two slots. In turn t it writes to slot t % 2, then sets its counter
// to t, and reads the others' slots when theirs say t. It writes to the same slot again two turns
// later, which it can only reach when all others have finished reading in turn t.

#include <sched.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>

#include "lanes.h"

namespace {

using namespace i2i;

// The last turn that a process has written, and what it wrote then: all have to write the same kind.
struct Written {
  std::atomic<uint64_t> turn;
  int64_t kinds[2];  // of the two slots
};
static_assert(std::atomic<uint64_t>::is_always_lock_free && sizeof(Written) <= kLineBytes,
              "shared counters");
constexpr int kOutOfStep = -1;

constexpr int kSpins = 256;            // between two looks at the clock
constexpr double kEager = 1e-3;        // seconds before the processor is left to others
constexpr double kPatient = 50e-3;     // and before it is left alone
constexpr int kSleepMicroseconds = 200;

double seconds() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

struct Room {
  char* memory;
  int64_t ranks, size;  // of a slot
  Written& written(int64_t rank) const {
    return *reinterpret_cast<Written*>(memory + rank * kLineBytes);
  }
  char* slot(uint64_t turn, int64_t rank) const {
    return memory + ranks * kLineBytes + ((turn % 2) * ranks + rank) * size;
  }
};

bool wait_for(const std::atomic<uint64_t>& counter, uint64_t turn, double until, double start) {
  while (true) {
    for (int spin = 0; spin < kSpins; ++spin) {
      if (counter.load(std::memory_order_acquire) >= turn) return true;
#if defined(__AVX__)
      _mm_pause();
#endif
    }
    const double now = seconds();
    if (now > until) return false;
    if (now - start > kPatient) {
      usleep(kSleepMicroseconds);
    } else if (now - start > kEager) {
      sched_yield();
    }
  }
}

template <class T>
void sum(const Room& room, uint64_t turn, T* to, int64_t count) {
  for (int64_t rank = 0; rank < room.ranks; ++rank) {  // in the same order everywhere
    const T* from = as<T>(room.slot(turn, rank));
    for (int64_t i = 0; i < count; ++i) to[i] = rank ? to[i] + from[i] : from[i];
  }
}

}  // namespace

extern "C" {

// Writes `ours` unless it is null: then an earlier call had to give up waiting. `theirs` becomes all
// ranks' bytes one after the other, or, `of` 1 or 2, the sum of their floats or doubles.
// Returns 0, 1 + the rank that did not come within `patience` seconds, or kOutOfStep.
int i2i_exchange(void* memory, int64_t rank, int64_t ranks, int64_t slot, uint64_t turn,
                 const void* ours, void* theirs, int64_t bytes, int of, double patience) {
  const Room room{static_cast<char*>(memory), ranks, slot};
  const int64_t kind = 4 * bytes + of;
  if (ours) {
    std::memcpy(room.slot(turn, rank), ours, bytes);
    room.written(rank).kinds[turn % 2] = kind;
    room.written(rank).turn.store(turn, std::memory_order_release);
  }
  const double start = seconds();
  for (int64_t other = 0; other < ranks; ++other) {
    if (!wait_for(room.written(other).turn, turn, start + patience, start)) {
      return static_cast<int>(1 + other);
    }
    if (room.written(other).kinds[turn % 2] != kind) return kOutOfStep;
  }
  if (of == 1) {
    sum(room, turn, as<float>(theirs), bytes / sizeof(float));
  } else if (of == 2) {
    sum(room, turn, as<double>(theirs), bytes / sizeof(double));
  } else {
    for (int64_t other = 0; other < ranks; ++other) {
      std::memcpy(as<char>(theirs) + other * bytes, room.slot(turn, other), bytes);
    }
  }
  return 0;
}
}
