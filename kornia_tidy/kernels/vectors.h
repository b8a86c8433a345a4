// SIMD vectors of REAL, as wide as a register of the processor that the compiler targets, and the memory of a call; shared by
// the C sources.

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef _OPENMP
#include <omp.h>
#endif
#ifdef __linux__
#include <sys/mman.h>
#endif

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

enum { SINGLE = sizeof(REAL) == 4, FRACTION = SINGLE ? 23 : 52, BIAS = SINGLE ? 127 : 1023 };  // of a number's bits

typedef __typeof__(__builtin_choose_expr(SINGLE, (int32_t)0, (int64_t)0)) lane;
typedef REAL vec __attribute__((vector_size(VECTOR_BYTES)));
typedef lane bits __attribute__((vector_size(VECTOR_BYTES)));
typedef vec loose __attribute__((aligned(1), may_alias));

// For callers that want to know.
const int64_t vector_bytes = VECTOR_BYTES;

enum { NO_MEMORY = 1, REFUSED = 2 };  // status of functions: REFUSED is of values that they cannot use

INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE vec all(REAL x) { return x - (vec){0}; }

// The numbers of the lanes.
INLINE vec steps(void) {
    vec x;
    for (int i = 0; i < LANES; i++) x[i] = i;
    return x;
}

INLINE int thread_number(void) {
#ifdef _OPENMP
    return omp_get_thread_num();
#else
    return 0;
#endif
}

// Conditions of the preprocessor on the type of numbers, which it knows only by name: 1 or 0.
#define IS_float 1
#define IS_double 0
#define JOINED(a, b) a##b
#define IS(type) JOINED(IS_, type)

// Numbers of two vectors of one type, by their places in the first and, further on, in the second.
#if defined(__clang__) || __GNUC__ >= 12
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define PICK(a, b, ...) __builtin_shuffle(a, b, (lane __attribute__((vector_size(sizeof(a))))){__VA_ARGS__})
#endif

// For PICK: a vector's first two numbers by turns, and neighbours that change places.
#if VECTOR_BYTES == 64 && IS(REAL)
#define PAIR 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1
#define SWAP 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14
#elif VECTOR_BYTES == 64 || (VECTOR_BYTES == 32 && IS(REAL))
#define PAIR 0, 1, 0, 1, 0, 1, 0, 1
#define SWAP 1, 0, 3, 2, 5, 4, 7, 6
#elif VECTOR_BYTES == 32 || IS(REAL)
#define PAIR 0, 1, 0, 1
#define SWAP 1, 0, 3, 2
#else
#define PAIR 0, 1
#define SWAP 1, 0
#endif

INLINE bits bits_of(vec x) {
    bits same;
    memcpy(&same, &x, sizeof same);
    return same;
}

INLINE vec real_of(bits x) {
    vec same;
    memcpy(&same, &x, sizeof same);
    return same;
}

INLINE vec choose(bits condition, vec yes, vec no) {
    return real_of((bits_of(yes) & condition) | (bits_of(no) & ~condition));
}

// The numbers where a condition holds, and zeros elsewhere.
INLINE vec where(bits condition, vec x) { return real_of(bits_of(x) & condition); }

INLINE vec polynomial(const REAL *coefficients, int degree, vec x) {
    vec sum = all(coefficients[degree]);
#pragma GCC unroll 4
    for (int n = degree - 1; n >= 0; n--) sum = sum * x + coefficients[n];
    return sum;
}

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

// A vector of which the first `count` numbers, or all, come from memory; zeros behind them.
INLINE vec load_some(const REAL *from, int64_t count) {
    vec x = {0};
    if (count >= LANES) memcpy(&x, from, sizeof x);
    else memcpy(&x, from, count * sizeof(REAL));
    return x;
}

// Copies as many numbers of a vector, at most all.
INLINE void store_some(REAL *to, const void *from, int64_t count) {
    if (count >= LANES) memcpy(to, from, sizeof(vec));
    else memcpy(to, from, count * sizeof(REAL));
}

// Buffers of a call, which are freed together; `missing`: there was no memory for one of them.
typedef struct {
    void *last;  // begins with the address of the one before it
    int missing;
} pool;

enum { ALIGNED = 64, HUGE_PAGE = 2 << 20 };

// A buffer that begins with a whole vector, and may be read one before its begin and behind its end. A large one lies in huge
// pages where the system has them, because columns jump from page to page.
static inline void *take(pool *p, int64_t count, size_t size) {
    const size_t bytes = count * size + 2 * ALIGNED, unit = bytes < 2 * HUGE_PAGE ? ALIGNED : HUGE_PAGE;
    const size_t whole = (bytes + unit - 1) / unit * unit;
    char *memory = aligned_alloc(unit, whole);
    p->missing |= !memory;
    if (!memory) return 0;
#ifdef MADV_HUGEPAGE
    if (unit == HUGE_PAGE) madvise(memory, whole, MADV_HUGEPAGE);
#endif
    *(void **)memory = p->last, p->last = memory;
    return memory + ALIGNED;
}

static inline void *take_zeros(pool *p, int64_t count, size_t size) {
    void *memory = take(p, count, size);
    return memory ? memset(memory, 0, count * size) : 0;
}

static inline void free_all(pool *p) {
    for (void *own = p->last, *before; own; own = before) before = *(void **)own, free(own);
}
