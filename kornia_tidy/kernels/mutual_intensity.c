// PSF energies of partially coherent light by mutual intensity, and the gradient of the field. The formulas are in
// mutual_intensity.py.
//
// For each depth and row of pixels this computes the waves over the pupil's columns, one for each state and quadrature
// point of the row; their mutual intensity J, packed as the sum of real and imaginary part; and the inner product of J
// with the matrix B of each pixel. The intermediate results fit into a core's cache. Rows of planes are padded with zeros
// to whole vectors.
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include "vectors.h"
#include "products.h"

enum { WAVES = 3 };  // vectors of a wave that stay in registers
enum { PIXELS = REGISTERS == 32 ? 4 : VECTOR_BYTES == 32 ? 3 : 2, LINES = BLOCK };  // as many pixels of as many rows
enum { STEP = LANES > 8 ? LANES : 8 };                                              // what rows are padded to

// The fields in mutual_intensity_ops.py: kernels (depths, window, order, cells) and field (states, cells, cells) are complex,
// weights real, energies, which `gradient` is of, (depths, window, window) real.
typedef struct {
    int64_t threads, states, depths, window, order, cells;
    const REAL *field, *weights, *kernels, *gradient;
    REAL *out;
} waves;

// Computes `count` vectors of a wave: the sum over m of x[m] u[m], complex, with a row x of the kernel and the field u.
INLINE void add_wave(const REAL *x, const vec *u, int64_t cells, int64_t vecs, int count, vec *wave) {
    vec a[WAVES] = {0}, b[WAVES] = {0}, c[WAVES] = {0}, e[WAVES] = {0};
    for (int64_t m = 0; m < cells; m++, u += 2 * vecs)
#pragma GCC unroll 3
        for (int i = 0; i < count; i++) {
            a[i] += x[2 * m] * u[i], b[i] += x[2 * m] * u[vecs + i];
            c[i] += x[2 * m + 1] * u[vecs + i], e[i] += x[2 * m + 1] * u[i];
        }
    for (int i = 0; i < count; i++) wave[i] = a[i] - c[i], wave[vecs + i] = b[i] + e[i];
}

// A wave is (2, vecs): real and imaginary part.
static void add_waves(const REAL *x, const vec *u, int64_t cells, int64_t vecs, vec *wave) {
    int64_t v = 0;
    for (; v + WAVES <= vecs; v += WAVES) add_wave(x, u + v, cells, vecs, WAVES, wave + v);
    if (vecs - v == 2) add_wave(x, u + v, cells, vecs, 2, wave + v);
    else if (vecs - v == 1) add_wave(x, u + v, cells, vecs, 1, wave + v);
}

// Computes the light in `count` successive pixels of `lines` rows, LINES at most: the inner products of J with their B.
INLINE void add_light(const vec *intensity, const vec *pixel, int64_t plane, int64_t lines, int count, int64_t window, REAL *light) {
    vec sums[LINES][PIXELS] = {0};
    for (int64_t n = 0; n < plane; n++)
#pragma GCC unroll 4
        for (int p = 0; p < LINES; p++)
#pragma GCC unroll 4
            for (int i = 0; i < count; i++) sums[p][i] += intensity[p * plane + n] * pixel[i * plane + n];
    for (int p = 0; p < lines; p++)
        for (int i = 0; i < count; i++) {
            const REAL sum = sum_of(sums[p][i]);
            light[p * window + i] = sum < 0 ? 0 : sum;  // rounding can make dark pixels negative
        }
}

// What a thread computes a depth in. Rows of planes are `vecs` vectors of `pitch` numbers; a plane has padded rows, of zeros.
typedef struct {
    int64_t vecs, pitch, rows, plane;
    vec *fields;        // of all threads: real and imaginary parts of each row by turns
    vec *left, *right;  // of a row of pixels, (states, order, 2, vecs): waves; the weighted re - im and re + im
    vec *pixels;        // B of all pixels
    vec *intensity;     // J of LINES rows, or its gradients
    // For the gradient only.
    REAL *turned;        // (window, LINES) gradients of energies; a wave, conjugated and times i
    vec *form;           // rows and columns of a gradient of J by turns
    vec *kernel;         // (window, order, 2, vecs)
    vec *gradients[2];   // of all waves, (states, window, order, 2, vecs): real and imaginary; imaginary and negative real
    vec *sums;           // (states, 2, plane): the gradient of the field, real and imaginary
} desk;

static desk take_desk(pool *p, const waves *s, vec *fields) {
    const int64_t vecs = padded(s->cells, STEP) / LANES, rows = padded(s->cells, BLOCK), plane = rows * vecs;
    const int64_t points = s->window * s->order * 2 * vecs, wave = s->states * s->order * 2 * vecs, learns = s->gradient != 0;
    desk d = {vecs, vecs * LANES, rows, plane, .fields = fields};
    d.left = take_zeros(p, wave, sizeof(vec)), d.right = take_zeros(p, wave, sizeof(vec));
    d.pixels = take(p, s->window * plane, sizeof(vec)), d.intensity = take_zeros(p, LINES * plane, sizeof(vec));
    d.turned = take_zeros(p, s->window * LINES + 2 * d.pitch, sizeof(REAL));
    d.form = take_zeros(p, 2 * s->cells * vecs, sizeof(vec));
    d.kernel = take_zeros(p, learns * points, sizeof(vec)), d.sums = take_zeros(p, learns * 2 * s->states * plane, sizeof(vec));
    for (int n = 0; n < 2; n++) d.gradients[n] = take(p, learns * s->states * points, sizeof(vec));
    return d;
}

// Returns the field with real and imaginary parts of each row by turns.
static vec *alternate(pool *p, const waves *s) {
    const int64_t vecs = padded(s->cells, STEP) / LANES;
    REAL *fields = take_zeros(p, 2 * s->states * s->cells * vecs, sizeof(vec));
    for (int64_t m = 0; fields && m < s->states * s->cells; m++)
        for (int part = 0; part < 2; part++)
            for (int64_t n = 0; n < s->cells; n++)
                fields[(m * 2 + part) * vecs * LANES + n] = s->field[(m * s->cells + n) * 2 + part];
    return (vec *)fields;
}

// Computes J or B in packed form: total[n][m] is the sum over rows of left[n] right[m]. Padded rows n are zero.
static void products(const desk *d, const vec *left, const vec *right, int64_t count, vec *total) {
    for (int64_t n = 0; n < d->rows; n += BLOCK)
        multiply_block((const REAL *)left + n, d->pitch, 0, right, d->vecs, count, d->vecs, BLOCK, total + n * d->vecs);
}

// Computes B of a depth's pixels.
static void fill_pixels(const waves *s, const REAL *kernel, const desk *d) {
    memset(d->left, 0, s->order * 2 * d->vecs * sizeof(vec)), memset(d->right, 0, s->order * 2 * d->vecs * sizeof(vec));
    for (int64_t p = 0; p < s->window; p++) {
        for (int64_t q = 0; q < s->order; q++)
            for (int64_t n = 0; n < s->cells; n++) {
                const REAL *x = kernel + ((p * s->order + q) * s->cells + n) * 2;
                REAL *left = (REAL *)(d->left + q * 2 * d->vecs) + n, *right = (REAL *)(d->right + q * 2 * d->vecs) + n;
                left[0] = x[0], left[d->pitch] = x[1], right[0] = x[0] + x[1], right[d->pitch] = x[1] - x[0];
            }
        products(d, d->left, d->right, 2 * s->order, d->pixels + p * d->plane);
    }
}

// Computes the waves of a row of pixels.
static void fill_row(const waves *s, const REAL *kernel, int64_t p, const desk *d) {
    for (int64_t k = 0; k < s->states; k++)
        for (int64_t q = 0; q < s->order; q++) {
            const int64_t at = (k * s->order + q) * 2 * d->vecs;
            vec *re = d->left + at, *im = re + d->vecs, *right = d->right + at;
            add_waves(kernel + (p * s->order + q) * s->cells * 2, d->fields + k * s->cells * 2 * d->vecs, s->cells, d->vecs, re);
            for (int64_t v = 0; v < d->vecs; v++)
                right[v] = s->weights[k] * (re[v] - im[v]), right[d->vecs + v] = s->weights[k] * (re[v] + im[v]);
        }
}

// Computes the energies of a depth.
static void add_depth(const waves *s, int64_t depth, const desk *d) {
    const int64_t window = s->window;
    const REAL *kernel = s->kernels + depth * window * s->order * s->cells * 2;
    fill_pixels(s, kernel, d);
    for (int64_t p = 0; p < window; p += LINES) {
        const int64_t lines = least(LINES, window - p);
        for (int64_t i = 0; i < lines; i++) {
            fill_row(s, kernel, p + i, d);
            products(d, d->left, d->right, 2 * s->states * s->order, d->intensity + i * d->plane);
        }
        REAL *light = s->out + (depth * window + p) * window;
        int64_t x = 0;
        for (; x + PIXELS <= window; x += PIXELS)
            add_light(d->intensity, d->pixels + x * d->plane, d->plane, lines, PIXELS, window, light + x);
        for (; x < window; x++) add_light(d->intensity, d->pixels + x * d->plane, d->plane, lines, 1, window, light + x);
    }
}

// Adds the gradient of the waves of a row, that of J being T: re' = T one + T^t two and im' = T two - T^t one.
static void add_row_gradient(const waves *s, const vec *intensity, int64_t p, const desk *d) {
    REAL *form = (REAL *)d->form;
    for (int64_t m = 0; m < s->cells; m++) {
        memcpy(d->form + 2 * m * d->vecs, intensity + m * d->vecs, d->vecs * sizeof(vec));
        for (int64_t n = 0; n < s->cells; n++) form[(2 * m + 1) * d->pitch + n] = ((const REAL *)intensity)[n * d->pitch + m];
    }
    for (int64_t k = 0; k < s->states; k++)
        for (int64_t q = 0; q < s->order; q++) {
            const REAL *one = (const REAL *)(d->right + (k * s->order + q) * 2 * d->vecs);
            const int64_t at = ((k * s->window + p) * s->order + q) * 2 * d->vecs;
            vec *wave = d->gradients[0] + at, *turned = d->gradients[1] + at;
            for (int64_t n = 0; n < s->cells; n++) d->turned[2 * n] = one[d->pitch + n], d->turned[2 * n + 1] = -one[n];
            add_waves(d->turned, d->form, s->cells, d->vecs, wave);
            for (int64_t v = 0; v < d->vecs; v++) turned[v] = wave[d->vecs + v], turned[d->vecs + v] = -wave[v];
        }
}

// Adds the gradient of a depth to the sums.
static void add_depth_gradient(const waves *s, int64_t depth, const desk *d) {
    const int64_t window = s->window, points = window * s->order;
    const REAL *kernel = s->kernels + depth * points * s->cells * 2, *gradient = s->gradient + depth * window * window;
    fill_pixels(s, kernel, d);
    for (int64_t p = 0; p < window; p += LINES) {
        const int64_t lines = least(LINES, window - p);
        for (int64_t x = 0; x < window; x++)
            for (int64_t i = 0; i < lines; i++) d->turned[x * LINES + i] = gradient[(p + i) * window + x];
        multiply_block(d->turned, LINES, 0, d->pixels, d->plane, window, d->plane, BLOCK, d->intensity);
        for (int64_t i = 0; i < lines; i++) {
            fill_row(s, kernel, p + i, d);
            add_row_gradient(s, d->intensity + i * d->plane, p + i, d);
        }
    }
    for (int64_t w = 0; w < points; w++)
        for (int64_t n = 0; n < 2 * s->cells; n++)
            ((REAL *)(d->kernel + w * 2 * d->vecs))[n % 2 * d->pitch + n / 2] = kernel[w * s->cells * 2 + n];
    for (int64_t k = 0; k < s->states; k++)
        for (int part = 0; part < 2; part++) {
            vec *sums = d->sums + (2 * k + part) * d->plane;
            products(d, d->kernel, d->gradients[part] + k * points * 2 * d->vecs, 2 * points, d->intensity);
            for (int64_t n = 0; n < d->plane; n++) sums[n] += d->intensity[n];
        }
}

// Computes the energies. Returns 0 or NO_MEMORY.
int mutual_energies(const waves *s) {
    pool p = {0};
    vec *fields = alternate(&p, s);
    desk desks[s->threads];
    for (int64_t n = 0; n < s->threads; n++) desks[n] = take_desk(&p, s, fields);
    const int64_t depths = p.missing ? 0 : s->depths;
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
    for (int64_t n = 0; n < depths; n++) add_depth(s, n, desks + thread_number());
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}

// The gradient of the field, complex like it, from that of the energies. Depths are summed in slabs, one for each thread.
// Returns 0 or NO_MEMORY.
int mutual_field_gradient(const waves *s) {
    pool p = {0};
    vec *fields = alternate(&p, s);
    const int64_t slabs = s->depths ? least(s->threads, s->depths) : 1, cells = s->cells;
    desk desks[s->threads];
    for (int64_t n = 0; n < slabs; n++) desks[n] = take_desk(&p, s, fields);
    const int64_t some = p.missing ? 0 : slabs;
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
    for (int64_t slab = 0; slab < some; slab++)
        for (int64_t n = s->depths * slab / slabs; n < s->depths * (slab + 1) / slabs; n++) add_depth_gradient(s, n, desks + slab);
    for (int64_t m = 0; !p.missing && m < s->states * cells * cells * 2; m++) {
        const int64_t n = m / 2, row = (n / cells / cells * 2 + m % 2) * desks->rows + n / cells % cells;
        s->out[m] = 0;
        for (int64_t slab = 0; slab < slabs; slab++) s->out[m] += ((const REAL *)desks[slab].sums)[row * desks->pitch + n % cells];
    }
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}
