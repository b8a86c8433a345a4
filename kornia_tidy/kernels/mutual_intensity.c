// PSF energies of partially coherent light by mutual intensity, without gradients. The formulas are in
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

enum { BLOCK = 8, STEP = LANES > BLOCK ? LANES : BLOCK };  // rows of J that stay in registers, and what rows are padded to

// Computes `count` vectors of a wave: the sum over m of x[m] u[m], complex, with a row x of the kernel and the field u.
INLINE void add_wave(const REAL *x, const vec *u, int64_t cells, int64_t vecs, int count, vec *re, vec *im) {
    vec a[2] = {0}, b[2] = {0}, c[2] = {0}, e[2] = {0};
    for (int64_t m = 0; m < cells; m++, u += 2 * vecs)
#pragma GCC unroll 2
        for (int i = 0; i < count; i++) {
            a[i] += x[2 * m] * u[i], b[i] += x[2 * m] * u[vecs + i];
            c[i] += x[2 * m + 1] * u[vecs + i], e[i] += x[2 * m + 1] * u[i];
        }
    for (int i = 0; i < count; i++) re[i] = a[i] - c[i], im[i] = b[i] + e[i];
}

// Computes the light in `count` successive pixels: the inner products of J with their matrices B.
INLINE void add_light(const vec *intensity, const vec *pixel, int64_t plane, int count, REAL *light) {
    vec sums[4][2];
    memset(sums, 0, sizeof sums);
    int64_t n = 0;
    for (; n + 2 <= plane; n += 2)
#pragma GCC unroll 4
        for (int i = 0; i < count; i++) {
            sums[i][0] += intensity[n] * pixel[i * plane + n];
            sums[i][1] += intensity[n + 1] * pixel[i * plane + n + 1];
        }
    for (int i = 0; n < plane && i < count; i++) sums[i][0] += intensity[n] * pixel[i * plane + n];
    for (int i = 0; i < count; i++) {
        light[i] = sum_of(sums[i][0] + sums[i][1]);
        if (light[i] < 0) light[i] = 0;  // rounding can make dark pixels negative
    }
}

// Computes J or B in packed form: total[n][m] is the sum over waves of re[n] one[m] + im[n] two[m]. Padded rows n are zero.
static void products(const vec *re, const vec *im, const vec *one, const vec *two, int64_t waves, int64_t rows,
                     int64_t vecs, vec *total) {
    for (int64_t first = 0; first < rows; first += BLOCK)
        for (int64_t m = 0; m < vecs; m++) {
            vec sums[BLOCK];
            memset(sums, 0, sizeof sums);
            for (int64_t w = 0; w < waves; w++) {
                const REAL *a = (const REAL *)(re + w * vecs) + first, *b = (const REAL *)(im + w * vecs) + first;
                vec x = one[w * vecs + m], y = two[w * vecs + m];
#pragma GCC unroll 8
                for (int n = 0; n < BLOCK; n++) sums[n] += a[n] * x + b[n] * y;
            }
            for (int n = 0; n < BLOCK; n++) total[(first + n) * vecs + m] = sums[n];
        }
}

// kernels (depths, window, order, cells) and field (states, cells, cells) are complex, weights real, energies
// (depths, window, window) real. Returns 0, or 1 if there is no memory.
int mutual_energies(const REAL *field, const REAL *weights, const REAL *kernels, REAL *energies, int64_t states,
                    int64_t depths, int64_t window, int64_t order, int64_t cells, int64_t threads) {
    int64_t vecs = (cells + STEP - 1) / STEP * (STEP / LANES), pitch = vecs * LANES, waves = states * order;
    int64_t rows = (cells + BLOCK - 1) / BLOCK * BLOCK, plane = rows * vecs;
    size_t numbers = 2 * states * cells * vecs;
    vec *fields = aligned_alloc(sizeof(vec), numbers * sizeof(vec));
    if (!fields) return 1;
    memset(fields, 0, numbers * sizeof(vec));
    for (int64_t k = 0; k < states; k++)  // the real and the imaginary part of each row alternate
        for (int64_t m = 0; m < cells; m++)
            for (int part = 0; part < 2; part++)
                for (int64_t n = 0; n < cells; n++)
                    ((REAL *)fields)[((k * cells + m) * 2 + part) * pitch + n] = field[((k * cells + m) * cells + n) * 2 + part];
    int failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int64_t d = 0; d < depths; d++) {
        vec *memory = aligned_alloc(sizeof(vec), (4 * waves * vecs + (window + 1) * plane) * sizeof(vec));
        if (!memory) {
#pragma omp atomic write
            failed = 1;
            continue;
        }
        vec *re = memory, *im = re + waves * vecs, *one = im + waves * vecs, *two = one + waves * vecs;
        vec *intensity = two + waves * vecs, *pixels = intensity + plane;
        const REAL *kernel = kernels + d * window * order * cells * 2;
        for (int64_t p = 0; p < window; p++) {
            memset(memory, 0, 4 * waves * vecs * sizeof(vec));
            for (int64_t q = 0; q < order; q++)
                for (int64_t n = 0; n < cells; n++) {
                    REAL a = kernel[((p * order + q) * cells + n) * 2], b = kernel[((p * order + q) * cells + n) * 2 + 1];
                    ((REAL *)re)[q * pitch + n] = a, ((REAL *)im)[q * pitch + n] = b;
                    ((REAL *)one)[q * pitch + n] = a + b, ((REAL *)two)[q * pitch + n] = b - a;
                }
            products(re, im, one, two, order, rows, vecs, pixels + p * plane);
        }
        for (int64_t p = 0; p < window; p++) {
            for (int64_t k = 0; k < states; k++)
                for (int64_t q = 0; q < order; q++) {
                    const REAL *x = kernel + (p * order + q) * cells * 2;
                    const vec *u = fields + k * cells * 2 * vecs;
                    int64_t at = (k * order + q) * vecs, v = 0;
                    for (; v + 2 <= vecs; v += 2) add_wave(x, u + v, cells, vecs, 2, re + at + v, im + at + v);
                    for (; v < vecs; v++) add_wave(x, u + v, cells, vecs, 1, re + at + v, im + at + v);
                    for (v = at; v < at + vecs; v++)
                        one[v] = weights[k] * (re[v] - im[v]), two[v] = weights[k] * (re[v] + im[v]);
                }
            products(re, im, one, two, waves, rows, vecs, intensity);
            REAL *light = energies + (d * window + p) * window;
            int64_t s = 0;
            for (; s + 4 <= window; s += 4) add_light(intensity, pixels + s * plane, plane, 4, light + s);
            for (; s < window; s++) add_light(intensity, pixels + s * plane, plane, 1, light + s);
        }
        free(memory);
    }
    free(fields);
    return failed;
}
