// SIMD vectors of REAL, as wide as a register of the processor that the compiler targets; shared by the C sources.

#include <stdint.h>
#include <string.h>

#ifdef __AVX512F__
#define VECTOR_BYTES 64
#elif defined(__AVX__)
#define VECTOR_BYTES 32
#else  // SSE2, NEON, and what compilers make of it elsewhere
#define VECTOR_BYTES 16
#endif

// Only inlined functions take vectors as arguments, so the calling convention for vectors does not matter.
#pragma GCC diagnostic ignored "-Wpsabi"

#define INLINE static inline __attribute__((always_inline))

enum { LANES = VECTOR_BYTES / sizeof(REAL) };
enum { REGISTERS = VECTOR_BYTES == 64 ? 32 : 16 };  // for vectors

typedef REAL vec __attribute__((vector_size(VECTOR_BYTES)));

// For callers that want to know.
const int64_t vector_bytes = VECTOR_BYTES;

INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE REAL sum_of(vec lanes) {
    typedef REAL quarter __attribute__((vector_size(16)));
#if VECTOR_BYTES == 64
    typedef REAL half __attribute__((vector_size(32)));
    half halves[2];
    memcpy(halves, &lanes, sizeof lanes);
    halves[0] += halves[1];
#else
    vec halves[1] = {lanes};
#endif
    quarter quarters[2] = {0};
    memcpy(quarters, halves, sizeof halves[0]);
    quarters[0] += quarters[1];
    REAL sum = 0;
    for (int i = 0; i < 16 / (int)sizeof(REAL); i++) sum += quarters[0][i];
    return sum;
}
