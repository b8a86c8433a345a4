// PSF energies of partially coherent light by mutual intensity, and the gradient of the field. The formulas are in
// mutual_intensity.py.
//
// For each depth and row of pixels this computes the waves over the pupil's columns, one for each state and quadrature
// point of the row; their mutual intensity J, packed as the sum of real and imaginary part; and the inner product of J
// with the matrix B of each pixel. The intermediate results fit into a core's cache. Rows of planes are padded with zeros
// to whole vectors.
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include <stdlib.h>

#include "vectors.h"

enum { BLOCK = REGISTERS == 32 ? 8 : 4, SPAN = 3 };    // rows of J and vectors of each that stay in registers
enum { PIXELS = REGISTERS == 32 ? 4 : VECTOR_BYTES == 32 ? 3 : 2, LINES = 4 }; // as many pixels, or vectors of B, of as many rows of pixels
enum { STEP = LANES > 8 ? LANES : 8 };                 // what rows are padded to

// Computes `count` vectors of a wave: the sum over m of x[m] u[m], complex, with a row x of the kernel and the field u.
INLINE void add_wave(const REAL *x, const vec *u, int64_t cells, int64_t vecs, int count, vec *re, vec *im) {
    vec a[SPAN] = {0}, b[SPAN] = {0}, c[SPAN] = {0}, e[SPAN] = {0};
    for (int64_t m = 0; m < cells; m++, u += 2 * vecs)
#pragma GCC unroll 3
        for (int i = 0; i < count; i++) {
            a[i] += x[2 * m] * u[i], b[i] += x[2 * m] * u[vecs + i];
            c[i] += x[2 * m + 1] * u[vecs + i], e[i] += x[2 * m + 1] * u[i];
        }
    for (int i = 0; i < count; i++) re[i] = a[i] - c[i], im[i] = b[i] + e[i];
}

static void add_waves(const REAL *x, const vec *u, int64_t cells, int64_t vecs, vec *re, vec *im) {
    int64_t v = 0;
    for (; v + SPAN <= vecs; v += SPAN) add_wave(x, u + v, cells, vecs, SPAN, re + v, im + v);
    if (vecs - v == 2) add_wave(x, u + v, cells, vecs, 2, re + v, im + v);
    else if (vecs - v == 1) add_wave(x, u + v, cells, vecs, 1, re + v, im + v);
}

// Computes the light in `count` successive pixels of `lines` rows: the inner products of J with their matrices B.
INLINE void add_light(const vec *intensity, const vec *pixel, int64_t plane, int lines, int count, int64_t window, REAL *light) {
    vec sums[LINES][PIXELS];
    memset(sums, 0, sizeof sums);
    for (int64_t n = 0; n < plane; n++)
#pragma GCC unroll 4
        for (int p = 0; p < lines; p++)
#pragma GCC unroll 4
            for (int i = 0; i < count; i++) sums[p][i] += intensity[p * plane + n] * pixel[i * plane + n];
    for (int p = 0; p < lines; p++)
        for (int i = 0; i < count; i++) {
            const REAL sum = sum_of(sums[p][i]);
            light[p * window + i] = sum < 0 ? 0 : sum;  // rounding can make dark pixels negative
        }
}

INLINE void add_lines(const vec *intensity, const vec *pixels, int64_t plane, int lines, int64_t window, REAL *light) {
    int64_t s = 0;
    for (; s + PIXELS <= window; s += PIXELS) add_light(intensity, pixels + s * plane, plane, lines, PIXELS, window, light + s);
    for (; s < window; s++) add_light(intensity, pixels + s * plane, plane, lines, 1, window, light + s);
}

INLINE void add_products(const vec *re, const vec *im, const vec *one, const vec *two, int64_t waves, int64_t vecs,
                         int64_t first, int count, vec *total) {
    vec sums[BLOCK][SPAN];
    memset(sums, 0, sizeof sums);
    for (int64_t w = 0; w < waves * vecs; w += vecs) {
        const REAL *a = (const REAL *)(re + w) + first, *b = (const REAL *)(im + w) + first;
#pragma GCC unroll 8
        for (int n = 0; n < BLOCK; n++)
#pragma GCC unroll 3
            for (int i = 0; i < count; i++) {
                sums[n][i] += a[n] * one[w + i];
                sums[n][i] += b[n] * two[w + i];
            }
    }
    for (int n = 0; n < BLOCK; n++)
        for (int i = 0; i < count; i++) total[(first + n) * vecs + i] = sums[n][i];
}

// Computes J or B in packed form: total[n][m] is the sum over waves of re[n] one[m] + im[n] two[m]. Padded rows n are zero.
static void products(const vec *re, const vec *im, const vec *one, const vec *two, int64_t waves, int64_t rows,
                     int64_t vecs, vec *total) {
    for (int64_t n = 0; n < rows; n += BLOCK) {
        int64_t m = 0;
        for (; m + SPAN <= vecs; m += SPAN) add_products(re, im, one + m, two + m, waves, vecs, n, SPAN, total + m);
        if (vecs - m == 2) add_products(re, im, one + m, two + m, waves, vecs, n, 2, total + m);
        else if (vecs - m == 1) add_products(re, im, one + m, two + m, waves, vecs, n, 1, total + m);
    }
}

INLINE void add_pixel_part(const vec *pixels, const REAL *gradient, int64_t window, int64_t plane, int lines, int count,
                           vec *total) {
    vec sums[LINES][PIXELS];
    memset(sums, 0, sizeof sums);
    for (int64_t s = 0; s < window; s++)
#pragma GCC unroll 4
        for (int p = 0; p < lines; p++)
#pragma GCC unroll 4
            for (int i = 0; i < count; i++) sums[p][i] += gradient[p * window + s] * pixels[s * plane + i];
    for (int p = 0; p < lines; p++)
        for (int i = 0; i < count; i++) total[p * plane + i] = sums[p][i];
}

// Sums B over pixels with `lines` rows of weights: gradients of J.
INLINE void add_pixels(const vec *pixels, const REAL *gradient, int64_t window, int64_t plane, int lines, vec *total) {
    int64_t n = 0;
    for (; n + PIXELS <= plane; n += PIXELS)
        add_pixel_part(pixels + n, gradient, window, plane, lines, PIXELS, total + n);
    for (; n < plane; n++) add_pixel_part(pixels + n, gradient, window, plane, lines, 1, total + n);
}

// The fields in mutual_intensity_ops.py: kernels (depths, window, order, cells) and field (states, cells, cells) are complex,
// weights real, energies, which `gradient` is of, (depths, window, window) real.
typedef struct {
    int64_t threads, states, depths, window, order, cells;
    const REAL *field, *weights, *kernels, *gradient;
    REAL *out;
} waves;

// The sizes of one call. Rows of planes are `vecs` vectors of `pitch` numbers.
typedef struct {
    const REAL *weights;
    int64_t states, depths, window, order, cells, vecs, pitch, waves, rows, plane;
} sizes;

static sizes sizes_of(const waves *s) {
    const int64_t vecs = (s->cells + STEP - 1) / STEP * (STEP / LANES), rows = (s->cells + BLOCK - 1) / BLOCK * BLOCK;
    return (sizes){s->weights, s->states, s->depths, s->window, s->order, s->cells, vecs, vecs * LANES, s->states * s->order, rows, rows * vecs};
}

// Returns the field with real and imaginary parts of each row by turns, to be freed, or null.
static vec *alternate(const sizes *z, const REAL *field) {
    size_t numbers = 2 * z->states * z->cells * z->vecs;
    vec *fields = aligned_alloc(sizeof(vec), numbers * sizeof(vec));
    if (!fields) return 0;
    memset(fields, 0, numbers * sizeof(vec));
    for (int64_t m = 0; m < z->states * z->cells; m++)
        for (int part = 0; part < 2; part++)
            for (int64_t n = 0; n < z->cells; n++)
                ((REAL *)fields)[(m * 2 + part) * z->pitch + n] = field[(m * z->cells + n) * 2 + part];
    return fields;
}

// Waves over the pupil's columns, (waves, vecs) each: real and imaginary parts, and the weighted re - im and re + im.
typedef struct {
    vec *re, *im, *one, *two;
} row;

// Computes B of a depth's pixels.
static void fill_pixels(const sizes *z, const REAL *kernel, row r, vec *pixels) {
    for (int64_t p = 0; p < z->window; p++) {
        memset(r.re, 0, 4 * z->waves * z->vecs * sizeof(vec));
        for (int64_t q = 0; q < z->order; q++)
            for (int64_t n = 0; n < z->cells; n++) {
                const REAL *x = kernel + ((p * z->order + q) * z->cells + n) * 2;
                int64_t at = q * z->pitch + n;
                ((REAL *)r.re)[at] = x[0], ((REAL *)r.im)[at] = x[1];
                ((REAL *)r.one)[at] = x[0] + x[1], ((REAL *)r.two)[at] = x[1] - x[0];
            }
        products(r.re, r.im, r.one, r.two, z->order, z->rows, z->vecs, pixels + p * z->plane);
    }
}

// Computes the waves of a row of pixels.
static void fill_row(const sizes *z, const vec *fields, const REAL *kernel, int64_t p, row r) {
    for (int64_t k = 0; k < z->states; k++)
        for (int64_t q = 0; q < z->order; q++) {
            const REAL *x = kernel + (p * z->order + q) * z->cells * 2;
            const vec *u = fields + k * z->cells * 2 * z->vecs;
            const int64_t at = (k * z->order + q) * z->vecs;
            add_waves(x, u, z->cells, z->vecs, r.re + at, r.im + at);
            for (int64_t v = at; v < at + z->vecs; v++)
                r.one[v] = z->weights[k] * (r.re[v] - r.im[v]), r.two[v] = z->weights[k] * (r.re[v] + r.im[v]);
        }
}

// Computes the energies. Returns 0 or NO_MEMORY.
int mutual_energies(const waves *s) {
    const sizes all = sizes_of(s), *z = &all;
    const int64_t window = s->window;
    vec *fields = alternate(z, s->field);
    if (!fields) return NO_MEMORY;
    int failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
    for (int64_t d = 0; d < s->depths; d++) {
        int64_t part = z->waves * z->vecs;
        vec *memory = aligned_alloc(sizeof(vec), (4 * part + (window + LINES) * z->plane) * sizeof(vec));
        if (!memory) {
#pragma omp atomic write
            failed = NO_MEMORY;
            continue;
        }
        row r = {memory, memory + part, memory + 2 * part, memory + 3 * part};
        vec *intensity = memory + 4 * part, *pixels = intensity + LINES * z->plane;
        const REAL *kernel = s->kernels + d * window * s->order * s->cells * 2;
        fill_pixels(z, kernel, r, pixels);
        for (int64_t p = 0, lines; p < window; p += lines) {
            lines = p + LINES <= window ? LINES : 1;
            for (int64_t i = 0; i < lines; i++) {
                fill_row(z, fields, kernel, p + i, r);
                products(r.re, r.im, r.one, r.two, z->waves, z->rows, z->vecs, intensity + i * z->plane);
            }
            REAL *light = s->out + (d * window + p) * window;
            if (lines == LINES) add_lines(intensity, pixels, z->plane, LINES, window, light);
            else add_lines(intensity, pixels, z->plane, 1, window, light);
        }
        free(memory);
    }
    free(fields);
    return failed;
}

// Buffers of a thread for the gradient of a depth.
typedef struct {
    row r;
    vec *pixels, *intensity;  // B of all pixels; gradients of J of four rows
    vec *form;                // rows and columns of one of them by turns
    REAL *turned;             // a wave, conjugated and times i
    vec *re, *im, *less;      // gradients of all waves, (states, window * order, vecs): real, imaginary, negative real
    vec *left, *right;        // kernels, (window * order, vecs): real and imaginary
    vec *sums;                // (states, 2, plane): the gradient of the field, real and imaginary
} desk;

// Adds the gradient of the waves of a row, that of J being T: re' = T one + T^t two and im' = T two - T^t one.
static void add_row_gradient(const sizes *z, const vec *intensity, int64_t p, const desk *d) {
    REAL *form = (REAL *)d->form;
    for (int64_t m = 0; m < z->cells; m++) {
        memcpy(d->form + 2 * m * z->vecs, intensity + m * z->vecs, z->vecs * sizeof(vec));
        for (int64_t n = 0; n < z->cells; n++) form[(2 * m + 1) * z->pitch + n] = ((const REAL *)intensity)[n * z->pitch + m];
    }
    for (int64_t k = 0; k < z->states; k++)
        for (int64_t q = 0; q < z->order; q++) {
            const int64_t from = (k * z->order + q) * z->vecs, at = ((k * z->window + p) * z->order + q) * z->vecs;
            for (int64_t n = 0; n < z->cells; n++) {
                d->turned[2 * n] = ((const REAL *)(d->r.two + from))[n];
                d->turned[2 * n + 1] = -((const REAL *)(d->r.one + from))[n];
            }
            add_waves(d->turned, d->form, z->cells, z->vecs, d->re + at, d->im + at);
            for (int64_t v = at; v < at + z->vecs; v++) d->less[v] = -d->re[v];
        }
}

// Adds the gradient of a depth to the sums.
static void add_depth_gradient(const sizes *z, const vec *fields, const REAL *kernel, const REAL *gradient, const desk *d) {
    fill_pixels(z, kernel, d->r, d->pixels);
    for (int64_t p = 0, lines; p < z->window; p += lines) {
        lines = p + LINES <= z->window ? LINES : 1;
        if (lines == LINES) add_pixels(d->pixels, gradient + p * z->window, z->window, z->plane, LINES, d->intensity);
        else add_pixels(d->pixels, gradient + p * z->window, z->window, z->plane, 1, d->intensity);
        for (int64_t i = 0; i < lines; i++) {
            fill_row(z, fields, kernel, p + i, d->r);
            add_row_gradient(z, d->intensity + i * z->plane, p + i, d);
        }
    }
    int64_t points = z->window * z->order;
    for (int64_t w = 0; w < points; w++)
        for (int64_t n = 0; n < z->cells; n++) {
            ((REAL *)(d->left + w * z->vecs))[n] = kernel[(w * z->cells + n) * 2];
            ((REAL *)(d->right + w * z->vecs))[n] = kernel[(w * z->cells + n) * 2 + 1];
        }
    for (int64_t k = 0; k < z->states; k++) {
        const vec *re = d->re + k * points * z->vecs, *im = d->im + k * points * z->vecs, *less = d->less + k * points * z->vecs;
        for (int part = 0; part < 2; part++) {
            vec *sums = d->sums + (2 * k + part) * z->plane;
            products(d->left, d->right, part ? im : re, part ? less : im, points, z->rows, z->vecs, d->intensity);
            for (int64_t n = 0; n < z->plane; n++) sums[n] += d->intensity[n];
        }
    }
}

// The gradient of the field, complex like it, from that of the energies. Depths are summed in slabs, one for each thread.
// Returns 0 or NO_MEMORY.
int mutual_field_gradient(const waves *s) {
    const sizes all = sizes_of(s), *z = &all;
    const int64_t states = s->states, depths = s->depths, window = s->window, order = s->order, cells = s->cells, threads = s->threads;
    REAL *out = s->out;
    const int64_t slabs = least(threads, depths), part = z->waves * z->vecs, points = window * order * z->vecs;
    const int64_t each[] = {4 * part, window * z->plane, LINES * z->plane, 2 * cells * z->vecs, 2 * z->vecs,
                            3 * states * points, 2 * points, 2 * states * z->plane};
    int64_t size = 0;
    for (int n = 0; n < 8; n++) size += each[n];
    vec *fields = alternate(z, s->field), *memory = aligned_alloc(sizeof(vec), (slabs * size + 1) * sizeof(vec));
    if (fields && memory) {
        memset(memory, 0, slabs * size * sizeof(vec));
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int64_t slab = 0; slab < slabs; slab++) {
            vec *at[8] = {memory + slab * size};
            for (int n = 1; n < 8; n++) at[n] = at[n - 1] + each[n - 1];
            desk d = {{at[0], at[0] + part, at[0] + 2 * part, at[0] + 3 * part}, at[1], at[2], at[3], (REAL *)at[4], at[5],
                      at[5] + states * points, at[5] + 2 * states * points, at[6], at[6] + points, at[7]};
            for (int64_t n = depths * slab / slabs; n < depths * (slab + 1) / slabs; n++)
                add_depth_gradient(z, fields, s->kernels + n * window * order * cells * 2, s->gradient + n * window * window, &d);
        }
        for (int64_t m = 0; m < states * cells * cells * 2; m++) {
            int64_t n = m / 2, plane = (n / cells / cells * 2 + m % 2) * z->plane;
            int64_t place = (size - each[7] + plane) * LANES + n / cells % cells * z->pitch + n % cells;
            out[m] = 0;
            for (int64_t slab = 0; slab < slabs; slab++) out[m] += ((const REAL *)(memory + slab * size))[place];
        }
    }
    const int failed = fields && memory ? 0 : NO_MEMORY;
    free(fields), free(memory);
    return failed;
}
