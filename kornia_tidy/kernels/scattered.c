// Light in the pixels of a sensor from scattered points in the stop of a lens, averaged over the states of an exposure,
// for several exposures, and the gradients of the states' waves and weights. The formulas are in scattered_ops.py.
//
// For each depth the points of a patch, which share a wave, are spread on a patch of the grid. This is added to the grid
// of each state, times the state's wave. Sums and differences of a grid's mirrored rows and columns are transformed by real
// matrices, rows first; those of an even and of an odd distance from the middle apart, as samples half a period away differ
// from them by signs. Sums over pixels act once on the average over states.
//
// A row of a grid holds the points of an x, so that y lies in the lanes of vectors. Complex numbers of grids are interleaved. A depth is computed by one thread, and gradients are added depth by depth, so
// that results are the same for any number of threads.
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include <math.h>

#include "vectors.h"
#include "products.h"

enum { ROWS = 4 };                                   // of a patch: weights of points are padded to a multiple

// The fields of `_fill` in scattered_ops.py.
typedef struct {
    int64_t threads, places, depths, exposures, states, cells, patches, points, phases, amplitudes, width, degree, extent, quarter,
        samples, shifts, window;
    const REAL *waves, *weights;                  // (exposures, states, cells) complex, (states,)
    const int64_t *cell;                          // (patches,)
    const double *values;                         // (places, 2 + phases + amplitudes, patches, points)
    const double *phase_terms, *amplitude_terms;  // (depths, phases), (depths, amplitudes)
    const REAL *kernel;                           // (degree + 1,)
    const REAL *cosines, *sines;                  // (quarter, extent / 2 + 1)
    const REAL *rows, *columns;                   // (places, exposures, shifts, window, samples)
    const REAL *gradient;                         // (places, depths, exposures, shifts, window, window); not for light
    REAL *light;                                  // like gradient
    REAL *of_waves, *of_weights;                  // gradients: like waves and weights, zeros
} scattered;

// -1 and 1 by turns.
INLINE vec signs(void) {
    vec x;
    for (int i = 0; i < LANES; i++) x[i] = i % 2 ? 1 : -1;
    return x;
}

// For PICK: complex numbers in reverse order, and those of two vectors by turns, of their first and of their second halves.
#if VECTOR_BYTES == 64 && IS(REAL)
#define REVERSE 14, 15, 12, 13, 10, 11, 8, 9, 6, 7, 4, 5, 2, 3, 0, 1
#define FIRST_HALVES 0, 1, 16, 17, 2, 3, 18, 19, 4, 5, 20, 21, 6, 7, 22, 23
#define SECOND_HALVES 8, 9, 24, 25, 10, 11, 26, 27, 12, 13, 28, 29, 14, 15, 30, 31
#elif VECTOR_BYTES == 64 || (VECTOR_BYTES == 32 && IS(REAL))
#define REVERSE 6, 7, 4, 5, 2, 3, 0, 1
#define FIRST_HALVES 0, 1, 8, 9, 2, 3, 10, 11
#define SECOND_HALVES 4, 5, 12, 13, 6, 7, 14, 15
#elif VECTOR_BYTES == 32 || IS(REAL)
#define REVERSE 2, 3, 0, 1
#define FIRST_HALVES 0, 1, 4, 5
#define SECOND_HALVES 2, 3, 6, 7
#else
#define REVERSE 0, 1
#define FIRST_HALVES 0, 1
#define SECOND_HALVES 2, 3
#endif

// Interleaved complex numbers times i.
INLINE vec times_i(vec x) { return PICK(x, x, SWAP) * signs(); }

// ---------------------------------------------------------------------- products with real matrices

// A matrix in blocks of BLOCK rows, the last one padded with zeros, and the columns with other numbers in each block.
typedef struct {
    int64_t blocks, inner;
    REAL *numbers;           // (blocks, inner, BLOCK)
    int64_t *first, *after;  // (blocks,)
} matrix;

// Lays a matrix out, or its transpose, if there is memory for it.
static matrix lay_out(pool *p, const REAL *from, int64_t rows, int64_t inner, int transposed) {
    const int64_t blocks = (rows + BLOCK - 1) / BLOCK;
    matrix m = {blocks, inner, take(p, blocks * inner * BLOCK, sizeof(REAL)), take(p, blocks, sizeof(int64_t)),
                take(p, blocks, sizeof(int64_t))};
    for (int64_t b = 0; !p->missing && b < blocks; b++) {
        m.first[b] = inner, m.after[b] = 0;
        for (int64_t i = 0; i < inner; i++)
            for (int64_t n = 0; n < BLOCK; n++) {
                const int64_t row = b * BLOCK + n;
                const REAL x = row >= rows ? 0 : transposed ? from[i * rows + row] : from[row * inner + i];
                m.numbers[(b * inner + i) * BLOCK + n] = x;
                if (x != 0) m.first[b] = least(m.first[b], i), m.after[b] = i + 1;
            }
        m.first[b] = least(m.first[b], m.after[b]);
    }
    return m;
}

// out (padded rows, vecs) = matrix (rows, inner) x every few rows of (inner, vecs).
static void multiply_rows(const matrix *m, const vec *x, int64_t pitch, int64_t vecs, vec *out) {
    for (int64_t b = 0; b < m->blocks; b++, out += BLOCK * vecs) {
        const int64_t first = m->first[b];
        const REAL *numbers = m->numbers + (b * m->inner + first) * BLOCK;
        multiply_block(numbers, BLOCK, 0, x + first * pitch, pitch, m->after[b] - first, vecs, BLOCK, out);
    }
}

static void multiply(const matrix *m, const vec *x, int64_t vecs, vec *out) { multiply_rows(m, x, vecs, vecs, out); }

// What takes the sums or differences of mirrored rows to their transform, and back; of columns the same as tables. Parts of
// columns of an even and of an odd number.
typedef struct {
    matrix rows[2], rows_back[2];
    vec *table[2], *table_back[2];  // (inner, across), (quarter, upright)
} axes;

// Lays the transform of cosines or sines out, if there is memory for it. The middle row and column are their own mirror images:
// they count twice in sums, and half in what takes them forwards.
static axes lay_out_axes(pool *p, const scattered *s, const REAL *from, int64_t across, int64_t upright) {
    const int64_t inner = s->extent / 2 + 1, quarter = s->quarter;
    REAL *part = take(p, quarter * inner, sizeof(REAL)), *halved = take(p, quarter * inner, sizeof(REAL));
    axes t;
    for (int odd = 0; odd < 2; odd++) {
        const int64_t count = (inner + 1 - odd) / 2;
        t.table[odd] = take_zeros(p, count * across, sizeof(vec)), t.table_back[odd] = take_zeros(p, quarter * upright, sizeof(vec));
        for (int64_t n = 0; !p->missing && n < quarter * count; n++) {
            const int64_t k = n / count, i = n % count;
            part[n] = from[k * inner + 2 * i + odd], halved[n] = part[n] * (REAL)(i || odd ? 1 : 0.5);
            ((REAL *)t.table[odd])[i * across * LANES + k] = halved[n];
            ((REAL *)t.table_back[odd])[k * upright * LANES + i] = part[n];
        }
        t.rows[odd] = lay_out(p, halved, quarter, count, 0), t.rows_back[odd] = lay_out(p, part, count, quarter, 1);
    }
    return t;
}

// ---------------------------------------------------------------------- points of a place

// What all depths of a place share.
typedef struct {
    const scattered *s;
    int64_t tall, rows, vecs;         // samples that a patch touches along an axis; padded; vectors of a row of them
    int64_t across, along, beside;    // vectors in a row of the grid, in a quarter of a row of samples, in one of pixels
    int64_t folded;                   // vectors in a row of sums and one of differences of a grid's columns
    int64_t upright;                  // vectors in a quarter of a row of the grid
    int64_t block;                    // numbers of a block, see desk
    int64_t *start;                   // (patches, 2): first row and column that a patch touches
    REAL *row_weights;                // (patches, points, rows)
    vec *column_weights;              // (patches, points, vecs), each number twice
    axes cosines, sines;
    matrix *pixels;                   // (exposures, shifts, 4): columns, rows, and the transposes
    REAL *parts;                      // (depths, waves and weights): their gradients
} work;

// Finds the samples that each patch touches, as many for all. Returns whether they lie in the grid.
static int find_patches(work *w, const double *places) {
    const scattered *s = w->s;
    const double half = (double)s->width / 2;
    w->tall = 0;
    for (int axis = 0; axis < 2; axis++)
        for (int64_t c = 0; c < s->patches; c++) {
            const double *place = places + ((1 - axis) * s->patches + c) * s->points;
            double low = place[0], high = place[0];
            for (int64_t i = 1; i < s->points; i++) {
                low = place[i] < low || place[i] != place[i] ? place[i] : low;
                high = place[i] > high ? place[i] : high;
            }
            low = ceil(low - half), high = floor(high + half);
            if (!(low >= 0 && high < (double)s->extent)) return 0;
            w->start[2 * c + axis] = (int64_t)low;
            const int64_t touched = (int64_t)high - (int64_t)low + 1;
            w->tall = touched > w->tall ? touched : w->tall;
        }
    for (int64_t n = 0; n < 2 * s->patches; n++) w->start[n] = least(w->start[n], s->extent - w->tall);
    return 1;
}

// The kernel at samples so far from a point.
INLINE vec spread_kernel(const scattered *s, vec away) {
    const vec x = away * (REAL)(2 / (double)s->width), u = 1 - x * x;
    vec sum = all(s->kernel[s->degree]);
    for (int64_t n = s->degree - 1; n >= 0; n--) sum = sum * u + s->kernel[n];
    return where(u > 0, sum);
}

static void fill_weights(work *w, const double *places) {
    const scattered *s = w->s;
    vec halves;
    for (int i = 0; i < LANES; i++) halves[i] = i / 2;
#pragma omp parallel for num_threads(s->threads)
    for (int64_t c = 0; c < s->patches; c++)
        for (int64_t i = c * s->points; i < (c + 1) * s->points; i++) {
            const REAL row = (REAL)(places[s->patches * s->points + i] - (double)w->start[2 * c]);
            const REAL column = (REAL)(places[i] - (double)w->start[2 * c + 1]);
            for (int64_t t = 0; t < w->rows; t += LANES) {
                const vec x = spread_kernel(s, steps() + ((REAL)t - row));
                memcpy(w->row_weights + i * w->rows + t, &x, least(LANES, w->rows - t) * sizeof(REAL));
            }
            for (int64_t v = 0; v < w->vecs; v++)
                w->column_weights[i * w->vecs + v] = spread_kernel(s, halves + ((REAL)(v * (LANES / 2)) - column));
        }
}

// The field of some points at a depth, interleaved.
INLINE void fill_some(const double *values, int64_t pitch, const double *phases, int64_t many, const double *amplitudes,
                      int64_t few, int64_t count, REAL *field) {
    const double unit = 0x1.8p52;
    double phase[LANES] = {0}, amplitude[LANES] = {0};
    for (int64_t r = 0; r < many; r++, values += pitch)
        for (int64_t l = 0; l < count; l++) phase[l] += phases[r] * values[l];
    for (int64_t r = 0; r < few; r++, values += pitch)
        for (int64_t l = 0; l < count; l++) amplitude[l] += amplitudes[r] * values[l];
    REAL turns[LANES], sizes[LANES];
    for (int l = 0; l < LANES; l++) {
        turns[l] = (REAL)(phase[l] - ((phase[l] + unit) - unit));
        sizes[l] = (REAL)amplitude[l];
    }
    // Sine and cosine of a quarter turn at most, by their series; half a turn more changes both signs.
    static const REAL SINE[] = {1, -1. / 6, 1. / 120, -1. / 5040, 1. / 362880, -1. / 39916800, 1. / 6227020800,
                                -1. / 1307674368e3, 1. / 355687428096e3, -1. / 121645100408832e3, 1. / 51090942171709440e3};
    static const REAL COSINE[] = {1, -1. / 2, 1. / 24, -1. / 720, 1. / 40320, -1. / 3628800, 1. / 479001600,
                                  -1. / 87178291200, 1. / 20922789888e3, -1. / 6402373705728e3, 1. / 2432902008176640e3,
                                  -1. / 1124000727777607680e3};
    const REAL whole = SINGLE ? 0x1.8p23 : 0x1.8p52;
    vec turn, size;
    memcpy(&turn, turns, sizeof turn), memcpy(&size, sizes, sizeof size);
    const vec sum = 2 * turn + whole, half = sum - whole, angle = (turn - half / 2) * (REAL)(2 * M_PI), square = angle * angle;
    size *= 1 - 2 * half * half;
    const vec re = size * polynomial(COSINE, SINGLE ? 6 : 11, square), im = size * angle * polynomial(SINE, SINGLE ? 6 : 10, square);
    REAL parts[2 * LANES];
    for (int l = 0; l < LANES; l++) parts[2 * l] = re[l], parts[2 * l + 1] = im[l];
    memcpy(field, parts, 2 * count * sizeof(REAL));
}

static void fill_field(const scattered *s, const double *values, int64_t d, REAL *field) {
    const int64_t total = s->patches * s->points;
    const double *phases = s->phase_terms + d * s->phases, *amplitudes = s->amplitude_terms + d * s->amplitudes;
    int64_t i = 0;
    for (; i + LANES <= total; i += LANES)
        fill_some(values + i, total, phases, s->phases, amplitudes, s->amplitudes, LANES, field + 2 * i);
    if (i < total) fill_some(values + i, total, phases, s->phases, amplitudes, s->amplitudes, total - i, field + 2 * i);
}

INLINE void spread_rows(const work *w, const REAL *field, int64_t first, int rows, int64_t row, int64_t vector, int count,
                        vec *patch) {
    const REAL *down = w->row_weights + first * w->rows + row;
    const vec *right = w->column_weights + first * w->vecs + vector;
    vec sums[2 * ROWS][2];
    memset(sums, 0, sizeof sums);
    for (int64_t i = 0; i < w->s->points; i++, down += w->rows, right += w->vecs) {
        const vec pair = *(const loose *)(field + 2 * (first + i)), both = PICK(pair, pair, PAIR);
#pragma GCC unroll 2
        for (int v = 0; v < count; v++) {
            const vec x = both * right[v];
#pragma GCC unroll 8
            for (int r = 0; r < rows; r++) sums[r][v] += down[r] * x;
        }
    }
    for (int r = 0; r < rows; r++)
        for (int v = 0; v < count; v++) patch[(row + r) * w->vecs + vector + v] = sums[r][v];
}

// Spreads the points of a patch: (rows, vecs) complex, and the same times i.
static void spread(const work *w, const REAL *field, int64_t c, vec *patch, vec *turned) {
    const int64_t first = c * w->s->points;
    for (int64_t v = 0; v < w->vecs; v += 2) {
        int64_t row = 0;
        if (v + 1 == w->vecs) {
            if (REGISTERS == 32)
                for (; row + 2 * ROWS <= w->rows; row += 2 * ROWS) spread_rows(w, field, first, 2 * ROWS, row, v, 1, patch);
            for (; row < w->rows; row += ROWS) spread_rows(w, field, first, ROWS, row, v, 1, patch);
        } else {
            if (REGISTERS == 32)
                for (; row + 2 * ROWS <= w->rows; row += 2 * ROWS) spread_rows(w, field, first, 2 * ROWS, row, v, 2, patch);
            for (; row < w->rows; row += ROWS) spread_rows(w, field, first, ROWS, row, v, 2, patch);
        }
    }
    for (int64_t n = 0; n < w->tall * w->vecs; n++) turned[n] = times_i(patch[n]);
}

// ---------------------------------------------------------------------- one depth

// What a thread computes a depth in. Numbers of rows are padded to whole blocks where they come from a product.
typedef struct {
    REAL *field;         // (patches, points) complex
    vec *grids;          // (exposures, states, extent, across)
    vec *patch, *turned; // (rows, vecs)
    vec *folded[2];      // (extent / 2 + 1, folded): sums of mirrored rows, and differences times -i; columns alike
    vec *sets[4];        // (quarter, folded): transforms of sums of even and odd rows, and of their differences
    REAL *blocks[2];     // (2, extent / 2 + 1 and more, BLOCK): sum and difference of columns for rows of samples, near and far
    vec *parts[4];       // (2, BLOCK, along): transforms of their even and odd columns
    vec *light;          // (samples, 4, along): average over states of squared moduli, see at_y
    vec *lines;          // (window, 4, along): light summed to columns of pixels
    vec *turned_lines;   // (samples, beside): the same the other way round
    vec *pixels;         // (window, beside)
    vec *of_light;       // (samples, 4, along): gradient
    REAL *turned_parts;  // (quarter, BLOCK): a block of gradients of parts the other way round
    vec *rows_back;      // (extent / 4 + 1, folded): gradients of even or odd rows
    vec *block[2];       // (BLOCK, upright): of even and odd columns of the grid
} desk;

INLINE vec *grid_row(const work *w, vec *grid, int64_t row) { return grid + row * w->across; }

enum { TOGETHER = 4 };  // states whose waves stay in registers

// Adds a patch times waves to the grids of some states.
INLINE void add_patch(const work *w, const desk *d, int64_t vecs, int states, const REAL *waves, REAL *grids) {
    const int64_t pitch = w->across * LANES, size = w->s->extent * pitch;
    REAL re[TOGETHER], im[TOGETHER];
#pragma GCC unroll 8
    for (int k = 0; k < states; k++) re[k] = waves[2 * k * w->s->cells], im[k] = waves[2 * k * w->s->cells + 1];
    for (int64_t r = 0; r < w->tall; r++, grids += pitch)
        for (int64_t v = 0; v < vecs; v++) {
            const vec x = d->patch[r * vecs + v], y = d->turned[r * vecs + v];
#pragma GCC unroll 8
            for (int k = 0; k < states; k++) ((loose *)(grids + k * size))[v] += re[k] * x + im[k] * y;
        }
}

static void fill_grids(const work *w, const desk *d) {
    const scattered *s = w->s;
    const int64_t vecs = w->vecs, states = s->exposures * s->states, size = s->extent * w->across * LANES;
    memset(d->grids, 0, states * size * sizeof(REAL));
    for (int64_t c = 0; c < s->patches; c++) {
        spread(w, d->field, c, d->patch, d->turned);
        REAL *at = (REAL *)d->grids + w->start[2 * c] * w->across * LANES + 2 * w->start[2 * c + 1];
        const REAL *wave = s->waves + 2 * s->cell[c];
        int64_t k = 0;
        for (; k + TOGETHER <= states; k += TOGETHER, at += TOGETHER * size, wave += 2 * TOGETHER * s->cells)
            if (vecs == 1) add_patch(w, d, 1, TOGETHER, wave, at);
            else if (vecs == 2) add_patch(w, d, 2, TOGETHER, wave, at);
            else add_patch(w, d, vecs, TOGETHER, wave, at);
        for (; k < states; k++, at += size, wave += 2 * s->cells) add_patch(w, d, vecs, 1, wave, at);
    }
}

// Sums and differences of a grid's mirrored rows and columns. A row of them holds sums of columns, and then differences.
static void fold(const work *w, const REAL *grid, const desk *d) {
    const int64_t half = w->s->extent / 2, inner = 2 * half + 2, pitch = w->across * LANES;
    for (int64_t i = 0; i <= half; i++) {
        const REAL *above = grid + (half + i) * pitch + 2 * half, *below = grid + (half - i) * pitch + 2 * half;
        for (int odd = 0; odd < 2; odd++) {
            REAL *sum = (REAL *)(d->folded[0] + i * w->folded) + odd * inner, *less = (REAL *)(d->folded[1] + i * w->folded) + odd * inner;
            for (int64_t m = 0; m < inner; m += LANES) {
                const vec a = *(const loose *)(above + m), b = *(const loose *)(below + m);
                vec e = *(const loose *)(above - m - LANES + 2), f = *(const loose *)(below - m - LANES + 2);
                e = PICK(e, e, REVERSE), f = PICK(f, f, REVERSE);
                const vec up = odd ? times_i(e - a) : a + e, down = odd ? times_i(f - b) : b + f;
                *(loose *)(sum + m) = up + down;
                *(loose *)(less + m) = times_i(down - up);
            }
        }
    }
}

// The transpose of it. The middle row and column have no differences.
static void unfold(const work *w, REAL *grid, const desk *d) {
    const int64_t half = w->s->extent / 2, inner = 2 * half + 2, pitch = w->across * LANES;
    for (int64_t i = 0; i <= half; i++) {
        REAL *above = grid + (half + i) * pitch + 2 * half, *below = grid + (half - i) * pitch + 2 * half;
        const REAL *sum = (const REAL *)(d->folded[0] + i * w->folded), *less = (const REAL *)(d->folded[1] + i * w->folded);
        for (int64_t m = 0; m < inner; m += 2)
            for (int n = 0; n < 2; n++) {  // times i: minus the imaginary part, and the real one
                const int sign = n ? 1 : -1, row = i > 0, column = m > 0;
                const REAL one = row * sign * less[m + 1 - n], two = column * sign * sum[inner + m + 1 - n],
                           both = row * column * -less[inner + m + n];
                above[m + n] = sum[m + n] + one + two + both, above[n - m] = sum[m + n] + one - two - both;
                below[m + n] = sum[m + n] - one + two - both, below[n - m] = sum[m + n] - one - two + both;
            }
    }
}

// The sums and differences of columns for mirrored rows of samples near the middle, and far from it: half a period away.
static void fill_blocks(const work *w, int64_t j, const desk *d) {
    const int64_t inner = w->s->extent / 2 + 1;
    for (int odd = 0; odd < 2; odd++) {
        const REAL *set[4];
        for (int n = 0; n < 4; n++) set[n] = (const REAL *)(d->sets[n] + j * w->folded) + odd * 2 * inner;
        REAL *near = d->blocks[odd], *far = near + w->block;
        for (int64_t m = 0; m < 2 * inner; m += LANES) {
            const vec a = *(const loose *)(set[0] + m), b = *(const loose *)(set[1] + m), c = *(const loose *)(set[2] + m),
                      e = *(const loose *)(set[3] + m);
            const vec high = (a + b) + (c + e), low = (a + b) - (c + e), there = (a - b) + (e - c), back = (a - b) - (e - c);
            *(loose *)(near + 2 * m) = PICK(high, low, FIRST_HALVES);
            *(loose *)(near + 2 * m + LANES) = PICK(high, low, SECOND_HALVES);
            *(loose *)(far + 2 * m) = PICK(there, back, FIRST_HALVES);
            *(loose *)(far + 2 * m + LANES) = PICK(there, back, SECOND_HALVES);
        }
    }
}

// Transforms one block or two to the parts of their samples. Registers may hold both.
static void transform_blocks(const work *w, int count, const desk *d) {
    const int64_t inner = w->s->extent / 2 + 1, along = w->along;
    for (int n = 0; n < 4; n++) {
        const vec *table = (n < 2 ? &w->cosines : &w->sines)->table[n % 2];
        const REAL *block = d->blocks[n / 2] + n % 2 * BLOCK;
        const int64_t columns = (inner + 1 - n % 2) / 2;
        if (count == 2 && REGISTERS == 32) multiply_block(block, 2 * BLOCK, w->block, table, along, columns, along, 2 * BLOCK, d->parts[n]);
        else
            for (int far = 0; far < count; far++)
                multiply_block(block + far * w->block, 2 * BLOCK, 0, table, along, columns, along, BLOCK, d->parts[n] + far * BLOCK * along);
    }
}

// The transpose of both, from the gradients of a block's parts.
static void add_block_back(const work *w, int64_t j, int far, const desk *d) {
    const int64_t quarter = w->s->quarter, inner = w->s->extent / 2 + 1, pitch = w->upright * LANES;
    const REAL sign = far ? -1 : 1;
    for (int odd = 0; odd < 2; odd++) {
        for (int n = 0; n < 2; n++) {
            const REAL *part = (const REAL *)(d->parts[2 * odd + n] + far * BLOCK * w->along);
            for (int64_t q = 0; q < quarter; q++)
                for (int r = 0; r < BLOCK; r++) d->turned_parts[q * BLOCK + r] = part[r * w->along * LANES + q];
            const vec *table = (odd ? &w->sines : &w->cosines)->table_back[n];
            multiply_block(d->turned_parts, BLOCK, 0, table, w->upright, quarter, w->upright, BLOCK, d->block[n]);
        }
        REAL *set[4];
        for (int n = 0; n < 4; n++) set[n] = (REAL *)(d->sets[n] + j * w->folded) + odd * 2 * inner;
        for (int64_t m = 0; m < inner; m++)
            for (int n = 0; n < 2; n++) {
                const REAL *block = (const REAL *)d->block[m % 2] + m / 2, high = block[n * pitch], low = block[(2 + n) * pitch];
                set[0][2 * m + n] += high + low, set[1][2 * m + n] += sign * (high + low);
                set[2][2 * m + n] += sign * (high - low), set[3][2 * m + n] += high - low;
            }
    }
}

// Samples from the parts of their transform: on either side of the middle, and half a period away.
INLINE void add_up(vec a, vec b, vec c, vec e, vec *x) {
    x[0] = (a + b) + (c + e), x[1] = (a + b) - (c + e), x[2] = (a - b) + (e - c), x[3] = (a - b) - (e - c);
}

// Adds the light of a block's samples at the row j from the middle.
static void add_light(const work *w, int64_t j, int far, REAL weight, const desk *d) {
    const int64_t half = w->s->samples / 2, vecs = w->along;
    for (int side = 0; side < 2; side++) {
        vec *row = d->light + (side ? half - 1 - j : half + j) * 4 * vecs;
        const int64_t at = (far * BLOCK + 2 * side) * vecs;
        const vec *a = d->parts[0] + at, *b = d->parts[1] + at, *c = d->parts[2] + at, *e = d->parts[3] + at;
        for (int64_t v = 0; v < vecs; v++) {
            vec re[4], im[4];
            add_up(a[v], b[v], c[v], e[v], re);
            add_up(a[vecs + v], b[vecs + v], c[vecs + v], e[vecs + v], im);
#pragma GCC unroll 4
            for (int n = 0; n < 4; n++) row[n * vecs + v] += weight * (re[n] * re[n] + im[n] * im[n]);
        }
    }
}

// Where a sample of y stands in a row of light.
INLINE int64_t at_y(const work *w, int64_t y) {
    const int64_t half = w->s->samples / 2, side = y < half, k = side ? half - 1 - y : y - half, far = k >= w->s->quarter;
    return (2 * far + side) * w->along * LANES + (far ? 2 * w->s->quarter - 1 - k : k);
}

static void sum_pixels(const work *w, const matrix *pixels, const desk *d, REAL *out) {
    const int64_t window = w->s->window;
    for (int64_t v = 0; v < w->s->shifts; v++, out += window * window) {
        multiply(pixels + 4 * v, d->light, 4 * w->along, d->lines);
        for (int64_t p = 0; p < w->beside; p++)
            for (int64_t y = 0; y < w->s->samples; y++) {
                const REAL *line = (const REAL *)(d->lines + p * LANES * 4 * w->along) + at_y(w, y);
                REAL *turned = (REAL *)(d->turned_lines + y * w->beside + p);
                for (int64_t i = 0; i < least(LANES, window - p * LANES); i++) turned[i] = line[i * 4 * w->along * LANES];
            }
        multiply(pixels + 4 * v + 1, d->turned_lines, w->beside, d->pixels);
        for (int64_t q = 0; q < window; q++) memcpy(out + q * window, d->pixels + q * w->beside, window * sizeof(REAL));
    }
}

// The transpose of it, to the gradient of the light.
static void spread_pixels(const work *w, const matrix *pixels, const desk *d, const REAL *gradient) {
    const int64_t window = w->s->window, size = w->s->samples * 4 * w->along;
    memset(d->of_light, 0, size * sizeof(vec));
    memset(d->lines, 0, window * 4 * w->along * sizeof(vec));
    for (int64_t v = 0; v < w->s->shifts; v++) {
        for (int64_t q = 0; q < window; q++, gradient += window) memcpy(d->pixels + q * w->beside, gradient, window * sizeof(REAL));
        multiply(pixels + 4 * v + 3, d->pixels, w->beside, d->turned_lines);
        for (int64_t y = 0; y < w->s->samples; y++) {
            REAL *line = (REAL *)d->lines + at_y(w, y);
            const REAL *turned = (const REAL *)(d->turned_lines + y * w->beside);
            for (int64_t p = 0; p < window; p++) line[p * 4 * w->along * LANES] = turned[p];
        }
        multiply(pixels + 4 * v + 2, d->lines, 4 * w->along, d->light);
        for (int64_t n = 0; n < size; n++) d->of_light[n] += d->light[n];
    }
}

// Turns the parts of a block's samples into their gradients, and returns that of the state's weight.
static REAL light_gradient(const work *w, int64_t j, int far, REAL weight, const desk *d) {
    const int64_t half = w->s->samples / 2, vecs = w->along;
    vec total = {0};
    for (int side = 0; side < 2; side++) {
        const vec *row = d->of_light + (side ? half - 1 - j : half + j) * 4 * vecs;
        for (int64_t v = 0; v < 2 * vecs; v++) {  // real parts, then imaginary ones
            const int64_t at = (far * BLOCK + 2 * side) * vecs + v, y = v < vecs ? v : v - vecs;
            vec *a = d->parts[0] + at, *b = d->parts[1] + at, *c = d->parts[2] + at, *e = d->parts[3] + at, x[4], of[4];
            add_up(*a, *b, *c, *e, x);
#pragma GCC unroll 4
            for (int n = 0; n < 4; n++) of[n] = row[n * vecs + y] * x[n], total += of[n] * x[n];
            const vec sum = of[0] + of[1], less = of[0] - of[1], far_sum = of[2] + of[3], far_less = of[2] - of[3];
            *a = 2 * weight * (sum + far_sum), *b = 2 * weight * (sum - far_sum);
            *c = 2 * weight * (less - far_less), *e = 2 * weight * (less + far_less);
        }
    }
    return sum_of(total);
}

// Adds the light of a state, or turns its grid into the gradient and returns that of its weight.
static REAL transform_state(const work *w, int64_t k, REAL weight, const desk *d) {
    const int64_t quarter = w->s->quarter, half = w->s->samples / 2, inner = w->s->extent / 2 + 1, vecs = w->folded;
    const int learning = w->s->gradient != 0;
    REAL *grid = (REAL *)grid_row(w, d->grids, k * w->s->extent), of_weight = 0;
    fold(w, grid, d);
    for (int n = 0; n < 4; n++)
        multiply_rows((n < 2 ? &w->cosines : &w->sines)->rows + n % 2, d->folded[n / 2] + n % 2 * vecs, 2 * vecs, vecs, d->sets[n]);
    for (int64_t j = 0; j < quarter; j++) {
        const int64_t rows[2] = {j, 2 * quarter - 1 - j};
        const int count = (rows[0] < half) + (rows[1] < half);
        fill_blocks(w, j, d);
        transform_blocks(w, count, d);
        for (int n = 0; n < 4 && learning; n++) memset(d->sets[n] + j * vecs, 0, vecs * sizeof(vec));
        for (int far = 0; far < count; far++)
            if (learning) of_weight += light_gradient(w, rows[far], far, weight, d), add_block_back(w, j, far, d);
            else add_light(w, rows[far], far, weight, d);
    }
    for (int n = 0; n < 4 && learning; n++) {
        multiply((n < 2 ? &w->cosines : &w->sines)->rows_back + n % 2, d->sets[n], vecs, d->rows_back);
        for (int64_t i = n % 2; i < inner; i += 2)
            memcpy(d->folded[n / 2] + i * vecs, d->rows_back + i / 2 * vecs, vecs * sizeof(vec));
    }
    if (learning) unfold(w, grid, d);
    return of_weight;
}

// The gradient of waves, (exposures, states, cells) complex, from those of the grids.
static void gather_waves(const work *w, const desk *d, REAL *of_waves) {
    const scattered *s = w->s;
    for (int64_t c = 0; c < s->patches; c++) {
        spread(w, d->field, c, d->patch, d->turned);
        for (int64_t k = 0; k < s->exposures * s->states; k++) {
            const REAL *at = (const REAL *)grid_row(w, d->grids, k * s->extent + w->start[2 * c]) + 2 * w->start[2 * c + 1];
            vec re = {0}, im = {0};
            for (int64_t r = 0; r < w->tall; r++, at += w->across * LANES)
                for (int64_t v = 0; v < w->vecs; v++) {
                    const vec x = ((const loose *)at)[v];
                    re += x * d->patch[r * w->vecs + v], im += x * d->turned[r * w->vecs + v];
                }
            REAL *wave = of_waves + 2 * (k * s->cells + s->cell[c]);
            wave[0] += sum_of(re), wave[1] += sum_of(im);
        }
    }
}

static desk take_desk(pool *p, const work *w) {
    const scattered *s = w->s;
    const int64_t inner = s->extent / 2 + 1, samples = padded(s->samples, BLOCK), window = padded(s->window, BLOCK);
    const int64_t quarter = padded(s->quarter, BLOCK), states = s->exposures * s->states;
    desk d = {.field = take_zeros(p, 2 * s->patches * s->points + LANES, sizeof(REAL))};
    d.grids = take_zeros(p, states * s->extent * w->across, sizeof(vec));
    d.patch = take_zeros(p, w->rows * w->vecs, sizeof(vec)), d.turned = take_zeros(p, w->rows * w->vecs, sizeof(vec));
    for (int n = 0; n < 2; n++) {
        d.folded[n] = take_zeros(p, inner * w->folded, sizeof(vec)), d.block[n] = take_zeros(p, BLOCK * w->upright, sizeof(vec));
        d.blocks[n] = take_zeros(p, 2 * w->block, sizeof(REAL));
    }
    for (int n = 0; n < 4; n++)
        d.sets[n] = take_zeros(p, quarter * w->folded, sizeof(vec)), d.parts[n] = take_zeros(p, 2 * BLOCK * w->along, sizeof(vec));
    d.light = take_zeros(p, samples * 4 * w->along, sizeof(vec)), d.of_light = take_zeros(p, samples * 4 * w->along, sizeof(vec));
    d.lines = take_zeros(p, window * 4 * w->along, sizeof(vec)), d.turned_lines = take_zeros(p, samples * w->beside, sizeof(vec));
    d.pixels = take_zeros(p, window * w->beside, sizeof(vec)), d.turned_parts = take_zeros(p, s->quarter * BLOCK, sizeof(REAL));
    d.rows_back = take_zeros(p, padded((inner + 1) / 2, BLOCK) * w->folded, sizeof(vec));
    return d;
}

// One depth of a place: its light, or the gradients, which are added to `of_waves` and `of_weights`.
static void compute(const work *w, int64_t place, int64_t depth, const desk *d, REAL *of_waves, REAL *of_weights) {
    const scattered *s = w->s;
    const int64_t size = s->shifts * s->window * s->window, out = (place * s->depths + depth) * s->exposures * size;
    const int64_t rows = 2 + s->phases + s->amplitudes;
    fill_field(s, s->values + (place * rows + 2) * s->patches * s->points, depth, d->field);
    fill_grids(w, d);
    for (int64_t e = 0; e < s->exposures; e++) {
        const matrix *pixels = w->pixels + 4 * e * s->shifts;
        if (s->gradient) spread_pixels(w, pixels, d, s->gradient + out + e * size);
        else memset(d->light, 0, s->samples * 4 * w->along * sizeof(vec));
        for (int64_t k = 0; k < s->states; k++) {
            const REAL of_weight = transform_state(w, e * s->states + k, s->weights[k], d);
            if (s->gradient) of_weights[k] += of_weight;
        }
        if (!s->gradient) sum_pixels(w, pixels, d, s->light + out + e * size);
    }
    if (s->gradient) gather_waves(w, d, of_waves);
}

static int compute_place(work *w, int64_t place) {
    const scattered *s = w->s;
    const int64_t total = s->patches * s->points;
    const double *places = s->values + place * (2 + s->phases + s->amplitudes) * total;
    if (!find_patches(w, places)) return REFUSED;
    w->rows = padded(w->tall, ROWS), w->vecs = (2 * w->tall + LANES - 1) / LANES;
    const int64_t most = 2 * (s->extent - w->tall) + w->vecs * LANES;
    w->across = ((most > 2 * s->extent ? most : 2 * s->extent) + LANES - 1) / LANES;
    w->folded = (2 * s->extent + 2 + LANES - 1) / LANES, w->block = 2 * padded(s->extent + 1, LANES);
    w->beside = (s->window + LANES - 1) / LANES;
    pool p = {0};
    w->row_weights = take(&p, total * w->rows, sizeof(REAL)), w->column_weights = take(&p, total * w->vecs, sizeof(vec));
    desk desks[s->threads];
    for (int64_t n = 0; n < s->threads; n++) desks[n] = take_desk(&p, w);
    w->pixels = take(&p, 4 * s->exposures * s->shifts, sizeof(matrix));
    for (int64_t n = 0; !p.missing && n < 4 * s->exposures * s->shifts; n++) {
        const int64_t at = (place * s->exposures * s->shifts + n / 4) * s->window * s->samples, back = n % 4 >= 2;
        if (back && !s->gradient) continue;
        const int64_t height = back ? s->samples : s->window, width = back ? s->window : s->samples;
        w->pixels[n] = lay_out(&p, (n % 2 ? s->rows : s->columns) + at, height, width, back);
    }
    if (!p.missing) {
        fill_weights(w, places);
        const int64_t waves = 2 * s->exposures * s->states * s->cells, numbers = waves + s->states;
        if (s->gradient) memset(w->parts, 0, s->depths * numbers * sizeof(REAL));
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
        for (int64_t depth = 0; depth < s->depths; depth++) {
            REAL *own = s->gradient ? w->parts + depth * numbers : 0;
            compute(w, place, depth, desks + thread_number(), own, s->gradient ? own + waves : 0);
        }
        for (int64_t depth = 0; depth < s->depths && s->gradient; depth++) {
            const REAL *own = w->parts + depth * numbers;
            for (int64_t n = 0; n < waves; n++) s->of_waves[n] += own[n];
            for (int64_t k = 0; k < s->states; k++) s->of_weights[k] += own[waves + k];
        }
    }
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}

// The light, or with a gradient of it those of waves and weights. Returns 0, NO_MEMORY, or REFUSED where points lie beyond
// the grid.
int scattered_light(const scattered *s) {
    const int64_t along = (s->quarter + LANES - 1) / LANES, upright = (s->extent / 4 + LANES) / LANES;
    pool p = {0};
    work w = {.s = s, .along = along, .upright = upright, .cosines = lay_out_axes(&p, s, s->cosines, along, upright),
              .sines = lay_out_axes(&p, s, s->sines, along, upright)};
    w.start = take(&p, 2 * s->patches, sizeof(int64_t));
    w.parts = take(&p, s->gradient ? s->depths * s->states * (2 * s->exposures * s->cells + 1) : 0, sizeof(REAL));
    int status = p.missing ? NO_MEMORY : 0;
    for (int64_t place = 0; place < s->places && !status; place++) status = compute_place(&w, place);
    free_all(&p);
    return status;
}
