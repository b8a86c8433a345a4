// SIMD vectors of 64 bytes of REAL, shared by the C sources.

#include <stdint.h>
#include <string.h>

// Only inlined functions take vectors as arguments, so the calling convention for vectors does not matter.
#pragma GCC diagnostic ignored "-Wpsabi"

#define INLINE static inline __attribute__((always_inline))

enum { LANES = 64 / sizeof(REAL) };

typedef REAL vec __attribute__((vector_size(64)));

INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE REAL sum_of(vec lanes) {
    typedef REAL half __attribute__((vector_size(32)));
    typedef REAL quarter __attribute__((vector_size(16)));
    half halves[2];
    memcpy(halves, &lanes, sizeof lanes);
    halves[0] += halves[1];
    quarter quarters[2];
    memcpy(quarters, halves, sizeof halves[0]);
    quarters[0] += quarters[1];
    REAL sum = 0;
    for (int i = 0; i < LANES / 4; i++) sum += quarters[0][i];
    return sum;
}
