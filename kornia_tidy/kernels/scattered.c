// Light in the pixels of a sensor from scattered points in the stop of a lens, averaged over the states of an exposure,
// for several exposures, and the gradients of the states' waves and weights. The formulas are in scattered_ops.py.
//
// For each depth the points of a patch, which share a wave, are spread on a patch of the grid. This is added to the grid
// of each state, times the state's wave. Rows of a grid are transformed by real matrices as sums and differences of
// mirrored rows, then columns. Sums over pixels act once on the average over states.
//
// Complex numbers of grids are interleaved. A depth is computed by one thread, and gradients are added depth by depth, so
// that results are the same for any number of threads.
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include <math.h>
#include <stdlib.h>

#include "vectors.h"

enum { BLOCK = 4, SPAN = REGISTERS == 32 ? 6 : 3 };  // rows and vectors of a product that stay in registers
enum { ROWS = 4 };                                   // of a patch: weights of points are padded to a multiple
enum { NO_MEMORY = 1, OUTSIDE = 2 };                 // status of the functions

// The fields of `_Scattered` in scattered_ops.py.
typedef struct {
    int64_t places, depths, exposures, states, cells, patches, points, phases, amplitudes, width, degree, extent, samples,
        shifts, window, threads;
    const int64_t *cell;                          // (patches,)
    const double *values;                         // (places, 2 + phases + amplitudes, patches, points)
    const double *phase_terms, *amplitude_terms;  // (depths, phases), (depths, amplitudes)
    const REAL *kernel;                           // (degree + 1,)
    const REAL *waves, *weights;                  // (exposures, states, cells) complex, (states,)
    const REAL *cosines, *sines;                  // (samples / 2, extent / 2)
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

// Interleaved complex numbers times i.
INLINE vec times_i(vec x) { return PICK(x, x, SWAP) * signs(); }

INLINE int64_t padded(int64_t count, int64_t step) { return (count + step - 1) / step * step; }

// ---------------------------------------------------------------------- products with real matrices

// A matrix in blocks of BLOCK rows, the last one padded with zeros, and the columns with other numbers in each block.
typedef struct {
    int64_t blocks, inner;
    REAL *numbers;           // (blocks, inner, BLOCK)
    int64_t *first, *after;  // (blocks,)
} matrix;

static int64_t matrix_size(int64_t rows, int64_t inner) {
    const int64_t blocks = (rows + BLOCK - 1) / BLOCK;
    return blocks * 2 * sizeof(int64_t) + blocks * inner * BLOCK * sizeof(REAL);
}

// Lays a matrix out in `memory`, or its transpose, and returns the rest of the memory.
static char *lay_out(matrix *m, const REAL *from, int64_t rows, int64_t inner, int transposed, char *memory) {
    *m = (matrix){(rows + BLOCK - 1) / BLOCK, inner, 0, 0, 0};
    m->first = (int64_t *)memory, m->after = m->first + m->blocks, m->numbers = (REAL *)(m->after + m->blocks);
    for (int64_t b = 0; b < m->blocks; b++) {
        m->first[b] = inner, m->after[b] = 0;
        for (int64_t i = 0; i < inner; i++)
            for (int64_t n = 0; n < BLOCK; n++) {
                const int64_t row = b * BLOCK + n;
                const REAL x = row >= rows ? 0 : transposed ? from[i * rows + row] : from[row * inner + i];
                m->numbers[(b * inner + i) * BLOCK + n] = x;
                if (x != 0) m->first[b] = least(m->first[b], i), m->after[b] = i + 1;
            }
        m->first[b] = least(m->first[b], m->after[b]);
    }
    return memory + matrix_size(rows, inner);
}

INLINE void add_products(const REAL *numbers, const vec *x, int64_t inner, int64_t vecs, int count, vec *out) {
    vec sums[BLOCK][SPAN];
    memset(sums, 0, sizeof sums);
    for (int64_t i = 0; i < inner; i++, numbers += BLOCK, x += vecs)
#pragma GCC unroll 4
        for (int n = 0; n < BLOCK; n++)
#pragma GCC unroll 6
            for (int v = 0; v < count; v++) sums[n][v] += numbers[n] * x[v];
    for (int n = 0; n < BLOCK; n++)
        for (int v = 0; v < count; v++) out[n * vecs + v] = sums[n][v];
}

// out (padded rows, vecs) = matrix (rows, inner) x (inner, vecs).
static void multiply(const matrix *m, const vec *x, int64_t vecs, vec *out) {
    for (int64_t b = 0; b < m->blocks; b++, out += BLOCK * vecs) {
        const REAL *numbers = m->numbers + (b * m->inner + m->first[b]) * BLOCK;
        const vec *from = x + m->first[b] * vecs;
        const int64_t inner = m->after[b] - m->first[b];
        int64_t v = 0;
        for (; v + SPAN <= vecs; v += SPAN) add_products(numbers, from + v, inner, vecs, SPAN, out + v);
        if (SPAN > 3 && vecs - v >= 3) add_products(numbers, from + v, inner, vecs, 3, out + v), v += 3;
        if (vecs - v == 2) add_products(numbers, from + v, inner, vecs, 2, out + v);
        else if (vecs - v == 1) add_products(numbers, from + v, inner, vecs, 1, out + v);
    }
}

// ---------------------------------------------------------------------- points of a place

// What all depths of a place share.
typedef struct {
    const scattered *s;
    int64_t tall, rows, vecs;         // samples that a patch touches along an axis; padded; vectors of a row of them
    int64_t across, along, beside;    // vectors in a row of the grid, in one of samples, in one of pixels
    int64_t *start;                   // (patches, 2): first row and column that a patch touches
    REAL *row_weights;                // (patches, points, rows)
    vec *column_weights;              // (patches, points, vecs), each number twice
    matrix cosines, sines, cosines_back, sines_back;
    matrix *pixels;                   // (exposures, shifts, 4): columns, rows, and the transposes
    int64_t size;                     // vectors of a desk
    vec *desks;                       // (threads, size)
} work;

// Finds the samples that each patch touches, as many for all. Returns whether they lie in the grid.
static int find_patches(work *w, const double *places) {
    const scattered *s = w->s;
    const double half = (double)s->width / 2;
    w->tall = 0;
    for (int axis = 0; axis < 2; axis++)
        for (int64_t c = 0; c < s->patches; c++) {
            const double *place = places + (axis * s->patches + c) * s->points;
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
            const REAL row = (REAL)(places[i] - (double)w->start[2 * c]);
            const REAL column = (REAL)(places[s->patches * s->points + i] - (double)w->start[2 * c + 1]);
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
    vec *sum, *less;     // (extent / 2, across or along): of mirrored rows, and their difference times -i
    vec *even, *odd;     // (samples / 2, across or along): their transforms
    vec *half;           // (extent, along): columns of the grid, transformed
    vec *light;          // (samples, along): average over states of squared real and imaginary parts
    vec *lines;          // (window, along): light summed to columns of pixels
    vec *turned_lines;   // (samples, beside): the same the other way round
    vec *pixels;         // (window, beside)
    vec *of_light;       // (samples, along): gradient
} desk;

INLINE vec *grid_row(const work *w, vec *grid, int64_t row) { return grid + row * w->across; }

// Adds a patch times a wave to a grid.
INLINE void add_patch(const vec *patch, const vec *turned, int64_t tall, int64_t vecs, REAL re, REAL im, REAL *at, int64_t pitch) {
    for (int64_t r = 0; r < tall; r++, at += pitch, patch += vecs, turned += vecs)
        for (int64_t v = 0; v < vecs; v++) ((loose *)at)[v] += re * patch[v] + im * turned[v];
}

static void fill_grids(const work *w, const desk *d) {
    const scattered *s = w->s;
    const int64_t tall = w->tall, vecs = w->vecs, pitch = w->across * LANES, size = s->extent * pitch;
    memset(d->grids, 0, s->exposures * s->states * size * sizeof(REAL));
    for (int64_t c = 0; c < s->patches; c++) {
        spread(w, d->field, c, d->patch, d->turned);
        REAL *at = (REAL *)d->grids + w->start[2 * c] * pitch + 2 * w->start[2 * c + 1];
        const REAL *wave = s->waves + 2 * s->cell[c];
        for (int64_t k = 0; k < s->exposures * s->states; k++, at += size, wave += 2 * s->cells) {
            if (vecs == 1) add_patch(d->patch, d->turned, tall, 1, wave[0], wave[1], at, pitch);
            else if (vecs == 2) add_patch(d->patch, d->turned, tall, 2, wave[0], wave[1], at, pitch);
            else add_patch(d->patch, d->turned, tall, vecs, wave[0], wave[1], at, pitch);
        }
    }
}

// Transforms the rows of a grid, (extent, vecs), to the even and odd parts of samples, (samples / 2, vecs).
static void transform(const work *w, const vec *grid, int64_t vecs, const desk *d) {
    const int64_t half = w->s->extent / 2;
    for (int64_t i = 0; i < half; i++) {
        const vec *above = grid + (half + i) * vecs, *below = grid + (half - 1 - i) * vecs;
        for (int64_t v = 0; v < vecs; v++) {
            d->sum[i * vecs + v] = above[v] + below[v];
            d->less[i * vecs + v] = times_i(below[v] - above[v]);
        }
    }
    multiply(&w->cosines, d->sum, vecs, d->even);
    multiply(&w->sines, d->less, vecs, d->odd);
}

// The transpose of it, from gradients of the even and odd parts to that of the grid.
static void transform_back(const work *w, vec *grid, int64_t vecs, const desk *d) {
    const int64_t half = w->s->extent / 2;
    multiply(&w->cosines_back, d->even, vecs, d->sum);
    multiply(&w->sines_back, d->odd, vecs, d->less);
    for (int64_t i = 0; i < half; i++)
        for (int64_t v = 0; v < vecs; v++) {
            const vec one = d->sum[i * vecs + v], two = times_i(d->less[i * vecs + v]);
            grid[(half + i) * vecs + v] = one + two;
            grid[(half - 1 - i) * vecs + v] = one - two;
        }
}

// Transforms the grid of a state to the even and odd parts of its samples.
static void transform_state(const work *w, int64_t k, const desk *d) {
    const int64_t half = w->s->samples / 2, extent = w->s->extent;
    transform(w, grid_row(w, d->grids, k * extent), w->across, d);
    for (int64_t n = 0; n < extent; n++) {
        REAL *low = (REAL *)(d->half + n * w->along) + 2 * (half - 1), *high = low + 2;
        const REAL *even = (const REAL *)d->even + 2 * n, *odd = (const REAL *)d->odd + 2 * n;
        for (int64_t j = 0; j < half; j++, low -= 2, high += 2, even += w->across * LANES, odd += w->across * LANES) {
            high[0] = even[0] + odd[0], high[1] = even[1] + odd[1];
            low[0] = even[0] - odd[0], low[1] = even[1] - odd[1];
        }
    }
    transform(w, d->half, w->along, d);
}

static void transform_state_back(const work *w, int64_t k, const desk *d) {
    const int64_t half = w->s->samples / 2, extent = w->s->extent;
    transform_back(w, d->half, w->along, d);
    for (int64_t n = 0; n < extent; n++) {
        const REAL *low = (REAL *)(d->half + n * w->along) + 2 * (half - 1), *high = low + 2;
        REAL *even = (REAL *)d->even + 2 * n, *odd = (REAL *)d->odd + 2 * n;
        for (int64_t j = 0; j < half; j++, low -= 2, high += 2, even += w->across * LANES, odd += w->across * LANES) {
            even[0] = high[0] + low[0], even[1] = high[1] + low[1];
            odd[0] = high[0] - low[0], odd[1] = high[1] - low[1];
        }
    }
    transform_back(w, grid_row(w, d->grids, k * extent), w->across, d);
}

static void add_light(const work *w, REAL weight, const desk *d) {
    const int64_t half = w->s->samples / 2, vecs = w->along;
    for (int64_t j = 0; j < half; j++)
        for (int64_t v = 0; v < vecs; v++) {
            const vec a = d->even[j * vecs + v], b = d->odd[j * vecs + v], high = a + b, low = a - b;
            d->light[(half + j) * vecs + v] += weight * high * high;
            d->light[(half - 1 - j) * vecs + v] += weight * low * low;
        }
}

static void sum_pixels(const work *w, const matrix *pixels, const desk *d, REAL *out) {
    const int64_t window = w->s->window;
    for (int64_t v = 0; v < w->s->shifts; v++, out += window * window) {
        multiply(pixels + 4 * v, d->light, w->along, d->lines);
        for (int64_t p = 0; p < window; p++) {
            const REAL *line = (const REAL *)(d->lines + p * w->along);
            for (int64_t y = 0; y < w->s->samples; y++)
                ((REAL *)(d->turned_lines + y * w->beside))[p] = line[2 * y] + line[2 * y + 1];
        }
        multiply(pixels + 4 * v + 1, d->turned_lines, w->beside, d->pixels);
        for (int64_t q = 0; q < window; q++) memcpy(out + q * window, d->pixels + q * w->beside, window * sizeof(REAL));
    }
}

// The transpose of it, to the gradient of the light.
static void spread_pixels(const work *w, const matrix *pixels, const desk *d, const REAL *gradient) {
    const int64_t window = w->s->window, size = w->s->samples * w->along;
    memset(d->of_light, 0, size * sizeof(vec));
    for (int64_t v = 0; v < w->s->shifts; v++) {
        for (int64_t q = 0; q < window; q++, gradient += window) memcpy(d->pixels + q * w->beside, gradient, window * sizeof(REAL));
        multiply(pixels + 4 * v + 3, d->pixels, w->beside, d->turned_lines);
        for (int64_t p = 0; p < window; p++) {
            REAL *line = (REAL *)(d->lines + p * w->along);
            for (int64_t y = 0; y < w->s->samples; y++)
                line[2 * y] = line[2 * y + 1] = ((const REAL *)(d->turned_lines + y * w->beside))[p];
        }
        multiply(pixels + 4 * v + 2, d->lines, w->along, d->light);
        for (int64_t n = 0; n < size; n++) d->of_light[n] += d->light[n];
    }
}

// Turns even and odd parts into their gradients, and returns that of the state's weight.
static REAL light_gradient(const work *w, REAL weight, const desk *d) {
    const int64_t half = w->s->samples / 2, vecs = w->along;
    vec total = {0};
    for (int64_t j = 0; j < half; j++)
        for (int64_t v = 0; v < vecs; v++) {
            vec *a = d->even + j * vecs + v, *b = d->odd + j * vecs + v, high = *a + *b, low = *a - *b;
            const vec up = d->of_light[(half + j) * vecs + v] * high, down = d->of_light[(half - 1 - j) * vecs + v] * low;
            total += up * high + down * low;
            *a = 2 * weight * (up + down), *b = 2 * weight * (up - down);
        }
    return sum_of(total);
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

// Shares memory out to a thread's desk, and returns the number of vectors that it takes.
static int64_t share_out(const work *w, vec *memory, desk *d) {
    const scattered *s = w->s;
    const int64_t wide = w->across > w->along ? w->across : w->along, half = padded(s->extent / 2, BLOCK) * wide,
                  samples = padded(s->samples, BLOCK), transformed = padded(s->samples / 2, BLOCK) * wide;
    const int64_t sizes[] = {2 * s->patches * s->points / LANES + 3,
                             s->exposures * s->states * s->extent * w->across,
                             w->rows * w->vecs,
                             w->rows * w->vecs,
                             half,
                             half,
                             transformed,
                             transformed,
                             s->extent * w->along,
                             samples * w->along,
                             padded(s->window, BLOCK) * w->along,
                             samples * w->beside,
                             padded(s->window, BLOCK) * w->beside,
                             samples * w->along};
    int64_t at[15] = {0};
    for (int n = 0; n < 14; n++) at[n + 1] = at[n] + sizes[n];
    if (memory)
        *d = (desk){(REAL *)memory,  memory + at[1], memory + at[2], memory + at[3],  memory + at[4],  memory + at[5],  memory + at[6],
                    memory + at[7],  memory + at[8], memory + at[9], memory + at[10], memory + at[11], memory + at[12], memory + at[13]};
    return at[14];
}

// One depth of a place: its light, or the gradients, which are added to `of_waves` and `of_weights`.
static void compute(const work *w, int64_t place, int64_t depth, REAL *of_waves, REAL *of_weights) {
    const scattered *s = w->s;
    desk own, *d = &own;
    const int64_t size = s->shifts * s->window * s->window, out = (place * s->depths + depth) * s->exposures * size;
    share_out(w, w->desks + thread_number() * w->size, d);
    const int64_t rows = 2 + s->phases + s->amplitudes;
    fill_field(s, s->values + (place * rows + 2) * s->patches * s->points, depth, d->field);
    fill_grids(w, d);
    for (int64_t e = 0; e < s->exposures; e++) {
        const matrix *pixels = w->pixels + 4 * e * s->shifts;
        if (s->gradient) spread_pixels(w, pixels, d, s->gradient + out + e * size);
        else memset(d->light, 0, s->samples * w->along * sizeof(vec));
        for (int64_t k = 0; k < s->states; k++) {
            transform_state(w, e * s->states + k, d);
            if (!s->gradient) add_light(w, s->weights[k], d);
            else {
                of_weights[k] += light_gradient(w, s->weights[k], d);
                transform_state_back(w, e * s->states + k, d);
            }
        }
        if (!s->gradient) sum_pixels(w, pixels, d, s->light + out + e * size);
    }
    if (s->gradient) gather_waves(w, d, of_waves);
}

static int compute_place(work *w, int64_t place, char *matrices, REAL *parts) {
    const scattered *s = w->s;
    const int64_t total = s->patches * s->points;
    const double *places = s->values + place * (2 + s->phases + s->amplitudes) * total;
    if (!find_patches(w, places)) return OUTSIDE;
    w->rows = padded(w->tall, ROWS), w->vecs = (2 * w->tall + LANES - 1) / LANES;
    const int64_t most = 2 * (s->extent - w->tall) + w->vecs * LANES;
    w->across = ((most > 2 * s->extent ? most : 2 * s->extent) + LANES - 1) / LANES;
    w->along = (2 * s->samples + LANES - 1) / LANES, w->beside = (s->window + LANES - 1) / LANES;
    w->row_weights = malloc(total * w->rows * sizeof(REAL));
    w->column_weights = aligned_alloc(sizeof(vec), total * w->vecs * sizeof(vec));
    w->size = share_out(w, 0, 0);
    w->desks = aligned_alloc(sizeof(vec), s->threads * w->size * sizeof(vec));
    const int status = w->row_weights && w->column_weights && w->desks ? 0 : NO_MEMORY;
    if (!status) {
        memset(w->desks, 0, s->threads * w->size * sizeof(vec));
        fill_weights(w, places);
        for (int64_t v = 0; v < s->exposures * s->shifts; v++) {
            const int64_t at = (place * s->exposures * s->shifts + v) * s->window * s->samples;
            for (int n = 0; n < 4; n++)
                matrices = lay_out(w->pixels + 4 * v + n, (n % 2 ? s->rows : s->columns) + at, n < 2 ? s->window : s->samples,
                                   n < 2 ? s->samples : s->window, n >= 2, matrices);
        }
        const int64_t waves = 2 * s->exposures * s->states * s->cells, numbers = waves + s->states;
        if (s->gradient) memset(parts, 0, s->depths * numbers * sizeof(REAL));
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
        for (int64_t depth = 0; depth < s->depths; depth++) {
            REAL *own = s->gradient ? parts + depth * numbers : 0;
            compute(w, place, depth, own, s->gradient ? own + waves : 0);
        }
        for (int64_t depth = 0; depth < s->depths && s->gradient; depth++) {
            const REAL *own = parts + depth * numbers;
            for (int64_t n = 0; n < waves; n++) s->of_waves[n] += own[n];
            for (int64_t k = 0; k < s->states; k++) s->of_weights[k] += own[waves + k];
        }
    }
    free(w->row_weights), free(w->column_weights), free(w->desks);
    return status;
}

// The light, or with a gradient of it those of waves and weights. Returns 0, NO_MEMORY, or OUTSIDE where points lie beyond
// the grid.
int scattered_light(const scattered *s) {
    const int64_t half = s->samples / 2, spread = s->extent / 2;
    const int64_t tables = 2 * (matrix_size(half, spread) + matrix_size(spread, half)),
                  pixels = 2 * s->exposures * s->shifts * (matrix_size(s->window, s->samples) + matrix_size(s->samples, s->window));
    work own = {.s = s}, *w = &own;
    char *matrices = malloc(tables + pixels);
    w->start = malloc(2 * s->patches * sizeof(int64_t) + 1);
    w->pixels = malloc(4 * s->exposures * s->shifts * sizeof(matrix) + 1);
    REAL *parts = s->gradient ? malloc(s->depths * s->states * (2 * s->exposures * s->cells + 1) * sizeof(REAL) + 1) : 0;
    int status = matrices && w->start && w->pixels && (parts || !s->gradient) ? 0 : NO_MEMORY;
    if (!status) {
        char *rest = lay_out(&w->cosines, s->cosines, half, spread, 0, matrices);
        rest = lay_out(&w->sines, s->sines, half, spread, 0, rest);
        rest = lay_out(&w->cosines_back, s->cosines, spread, half, 1, rest);
        rest = lay_out(&w->sines_back, s->sines, spread, half, 1, rest);
        for (int64_t place = 0; place < s->places && !status; place++) status = compute_place(w, place, rest, parts);
    }
    free(matrices), free(w->start), free(w->pixels), free(parts);
    return status;
}
