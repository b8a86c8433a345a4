// Products of real matrices with rows of vectors, whose sums stay in registers.

enum { BLOCK = 4, SPAN = REGISTERS == 32 ? 6 : 3 };  // rows of a matrix, and vectors

INLINE int64_t padded(int64_t count, int64_t step) { return (count + step - 1) / step * step; }

INLINE void add_products(const REAL *numbers, int64_t step, const vec *x, int64_t pitch, int64_t inner, int64_t vecs, int count,
                         vec *out) {
    vec sums[BLOCK][SPAN] = {0};
    for (int64_t i = 0; i < inner; i++, numbers += step, x += pitch)
#pragma GCC unroll 4
        for (int n = 0; n < BLOCK; n++)
#pragma GCC unroll 6
            for (int v = 0; v < count; v++) sums[n][v] += numbers[n] * x[v];
    for (int n = 0; n < BLOCK; n++)
        for (int v = 0; v < count; v++) out[n * vecs + v] = sums[n][v];
}

// out (BLOCK, vecs) = a block of a matrix, with a column every few numbers, x rows of vectors.
INLINE void multiply_block(const REAL *numbers, int64_t step, const vec *x, int64_t pitch, int64_t inner, int64_t vecs, vec *out) {
    int64_t v = 0;
    for (; v + SPAN <= vecs; v += SPAN) add_products(numbers, step, x + v, pitch, inner, vecs, SPAN, out + v);
#pragma GCC unroll 5
    for (int count = 1; count < SPAN; count++)
        if (vecs - v == count) add_products(numbers, step, x + v, pitch, inner, vecs, count, out + v);
}
