// Products of real matrices with rows of vectors, whose sums stay in registers.

enum { BLOCK = 4, SPAN = REGISTERS == 32 ? 6 : 3 };  // rows of a matrix, and vectors

INLINE int64_t padded(int64_t count, int64_t step) { return (count + step - 1) / step * step; }

INLINE void add_products(const REAL *numbers, int64_t step, int64_t next, const vec *x, int64_t pitch, int64_t inner, int64_t vecs,
                         int rows, int count, vec *out) {
    vec sums[2 * BLOCK][SPAN] = {0};
    for (int64_t i = 0; i < inner; i++, numbers += step, x += pitch)
#pragma GCC unroll 8
        for (int n = 0; n < rows; n++)
#pragma GCC unroll 6
            for (int v = 0; v < count; v++) sums[n][v] += numbers[n / BLOCK * next + n % BLOCK] * x[v];
    for (int n = 0; n < rows; n++)
        for (int v = 0; v < count; v++) out[n * vecs + v] = sums[n][v];
}

// out (rows, vecs) = one block of a matrix or two, `next` numbers apart, with a column every few numbers, x rows of vectors.
INLINE void multiply_block(const REAL *numbers, int64_t step, int64_t next, const vec *x, int64_t pitch, int64_t inner,
                           int64_t vecs, int rows, vec *out) {
    const int span = rows == BLOCK ? SPAN : SPAN / 2;
    int64_t v = 0;
    for (; v + span <= vecs; v += span) add_products(numbers, step, next, x + v, pitch, inner, vecs, rows, span, out + v);
#pragma GCC unroll 5
    for (int rest = span - 1; rest > 0; rest--)
        if (vecs - v == rest) add_products(numbers, step, next, x + v, pitch, inner, vecs, rows, rest, out + v);
}
