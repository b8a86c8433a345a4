// Convolution by transforms of windows that overlap, each with the PSFs of the layers in its tile and with no other:
// overlap-save for gather, overlap-add for scatter, its transpose, and the gradient of both with respect to the PSFs.
//
// A window of rows x columns samples holds a tile of (rows - side + 1) x (columns - side + 1) pixels. It is transformed as
// half as many complex samples: column j is a real part, column j + columns / 2 its imaginary part, and column j is turned
// by exp(i pi j / columns). That diagonalises a convolution whose light changes its sign where it wraps around from right
// to left (right-angle convolution; Nussbaumer 1981); what wraps around is not used. So no sample is lost to symmetry.
//
// LANES columns are transformed side by side, one in each lane, then LANES rows, all in the processor's cache. Forward
// transforms decimate in frequency and backward ones in time, so that frequencies stay in the order they fall out in.
//
// Layers are given as in scene.py: a pixel belongs to layer `index` or, with the weight `weight`, to the next one.
//
// PSFs may vary over the field, see field.h and below, "tiles".
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include <math.h>

#include "vectors.h"
#include "field.h"

enum { STAGES = 20 };        // of a transform of up to 3^20 samples: no stage has fewer than three
enum { OUTSIDE = -2 };       // label of a sample that is no pixel of the tile: no layer, nor the one before the first

typedef struct {
    vec re, im;
} wave;

// The fields of `_fill` in overlap_ops.py. Strides count elements; width and height are those of the labelled pixels.
typedef struct {
    int64_t threads, images, channels, height, width, layers, side;
    int64_t rows, columns;         // samples of a window: multiples of LANES and of 2 * LANES, products of 2, 3 and 5
    int64_t origin;                // row and column of a window at which its tile begins: 0 or side - 1
    int64_t correlate;             // 1: with PSFs flipped by 180 degrees
    int64_t weight_gradient;       // 0: blend by weights; 1: the next layer less the pixel's own
    const REAL *plane;             // (images, channels, height + side - 1, width + side - 1); not for scatter
    int64_t plane_image, plane_channel, plane_row;
    const REAL *pixels;            // (images, channels, height, width); not for gather
    int64_t pixels_image, pixels_channel, pixels_row;
    const int64_t *index;          // (images, height, width)
    int64_t index_image, index_row;
    const REAL *weight;            // like index, or null
    int64_t weight_image, weight_row;
    const REAL *psfs;              // (layers, channels, side, side); not for the gradient of the PSFs
    REAL *out;                     // gather: as pixels; scatter: as the plane, zeros; gradient: as the PSFs, zeros
    field over;                    // psfs with nodes: (node_rows, node_columns, layers, channels, side, side)
} tiles;

// One stage of a transform: `length` samples are cut into `radix` interleaved ones.
typedef struct {
    int32_t radix, length;
    const REAL *turns;  // (length / radix, radix - 1) complex: exp(-2 pi i j q / length)
} stage;

typedef struct {
    int64_t length;
    int count;
    stage stages[STAGES];
} transform;

INLINE wave turned(wave x, REAL re, REAL im) { return (wave){x.re * re - x.im * im, x.re * im + x.im * re}; }
INLINE wave sum(wave a, wave b) { return (wave){a.re + b.re, a.im + b.im}; }
INLINE wave difference(wave a, wave b) { return (wave){a.re - b.re, a.im - b.im}; }

// The transform of four samples; `sign` is that of the exponent.
INLINE void four(wave *x, const REAL sign) {
    wave a = sum(x[0], x[2]), b = difference(x[0], x[2]), c = sum(x[1], x[3]);
    wave e = difference(x[1], x[3]);
    wave d = sign > 0 ? (wave){-e.im, e.re} : (wave){e.im, -e.re};
    x[0] = sum(a, c);
    x[1] = sum(b, d);
    x[2] = difference(a, c);
    x[3] = difference(b, d);
}

// The transform of 3, 4, 5 or 8 samples.
INLINE void few(wave *x, int radix, const REAL sign) {
    if (radix == 4) {
        four(x, sign);
    } else if (radix == 8) {
        const REAL c = (REAL)0.70710678118654752440;
        wave e[4] = {x[0], x[2], x[4], x[6]}, o[4] = {x[1], x[3], x[5], x[7]};
        four(e, sign), four(o, sign);
        o[1] = (wave){c * (o[1].re - sign * o[1].im), c * (o[1].im + sign * o[1].re)};
        o[2] = sign > 0 ? (wave){-o[2].im, o[2].re} : (wave){o[2].im, -o[2].re};
        o[3] = (wave){-c * (o[3].re + sign * o[3].im), c * (sign * o[3].re - o[3].im)};
#pragma GCC unroll 4
        for (int q = 0; q < 4; q++) x[q] = sum(e[q], o[q]), x[q + 4] = difference(e[q], o[q]);
    } else if (radix == 3) {
        const REAL s = sign * (REAL)0.86602540378443864676;
        wave a = sum(x[1], x[2]), e = difference(x[1], x[2]);
        wave b = {x[0].re - (REAL)0.5 * a.re, x[0].im - (REAL)0.5 * a.im};
        wave d = {-s * e.im, s * e.re};
        x[0] = sum(x[0], a);
        x[1] = sum(b, d);
        x[2] = difference(b, d);
    } else {
        const REAL c1 = (REAL)0.30901699437494742410, c2 = (REAL)-0.80901699437494742410;
        const REAL s1 = sign * (REAL)0.95105651629515357212, s2 = sign * (REAL)0.58778525229247312917;
        wave a = sum(x[1], x[4]), b = sum(x[2], x[3]), d = difference(x[1], x[4]), e = difference(x[2], x[3]);
        wave p = {x[0].re + c1 * a.re + c2 * b.re, x[0].im + c1 * a.im + c2 * b.im};
        wave q = {x[0].re + c2 * a.re + c1 * b.re, x[0].im + c2 * a.im + c1 * b.im};
        wave u = {-(s1 * d.im + s2 * e.im), s1 * d.re + s2 * e.re};
        wave v = {-(s2 * d.im - s1 * e.im), s2 * d.re - s1 * e.re};
        x[0] = sum(x[0], sum(a, b));
        x[1] = sum(p, u);
        x[4] = difference(p, u);
        x[2] = sum(q, v);
        x[3] = difference(q, v);
    }
}

// One place in each sequence of a stage: turns the samples after the forward transform, before the backward one. Without
// `turn` its factors are one.
INLINE void butterflies(wave *x, int64_t n, const stage *s, int radix, const REAL sign, int64_t j, const REAL *turn) {
    const int64_t step = s->length / radix;
    for (int64_t b = j; b < n; b += s->length) {
        wave y[8];
#pragma GCC unroll 8
        for (int q = 0; q < radix; q++) {
            y[q] = x[b + q * step];
            if (sign > 0 && turn && q) y[q] = turned(y[q], turn[2 * q - 2], -turn[2 * q - 1]);
        }
        few(y, radix, sign);
#pragma GCC unroll 8
        for (int q = 0; q < radix; q++)
            x[b + q * step] = sign < 0 && turn && q ? turned(y[q], turn[2 * q - 2], turn[2 * q - 1]) : y[q];
    }
}

INLINE void run_stage(wave *x, int64_t n, const stage *s, int radix, const REAL sign) {
    butterflies(x, n, s, radix, sign, 0, 0);
    for (int64_t j = 1; j < s->length / radix; j++) butterflies(x, n, s, radix, sign, j, s->turns + 2 * j * (radix - 1));
}

INLINE void transformed(wave *x, const transform *t, const REAL sign) {
    for (int i = 0; i < t->count; i++) {
        const stage *s = t->stages + (sign < 0 ? i : t->count - 1 - i);
        if (s->radix == 4) run_stage(x, t->length, s, 4, sign);
        else if (s->radix == 8) run_stage(x, t->length, s, 8, sign);
        else if (s->radix == 3) run_stage(x, t->length, s, 3, sign);
        else run_stage(x, t->length, s, 5, sign);
    }
}

static void forward(wave *x, const transform *t) { transformed(x, t, -1); }
static void backward(wave *x, const transform *t) { transformed(x, t, 1); }

// Lists the stages of a transform in `memory`, which has room for 2 * length complex numbers, and returns the rest of it.
// The length has at least three factors of two, by eights and fours.
static REAL *plan(transform *t, int64_t length, REAL *memory) {
    *t = (transform){.length = length};
    for (int radix; length > 1; length /= radix) {
        const int twos = __builtin_ctzll(length);
        radix = twos == 3 || twos > 4 ? 8 : twos ? 4 : length % 3 ? 5 : 3;
        t->stages[t->count++] = (stage){radix, length, memory};
        for (int64_t j = 0; j < length / radix; j++)
            for (int q = 1; q < radix; q++, memory += 2) {
                double angle = -2 * M_PI * (double)(j * q) / (double)length;
                memory[0] = cos(angle);
                memory[1] = sin(angle);
            }
    }
    return memory;
}

// ---------------------------------------------------------------------- rows to lanes

#define PART (VECTOR_BYTES < 32 ? VECTOR_BYTES : 32)

enum { PIECE = PART / sizeof(REAL), PIECES = LANES / PIECE };
typedef REAL part __attribute__((vector_size(PART), may_alias));

// Exchanges the upper right and the lower left of every square of 2 * half x 2 * half numbers.
#define EXCHANGE(x, half, first, second)                       \
    for (int i = 0; i < PIECE; i++)                            \
        if (!(i & half)) {                                     \
            part a = x[i], b = x[i + half];                    \
            x[i] = PICK(a, b, first), x[i + half] = PICK(a, b, second); \
        }
#define LIST(...) __VA_ARGS__

INLINE void transpose_piece(part *x) {
#if PART == 32 && IS(REAL)
    EXCHANGE(x, 4, LIST(0, 1, 2, 3, 8, 9, 10, 11), LIST(4, 5, 6, 7, 12, 13, 14, 15))
    EXCHANGE(x, 2, LIST(0, 1, 8, 9, 4, 5, 12, 13), LIST(2, 3, 10, 11, 6, 7, 14, 15))
    EXCHANGE(x, 1, LIST(0, 8, 2, 10, 4, 12, 6, 14), LIST(1, 9, 3, 11, 5, 13, 7, 15))
#elif PART == 32 || IS(REAL)
    EXCHANGE(x, 2, LIST(0, 1, 4, 5), LIST(2, 3, 6, 7))
    EXCHANGE(x, 1, LIST(0, 4, 2, 6), LIST(1, 5, 3, 7))
#else
    EXCHANGE(x, 1, LIST(0, 2), LIST(1, 3))
#endif
}

// Turns LANES waves, whose lanes become waves. `to` is LANES waves apart from nothing else.
INLINE void transpose(const wave *from, wave *to) {
    for (int plane = 0; plane < 2; plane++)
        for (int r = 0; r < PIECES; r++)
            for (int c = 0; c < PIECES; c++) {
                const part *source = (const part *)from + plane * PIECES + c;
                part *target = (part *)to + plane * PIECES + r, x[PIECE];
#pragma GCC unroll 8
                for (int i = 0; i < PIECE; i++) x[i] = source[(r * PIECE + i) * 2 * PIECES];
                transpose_piece(x);
#pragma GCC unroll 8
                for (int i = 0; i < PIECE; i++) target[(c * PIECE + i) * 2 * PIECES] = x[i];
            }
}

// ---------------------------------------------------------------------- windows

// What all windows of one call share.
typedef struct {
    const tiles *s;
    int64_t down, across, tiles;                    // tiles of an image
    const int64_t *row_edges, *column_edges;        // (down + 1,), (across + 1,): where tiles begin, and the end
    int64_t groups, bands, waves;                   // LANES columns of waves, LANES rows, waves in a row
    transform in_rows, in_columns;
    REAL scale;                                     // of a transform there and back
    wave *turns;                                    // (groups,): exp(i pi j / columns)
    uint8_t *needed;                                // (tiles, layers, groups): whether a layer has pixels there
    int64_t *place;                                 // (layers,): of a layer's spectrum, -1 for layers without pixels
    wave *psfs;                                     // (layers with pixels, bands, waves) in one channel; or of slabs
} work;

// What a thread computes a tile in. Planes of numbers are (2 * groups, rows) vectors, spectra (bands, waves).
typedef struct {
    vec *light, *label, *weight, *sums;
    wave *spectrum, *total, *half, *row;
    // Over the field only. PSFs are (psf_groups, side) vectors.
    lines lines;        // of a row of tiles, by layer
    vec *flat;          // of a tile's PSF, (ORDERS, vectors), and the same in columns of LANES numbers
    vec *samples;
    wave *moments;      // (2, bands, waves): spectra of light times x and times y
    wave *psf;          // (ORDERS, bands, waves)
} desk;

// A tile: its image, its row and column there, its first pixel, how much of it lies in the image, and the orders of its PSF.
typedef struct {
    int64_t image, number, row, column, top, left, height, width;
    int has[ORDERS];
} tile;

INLINE tile tile_at(const work *w, int64_t image, int64_t number) {
    const int64_t r = number / w->across, c = number % w->across, *row = w->row_edges + r, *column = w->column_edges + c;
    tile t = {image, number, r, c, row[0], column[0], row[1] - row[0], column[1] - column[0], {1}};
    for (int order = ALONG_X; w->s->over.node_rows && order < ORDERS; order++) t.has[order] = has_order(&w->s->over, r, c, order);
    return t;
}

INLINE uint8_t *needed_by(const work *w, tile t, int64_t layer) {
    return w->needed + ((t.image * w->down * w->across + t.number) * w->s->layers + layer) * w->groups;
}

INLINE int any_of(const uint8_t *needed, int64_t groups) { return memchr(needed, 1, groups) != 0; }

// Transforms a group of columns and hands them on to the rows of a spectrum.
static void columns_to_rows(const work *w, int64_t g, wave *column, wave *spectrum) {
    forward(column, &w->in_columns);
    for (int64_t band = 0; band < w->bands; band++)
        transpose(column + band * LANES, spectrum + band * w->waves + g * LANES);
}

// The spectrum of the first rows of a plane of numbers, in the first columns; or of the numbers times their distance from
// a column or a row of the window.
INLINE void analyse_times(const work *w, const vec *light, int64_t pitch, int64_t height, int64_t groups, int what,
                          REAL middle, wave *column, wave *spectrum) {
    for (int64_t g = 0; g < w->groups; g++) {
        if (g >= groups) {
            for (int64_t band = 0; band < w->bands; band++)
                memset(spectrum + band * w->waves + g * LANES, 0, LANES * sizeof(wave));
            continue;
        }
        const vec *left = light + g * pitch, *right = left + w->groups * pitch;
        const vec x = steps() + (g * LANES - middle), z = x + (REAL)(w->groups * LANES);
        const wave turn = w->turns[g];
        const int both = g + w->groups < groups;
        for (int64_t y = 0; y < height; y++) {
            vec a = left[y], b = both ? right[y] : (vec){0};
            if (what == ALONG_X) a *= x, b *= z;
            if (what == ALONG_Y) a *= y - middle, b *= y - middle;
            column[y] = (wave){a * turn.re - b * turn.im, a * turn.im + b * turn.re};
        }
        memset(column + height, 0, (w->s->rows - height) * sizeof(wave));
        columns_to_rows(w, g, column, spectrum);
    }
    for (int64_t band = 0; band < w->bands; band++) forward(spectrum + band * w->waves, &w->in_rows);
}

// The spectrum of a plane of numbers.
static void analyse(const work *w, const vec *light, wave *column, wave *spectrum) {
    analyse_times(w, light, w->s->rows, w->s->rows, 2 * w->groups, VALUE, 0, column, spectrum);
}

INLINE void multiply_by(const wave *x, const wave *psf, int64_t count, REAL sign, int add, wave *product) {
    for (int64_t k = 0; k < count; k++) {
        const vec im = sign * psf[k].im;
        const wave z = {x[k].re * psf[k].re - x[k].im * im, x[k].re * im + x[k].im * psf[k].re};
        product[k] = add ? sum(product[k], z) : z;
    }
}

// Multiplies by a spectrum, or by its conjugate: `sign` -1. Writes to `product` or adds to it.
static void multiply(const wave *x, const wave *psf, int64_t count, int sign, int add, wave *product) {
    if (sign < 0) multiply_by(x, psf, count, -1, add, product);
    else multiply_by(x, psf, count, 1, add, product);
}

// The sign for the spectrum of a PSF.
INLINE int sign_of(const tiles *s) { return s->correlate ? -1 : 1; }

// Transforms a row of waves back and hands it on to the columns that are needed.
static void row_back(const work *w, wave *row, int64_t band, const uint8_t *needed, wave *half) {
    backward(row, &w->in_rows);
    for (int64_t g = 0; g < w->groups; g++)
        if (!needed || needed[g]) transpose(row + g * LANES, half + g * w->s->rows + band * LANES);
}

enum { ROWS_AHEAD = 8 };  // rows of a tile that are asked for before they are read: each lies far from the one before

// Copies numbers into a black window, from a row and a column of it on.
static void cut(const work *w, const REAL *from, int64_t pitch, int64_t height, int64_t width, int64_t origin, vec *to) {
    const int64_t rows = w->s->rows;
    memset(to, 0, 2 * w->groups * rows * sizeof(vec));
    for (int64_t y = 0; y < height; y++)
        for (int64_t x = 0, column = origin; x < width;) {
            const int64_t lane = column % LANES, count = least(LANES - lane, width - x);
            REAL *target = (REAL *)(to + column / LANES * rows + origin + y) + lane;
            __builtin_prefetch(from + (y + ROWS_AHEAD) * pitch + x);
            store_some(target, from + y * pitch + x, count);
            x += count, column += count;
        }
}

// Cuts the window of a tile out of the plane, or the tile out of the pixels.
INLINE void cut_window(const work *w, tile t, int64_t channel, vec *to) {
    const tiles *s = w->s;
    const REAL *from = s->plane + t.image * s->plane_image + channel * s->plane_channel + t.top * s->plane_row + t.left;
    cut(w, from, s->plane_row, t.height + s->side - 1, t.width + s->side - 1, 0, to);
}

INLINE void cut_tile(const work *w, tile t, int64_t channel, vec *to) {
    const tiles *s = w->s;
    const REAL *from = s->pixels + t.image * s->pixels_image + channel * s->pixels_channel + t.top * s->pixels_row + t.left;
    cut(w, from, s->pixels_row, t.height, t.width, s->origin, to);
}

// Reads the labels and weights of a tile as numbers, in the layout of its window.
static void read_labels(const work *w, tile t, desk *d) {
    const tiles *s = w->s;
    const int64_t *index = s->index + t.image * s->index_image + t.top * s->index_row + t.left;
    for (int64_t n = 0; n < 2 * w->groups * s->rows; n++) d->label[n] = (vec){0} + OUTSIDE;
    for (int64_t y = 0; y < t.height; y++)
        for (int64_t x = 0, column = s->origin; x < t.width;) {
            const int64_t lane = column % LANES, count = least(LANES - lane, t.width - x);
            REAL *target = (REAL *)(d->label + column / LANES * s->rows + s->origin + y) + lane;
            const int64_t *ahead = index + (y + ROWS_AHEAD) * s->index_row + x;
            __builtin_prefetch(ahead), __builtin_prefetch(ahead + 8);
            for (int64_t i = 0; i < count; i++) target[i] = index[y * s->index_row + x + i];
            x += count, column += count;
        }
    if (!s->weight) return;
    const REAL *weight = s->weight + t.image * s->weight_image + t.top * s->weight_row + t.left;
    cut(w, weight, s->weight_row, t.height, t.width, s->origin, d->weight);
}

// The share of a layer in samples with some labels and, where the scene has them, weights of the next layer.
INLINE vec share(const tiles *s, vec label, const vec *weight, int64_t layer) {
    const vec one = 1 - (vec){0};
    if (!s->weight) return where(label == (REAL)layer, one);
    if (s->weight_gradient) return where(label == (REAL)(layer - 1), one) - where(label == (REAL)layer, one);
    return where(label == (REAL)layer, 1 - *weight) + where(label == (REAL)(layer - 1), *weight);
}

// The left (0) or right (1) columns that a wave was made of.
INLINE vec unturned(wave x, wave turn, int side) {
    return side ? x.im * turn.re - x.re * turn.im : x.re * turn.re + x.im * turn.im;
}

// Adds the light of a column of waves and its layer's share to the sums of a tile.
INLINE void add_shares(const work *w, tile t, int64_t layer, int64_t g, const wave *column, desk *d) {
    const tiles *s = w->s;
    const wave turn = w->turns[g];
    for (int64_t y = s->origin; y < s->origin + t.height; y++) {
        const int64_t n = g * s->rows + y, m = n + w->groups * s->rows;
        const wave x = column[y];
        d->sums[n] += share(s, d->label[n], d->weight + n, layer) * unturned(x, turn, 0);
        d->sums[m] += share(s, d->label[m], d->weight + m, layer) * unturned(x, turn, 1);
    }
}

// Writes the sums of a tile to its pixels.
static void write_sums(const work *w, tile t, int64_t channel, const desk *d) {
    const tiles *s = w->s;
    REAL *out = s->out + ((t.image * s->channels + channel) * s->height + t.top) * s->width + t.left;
    for (int64_t y = 0; y < t.height; y++)
        for (int64_t x = 0, column = s->origin; x < t.width;) {
            const int64_t lane = column % LANES, count = least(LANES - lane, t.width - x);
            const REAL *from = (const REAL *)(d->sums + column / LANES * s->rows + s->origin + y) + lane;
            store_some(out + y * s->width + x, from, count);
            x += count, column += count;
        }
}

// The transformed columns of a layer's share of the pixels, which lie in `sums`. Its rows are left to be transformed.
static void layer_columns(const work *w, tile t, int64_t layer, desk *d) {
    const tiles *s = w->s;
    const uint8_t *needed = needed_by(w, t, layer);
    wave *column = d->half;
    for (int64_t g = 0; g < w->groups; g++) {
        if (!needed[g]) {
            for (int64_t band = 0; band < w->bands; band++)
                memset(d->spectrum + band * w->waves + g * LANES, 0, LANES * sizeof(wave));
            continue;
        }
        const wave turn = w->turns[g];
        memset(column, 0, s->rows * sizeof(wave));
        for (int64_t y = s->origin; y < s->origin + t.height; y++) {
            const int64_t n = g * s->rows + y, m = n + w->groups * s->rows;
            const vec left = share(s, d->label[n], d->weight + n, layer) * d->sums[n];
            const vec right = share(s, d->label[m], d->weight + m, layer) * d->sums[m];
            column[y] = (wave){left * turn.re - right * turn.im, left * turn.im + right * turn.re};
        }
        columns_to_rows(w, g, column, d->spectrum);
    }
}

// Adds the first numbers of each row of a wave's columns to a plane, and `sloped` ones times x from a column of the window.
INLINE void add_columns(const work *w, int64_t g, const wave *column, const wave *sloped, REAL middle, int64_t height,
                        int64_t width, REAL *out, int64_t pitch) {
    const wave turn = w->turns[g];
    for (int side = 0; side < 2; side++) {
        const int64_t first = (g + side * w->groups) * LANES, count = least(LANES, width - first);
        for (int64_t y = 0; count > 0 && y < height; y++) {
            vec value = unturned(column[y], turn, side);
            if (sloped) value += (steps() + (first - middle)) * unturned(sloped[y], turn, side);
            REAL *target = out + y * pitch + first;
            value += load_some(target, count);
            store_some(target, &value, count);
        }
    }
}

// ---------------------------------------------------------------------- tiles
//
// Over the field what stands before the sum of gather, x (L * hx) = (xL) * hx + L * (k hx) with a PSF's own coordinate k,
// leaves one transform back for each layer:
//
//     L * (h0 + k_x hx + k_y hy) + (xL) * hx + (yL) * hy
//
// Scatter is its transpose: x and y follow the sum over the layers of a tile.

INLINE int64_t psf_groups(const tiles *s) { return (s->side + LANES - 1) / LANES; }

// Row or column of the window from which x or y is counted.
INLINE REAL middle_of(const work *w, tile t, int order) {
    const field *f = &w->s->over;
    const REAL middle = order == ALONG_X ? f->column_middles[t.column] - t.left
                                         : f->row_middles[t.row] - t.top;
    return middle + w->s->side / 2;
}

// The sign of k: PSFs are convolved with the light, or correlated.
INLINE REAL direction(const tiles *s) { return s->origin ? 1 : -1; }

// PSFs of a layer and channel at the nodes, and how many numbers later the next node's are.
INLINE const REAL *nodes_of(const tiles *s, int64_t layer, int64_t channel) {
    return s->psfs + (layer * s->channels + channel) * s->side * s->side;
}
INLINE int64_t next_node(const tiles *s) { return s->layers * s->channels * s->side * s->side; }

// Returns the spectra of a layer's PSF in a tile, one for each order.
static const wave *tile_psfs(const work *w, tile t, int64_t channel, int64_t layer, desk *d) {
    const tiles *s = w->s;
    const int64_t all = w->bands * w->waves, groups = psf_groups(s), count = groups * s->side;
    if (!s->over.node_rows) return w->psfs + w->place[layer] * all;
    const int along_x = t.has[ALONG_X], along_y = t.has[ALONG_Y];
    const REAL radius = s->side / 2;
    blend_nodes(&d->lines, layer, nodes_of(s, layer, channel), next_node(s), w->scale);
    blend_line(&d->lines, layer, t.column, d->flat);
    for (int64_t g = 0, n = 0; g < groups; g++) {
        const bits inside = steps() < (REAL)(s->side - g * LANES);
        const vec k = direction(s) * (steps() + (g * LANES - radius));
        for (int64_t y = 0; y < s->side; y++, n++) {
            vec psf[ORDERS];
            for (int order = 0; order < ORDERS; order++)
                psf[order] = where(inside, *(const loose *)((REAL *)(d->flat + order * d->lines.vectors) + y * s->side + g * LANES));
            d->samples[n] = psf[VALUE] + k * psf[ALONG_X] + direction(s) * (y - radius) * psf[ALONG_Y];
            if (along_x) d->samples[count + n] = psf[ALONG_X];
            if (along_y) d->samples[2 * count + n] = psf[ALONG_Y];
        }
    }
    for (int order = 0; order < ORDERS; order++)
        if (t.has[order])
            analyse_times(w, d->samples + order * count, s->side, s->side, groups, VALUE, 0, d->half, d->psf + order * all);
    return d->psf;
}

// Makes the spectra of a plane of light, and of the light times x and times y.
static void analyse_moments(const work *w, tile t, desk *d, wave *spectrum) {
    const int64_t rows = w->s->rows, all = w->bands * w->waves;
    analyse(w, d->light, d->half, spectrum);
    if (t.has[ALONG_X])
        analyse_times(w, d->light, rows, rows, 2 * w->groups, ALONG_X, middle_of(w, t, ALONG_X), d->half, d->moments);
    if (t.has[ALONG_Y])
        analyse_times(w, d->light, rows, rows, 2 * w->groups, ALONG_Y, middle_of(w, t, ALONG_Y), d->half, d->moments + all);
}

static void gather_tile(const work *w, int64_t channel, tile t, desk *d) {
    const tiles *s = w->s;
    const int64_t rows = s->rows, all = w->bands * w->waves;
    const wave *light[ORDERS] = {d->spectrum, d->moments, d->moments + all};
    cut_window(w, t, channel, d->light);
    analyse_moments(w, t, d, d->spectrum);
    read_labels(w, t, d);
    memset(d->sums, 0, 2 * w->groups * rows * sizeof(vec));
    for (int64_t layer = 0; layer < s->layers; layer++) {
        const uint8_t *needed = needed_by(w, t, layer);
        if (!any_of(needed, w->groups)) continue;
        const wave *psf = tile_psfs(w, t, channel, layer, d);
        for (int64_t band = 0; band < w->bands; band++) {
            const int64_t k = band * w->waves;
            for (int order = 0; order < ORDERS; order++)
                if (t.has[order]) multiply(light[order] + k, psf + order * all + k, w->waves, sign_of(s), order, d->row);
            row_back(w, d->row, band, needed, d->half);
        }
        for (int64_t g = 0; g < w->groups; g++)
            if (needed[g]) {
                backward(d->half + g * rows, &w->in_columns);
                add_shares(w, t, layer, g, d->half + g * rows, d);
            }
    }
    write_sums(w, t, channel, d);
}

static void scatter_tile(const work *w, int64_t channel, tile t, desk *d) {
    const tiles *s = w->s;
    const int64_t all = w->bands * w->waves, half = w->groups * s->rows;
    wave *totals[ORDERS] = {d->total, d->moments, d->moments + all};
    cut_tile(w, t, channel, d->sums);
    read_labels(w, t, d);
    for (int order = 0; order < ORDERS; order++)
        if (t.has[order]) memset(totals[order], 0, all * sizeof(wave));
    for (int64_t layer = 0; layer < s->layers; layer++) {
        if (!any_of(needed_by(w, t, layer), w->groups)) continue;
        const wave *psf = tile_psfs(w, t, channel, layer, d);
        layer_columns(w, t, layer, d);
        for (int64_t k = 0; k < all; k += w->waves) {
            forward(d->spectrum + k, &w->in_rows);
            for (int order = 0; order < ORDERS; order++)
                if (t.has[order]) multiply(d->spectrum + k, psf + order * all + k, w->waves, sign_of(s), 1, totals[order] + k);
        }
    }
    const int64_t height = s->height + s->side - 1, width = s->width + s->side - 1;
    REAL *out = s->out + ((t.image * s->channels + channel) * height + t.top) * width + t.left;
    for (int order = 0; order < ORDERS; order++)
        for (int64_t band = 0; t.has[order] && band < w->bands; band++)
            row_back(w, totals[order] + band * w->waves, band, 0, d->half + order * half);
    const REAL x_middle = t.has[ALONG_X] ? middle_of(w, t, ALONG_X) : 0;
    for (int64_t g = 0; g < w->groups; g++) {
        wave *columns[ORDERS] = {0};
        for (int order = 0; order < ORDERS; order++)
            if (t.has[order]) backward(columns[order] = d->half + order * half + g * s->rows, &w->in_columns);
        for (int64_t y = 0; columns[ALONG_Y] && y < t.height + s->side - 1; y++) {
            const wave x = columns[ALONG_Y][y];
            const REAL from = y - middle_of(w, t, ALONG_Y);
            columns[0][y] = sum(columns[0][y], (wave){x.re * from, x.im * from});
        }
        add_columns(w, g, columns[0], columns[ALONG_X], x_middle, t.height + s->side - 1, t.width + s->side - 1, out, width);
    }
}

// Adds the gradient of a layer's PSF in a tile to that of its row of tiles, from their spectra.
static void add_to_line(const work *w, tile t, int64_t layer, desk *d) {
    const tiles *s = w->s;
    const int64_t all = w->bands * w->waves, groups = psf_groups(s), count = groups * s->side, vectors = d->lines.vectors;
    const REAL radius = s->side / 2;
    for (int order = 0; order < ORDERS; order++) {
        vec *samples = d->samples + order * count;
        memset(samples, 0, count * sizeof(vec));
        if (!t.has[order]) continue;
        for (int64_t band = 0; band < w->bands; band++) row_back(w, d->psf + order * all + band * w->waves, band, 0, d->half);
        for (int64_t g = 0; g < w->groups && g < groups; g++) {
            wave *column = d->half + g * s->rows;
            backward(column, &w->in_columns);
            for (int side = 0; side < 2; side++) {
                const int64_t own = g + side * w->groups;
                for (int64_t y = 0; own < groups && y < s->side; y++)
                    samples[own * s->side + y] = unturned(column[y], w->turns[g], side);
            }
        }
    }
    for (int64_t g = 0, n = 0; g < groups; g++)
        for (int64_t y = 0; y < s->side; y++, n++) {
            const vec h = d->samples[n], k = direction(s) * (steps() + (g * LANES - radius));
            const vec psf[ORDERS] = {h, d->samples[count + n] + k * h, d->samples[2 * count + n] + direction(s) * (y - radius) * h};
            for (int order = 0; order < ORDERS; order++) {
                REAL *to = (REAL *)(d->flat + order * vectors) + y * s->side + g * LANES;
                memcpy(to, psf + order, least(LANES, s->side - g * LANES) * sizeof(REAL));
            }
        }
    spread_tile(&d->lines, layer, t.column, d->flat);
}

// Correlates a tile with its light: adds spectra to those of a slab or, over the field, PSFs to those of a row of tiles.
static void correlate_tile(const work *w, int64_t channel, tile t, desk *d, wave *slab) {
    const tiles *s = w->s;
    const int64_t all = w->bands * w->waves;
    const int over_field = s->over.node_rows > 0;
    const wave *light[ORDERS] = {d->total, d->moments, d->moments + all};
    cut_window(w, t, channel, d->light);
    analyse_moments(w, t, d, d->total);
    cut_tile(w, t, channel, d->sums);
    read_labels(w, t, d);
    for (int64_t layer = 0; layer < s->layers; layer++) {
        if (!any_of(needed_by(w, t, layer), w->groups)) continue;
        layer_columns(w, t, layer, d);
        wave *found = over_field ? d->psf : slab + w->place[layer] * all;
        for (int64_t k = 0; k < all; k += w->waves) {
            wave *row = d->spectrum + k;
            forward(row, &w->in_rows);
            for (int order = 0; order < ORDERS; order++) {
                if (!t.has[order]) continue;
                const wave *x = light[order] + k;
                multiply(s->correlate ? x : row, s->correlate ? row : x, w->waves, -1, !over_field, found + order * all + k);
            }
        }
        if (over_field) add_to_line(w, t, layer, d);
    }
}

// ---------------------------------------------------------------------- a call

enum { GATHER, SCATTER, CORRELATE };

// Notes the layers of each tile, by groups of columns. Returns whether all pixels lie in a layer.
static int note_layers(const work *w) {
    const tiles *s = w->s;
    int bad = 0;
#pragma omp parallel for schedule(dynamic) num_threads(s->threads) reduction(| : bad)
    for (int64_t n = 0; n < s->images * w->tiles; n++) {
        const tile t = tile_at(w, n / w->tiles, n % w->tiles);
        uint8_t *needed = needed_by(w, t, 0);
        int64_t group = 0, last = -1;
        for (int64_t y = t.top; y < t.top + t.height; y++) {
            const int64_t *index = s->index + t.image * s->index_image + y * s->index_row + t.left;
            const REAL *weight = s->weight ? s->weight + t.image * s->weight_image + y * s->weight_row + t.left : 0;
            for (int64_t x = 0, column = s->origin; x < t.width; x++, column++) {
                const int next = weight && (s->weight_gradient || !(weight[x] <= 0));
                if (column % LANES == 0 || x == 0) group = column / LANES % w->groups, last = -1;
                if ((uint64_t)index[x] >= (uint64_t)(s->layers - next)) {
                    bad = 1;
                    continue;
                }
                if (2 * index[x] + next == last) continue;  // as many neighbours
                last = 2 * index[x] + next;
                needed[index[x] * w->groups + group] = 1;
                if (next) needed[(index[x] + 1) * w->groups + group] = 1;
            }
        }
    }
    return !bad;
}

// Numbers the layers that have pixels and returns how many there are.
static int64_t place_layers(const work *w) {
    int64_t present = 0;
    for (int64_t layer = 0; layer < w->s->layers; layer++) {
        w->place[layer] = -1;
        for (int64_t n = 0; n < w->s->images * w->tiles && w->place[layer] < 0; n++)
            if (any_of(needed_by(w, tile_at(w, n / w->tiles, n % w->tiles), layer), w->groups)) w->place[layer] = present++;
    }
    return present;
}

// Makes the spectra of the PSFs that are needed, in one channel, scaled for a transform there and back.
static void transform_psfs(const work *w, int64_t channel, desk *desks) {
    const tiles *s = w->s;
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
    for (int64_t layer = 0; layer < s->layers; layer++) {
        if (w->place[layer] < 0) continue;
        desk *d = desks + thread_number();
        cut(w, s->psfs + (layer * s->channels + channel) * s->side * s->side, s->side, s->side, s->side, 0, d->light);
        for (int64_t n = 0; n < 2 * w->groups * s->rows; n++) d->light[n] *= w->scale;
        analyse(w, d->light, d->half, w->psfs + w->place[layer] * w->bands * w->waves);
    }
}

// From which distance in tiles on windows do not overlap.
static int64_t apart(const int64_t *edges, int64_t count, int64_t side) {
    int64_t tiles = 1;
    for (int64_t n = 0; n + tiles < count; n++)
        while (n + tiles < count && edges[n + tiles] < edges[n + 1] + side - 1) tiles++;
    return tiles;
}

// Gathers or scatters all tiles of a channel; over the field a thread takes a row of tiles. Tiles whose windows overlap are
// not scattered at the same time, so that the order of additions is always the same.
static void render_tiles(const work *w, int64_t channel, desk *desks, int kind) {
    const tiles *s = w->s;
    const int over_field = s->over.node_rows > 0;
    const int64_t down = kind == SCATTER ? apart(w->row_edges, w->down, s->side) : 1;
    const int64_t across = kind == SCATTER && !over_field ? apart(w->column_edges, w->across, s->side) : 1;
    for (int64_t n = 0; n < s->threads; n++) desks[n].lines.row = -1;
    for (int64_t phase = 0; phase < least(down, w->down) * across; phase++) {
        const int64_t y = phase / across, x = phase % across;
        const int64_t own = (w->down - y + down - 1) / down, beside = (w->across - x + across - 1) / across;
        const int64_t together = over_field ? beside : 1;
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
        for (int64_t n = 0; n < s->images * own * beside / together; n++) {
            desk *d = desks + thread_number();
            for (int64_t m = n * together; m < (n + 1) * together; m++) {
                const int64_t row = m / beside / s->images * down + y, column = m % beside * across + x;
                const tile t = tile_at(w, m / beside % s->images, row * w->across + column);
                if (over_field) begin_row(&d->lines, row);
                if (kind == SCATTER) scatter_tile(w, channel, t, d);
                else gather_tile(w, channel, t, d);
            }
        }
    }
}

// Correlates all tiles of a channel, a slab of them in each thread; then the slabs are added in their order.
static void correlate_tiles(const work *w, int64_t channel, desk *desks, int64_t present) {
    const tiles *s = w->s;
    const int64_t all = w->bands * w->waves, count = s->images * w->tiles;
    memset(w->psfs, 0, s->threads * present * all * sizeof(wave));
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
    for (int64_t slab = 0; slab < s->threads; slab++)
        for (int64_t n = count * slab / s->threads; n < count * (slab + 1) / s->threads; n++) {
            const tile t = tile_at(w, n / w->tiles, n % w->tiles);
            correlate_tile(w, channel, t, desks + thread_number(), w->psfs + slab * present * all);
        }
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
    for (int64_t layer = 0; layer < s->layers; layer++) {
        if (w->place[layer] < 0) continue;
        desk *d = desks + thread_number();
        wave *found = w->psfs + w->place[layer] * all;
        for (int64_t slab = 1; slab < s->threads; slab++)
            for (int64_t k = 0; k < all; k++) found[k] = sum(found[k], found[slab * present * all + k]);
        for (int64_t k = 0; k < all; k++) found[k] = (wave){found[k].re * w->scale, found[k].im * w->scale};
        for (int64_t band = 0; band < w->bands; band++) row_back(w, found + band * w->waves, band, 0, d->half);
        REAL *out = s->out + (layer * s->channels + channel) * s->side * s->side;
        for (int64_t g = 0; g < w->groups; g++) {
            backward(d->half + g * s->rows, &w->in_columns);
            add_columns(w, g, d->half + g * s->rows, 0, 0, s->side, s->side, out, s->side);
        }
    }
}

// Correlates all rows of tiles of a channel over the field, a slab of them in each thread; then the slabs are added.
static void correlate_rows(const work *w, int64_t channel, desk *desks) {
    const tiles *s = w->s;
    const int64_t nodes = s->over.node_rows * s->over.node_columns, count = desks->lines.vectors, all = nodes * s->layers * count;
    vec *slabs = (vec *)w->psfs;
    memset(slabs, 0, s->threads * all * sizeof(vec));
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
    for (int64_t slab = 0; slab < s->threads; slab++) {
        desk *d = desks + thread_number();
        for (int64_t row = w->down * slab / s->threads; row < w->down * (slab + 1) / s->threads; row++) {
            d->lines.row = -1;
            begin_row(&d->lines, row);
            for (int64_t n = 0; n < s->images * w->across; n++)
                correlate_tile(w, channel, tile_at(w, n / w->across, row * w->across + n % w->across), d, 0);
            for (int64_t layer = 0; layer < s->layers; layer++)
                spread_line(&d->lines, layer, slabs + slab * all + layer * count, s->layers * count);
        }
    }
#pragma omp parallel for num_threads(s->threads)
    for (int64_t n = 0; n < nodes * s->layers; n++) {
        REAL *out = s->out + (n * s->channels + channel) * s->side * s->side;
        for (int64_t slab = 0; slab < s->threads; slab++) {
            const REAL *found = (const REAL *)(slabs + slab * all + n * count);
            for (int64_t k = 0; k < s->side * s->side; k++) out[k] += found[k] * w->scale;
        }
    }
}

static desk take_desk(pool *p, const work *w) {
    const tiles *s = w->s;
    const int64_t plane = 2 * w->groups * s->rows, waves = w->bands * w->waves, over_field = s->over.node_rows > 0;
    const int64_t orders = over_field ? ORDERS : 1, psf = over_field * psf_groups(s);
    desk d = {.lines = take_lines(p, &s->over, s->layers, s->side * s->side)};
    d.light = take(p, plane, sizeof(vec)), d.label = take(p, plane, sizeof(vec)), d.sums = take(p, plane, sizeof(vec));
    d.weight = take(p, s->weight ? plane : 0, sizeof(vec));
    d.spectrum = take(p, waves, sizeof(wave)), d.total = take(p, waves, sizeof(wave)), d.row = take(p, w->waves, sizeof(wave));
    d.half = take(p, orders * w->groups * s->rows, sizeof(wave));
    d.flat = take(p, over_field * ORDERS * d.lines.vectors + psf, sizeof(vec));  // the last row is read beyond its end
    d.samples = take(p, ORDERS * psf * s->side, sizeof(vec));
    d.moments = take(p, over_field * 2 * waves, sizeof(wave)), d.psf = take(p, over_field * ORDERS * waves, sizeof(wave));
    return d;
}

// Where tiles of so many pixels begin, and the end.
static int64_t *even_edges(pool *p, int64_t pixels, int64_t side, int64_t count) {
    int64_t *edges = take(p, count + 1, sizeof(int64_t));
    for (int64_t n = 0; edges && n <= count; n++) edges[n] = least(n * side, pixels);
    return edges;
}

// Returns 0, REFUSED if a pixel lies in no layer, or NO_MEMORY.
static int compute(const tiles *s, int kind) {
    const int64_t height = s->rows - s->side + 1, width = s->columns - s->side + 1;  // of the largest tile
    const field *f = &s->over;
    pool p = {0};
    desk desks[s->threads];
    work w = {.s = s, .down = f->down, .across = f->across, .row_edges = f->row_edges, .column_edges = f->column_edges};
    if (!f->node_rows) {
        w.down = (s->height + height - 1) / height, w.across = (s->width + width - 1) / width;
        w.row_edges = even_edges(&p, s->height, height, w.down), w.column_edges = even_edges(&p, s->width, width, w.across);
    }
    w.tiles = w.down * w.across;
    w.waves = s->columns / 2, w.groups = w.waves / LANES, w.bands = s->rows / LANES;
    w.scale = 1 / ((REAL)s->rows * (REAL)w.waves);
    w.turns = take(&p, w.groups, sizeof(wave)), w.place = take(&p, s->layers, sizeof(int64_t));
    w.needed = take_zeros(&p, s->images * w.tiles * s->layers, w.groups);
    REAL *numbers = take(&p, 4 * (s->rows + w.waves), sizeof(REAL));
    for (int64_t n = 0; n < s->threads; n++) desks[n] = take_desk(&p, &w);
    int status = p.missing ? NO_MEMORY : note_layers(&w) ? 0 : REFUSED;
    if (!status) {
        plan(&w.in_columns, s->rows, plan(&w.in_rows, w.waves, numbers));
        for (int64_t j = 0; j < w.waves; j++) {
            w.turns[j / LANES].re[j % LANES] = cos(M_PI * (double)j / (double)s->columns);
            w.turns[j / LANES].im[j % LANES] = sin(M_PI * (double)j / (double)s->columns);
        }
        const int64_t present = place_layers(&w), slabs = kind == CORRELATE ? s->threads : 1;
        if (!f->node_rows) w.psfs = take(&p, slabs * present * w.bands * w.waves, sizeof(wave));
        else if (kind == CORRELATE)
            w.psfs = take(&p, slabs * f->node_rows * f->node_columns * s->layers * desks->lines.vectors, sizeof(vec));
        status = p.missing ? NO_MEMORY : 0;
        for (int64_t channel = 0; channel < s->channels && !status; channel++) {
            if (kind == CORRELATE && f->node_rows) correlate_rows(&w, channel, desks);
            else if (kind == CORRELATE) correlate_tiles(&w, channel, desks, present);
            else {
                if (!f->node_rows) transform_psfs(&w, channel, desks);
                render_tiles(&w, channel, desks, kind);
            }
        }
    }
    free_all(&p);
    return status;
}

int gather(const tiles *s) { return compute(s, GATHER); }

int scatter(const tiles *s) { return compute(s, SCATTER); }

int correlate(const tiles *s) { return compute(s, CORRELATE); }
