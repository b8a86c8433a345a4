// Occlusion-aware compositing by direct convolution: a block of pixels is convolved with the layers in its window, each
// only in the rows and columns where it is present.
//
// From near to far, with the blurred light L, alpha A and cumulative alpha E of each layer (the alpha of the layer and all
// farther ones): total += T L / E and T -= T A / E, where T is the transmission of the nearer layers. With stray light L
// becomes (1 - veil) L + veil mean A.
//
// A block is BAND rows of LANES pixels, and its sums stay in registers. All terms are positive, so direct sums in REAL keep
// their relative accuracy however small they are (transforms do not, see dense_occlusion.py).
//
// - Light is masked to a layer and convolved. A row above and a row below the middle of the window together serve each of
//   the block's rows once, so that no product is wasted.
// - Weights are 1 along runs of pixels. The blur of a run is the difference of two partial sums over a PSF's row, one for
//   each end. They come from tables in double, since a difference keeps only absolute accuracy.
// - Weights between 0 and 1, of pixels shared by two layers, are convolved like light.
//
// With PSFs over the field a block lies in a tile of them, and is blurred by the value and the slopes of its PSF. Layers
// are then normalised by the part of the PSF's light that sees them, so that a relative illumination stays.
//
// Compiled by build.py with REAL as float or double.

#include "vectors.h"
#include "field.h"

enum { BAND = 8, DOUBLES = VECTOR_BYTES / sizeof(double), PARTS = LANES / DOUBLES };
enum { STRIPS = REGISTERS / 16, EDGE_ROWS = REGISTERS / 4 };  // whose sums stay in registers
enum { WIDTH = STRIPS * LANES };  // of a block with a single layer in its window

typedef double dvec __attribute__((vector_size(VECTOR_BYTES)));
typedef double dloose __attribute__((vector_size(VECTOR_BYTES), aligned(8), may_alias));
typedef REAL part __attribute__((vector_size(DOUBLES * sizeof(REAL))));

static const REAL EPSILON = 1e-6;  // as in dense_occlusion.py

// The fields of `_fields` in occlusion_ops.py, and more. Widths and heights are those of the output; planes are larger by
// side - 1.
typedef struct {
    int64_t threads, images, channels, height, width, layers, side, map_image, map_row;
    field over;         // psfs with nodes: (node_rows, node_columns, layers, channels, side, side)
    const REAL *plane;  // light
    int64_t plane_image, plane_channel, plane_row;
    const REAL *psfs;   // (layers, channels, side, side), flipped, columns first
    const REAL *lower;  // layer indices of the plane's pixels; `layers` or more: in no layer
    const REAL *share;  // weight of the next layer, below 1; like lower, or null
    const REAL *mean;   // (images, channels) mean light, spread as stray light, or null
    const REAL *veil;   // (layers, channels) share of stray light
    REAL *out;          // (images, channels, height, width)
    const REAL *gradient;  // of `out`
    REAL *plane_gradient, *psf_gradient, *mean_gradient, *veil_gradient;  // of the tensors, like them, or null
    int64_t *counts, every;  // see `count`
} scene_parameters;

// A run of pixels of one row with the same layer index; either all or none of them are shared with the next layer.
typedef struct {
    int32_t start, layer, shared;
} run;

// A row of light or weights, and the range of PSF columns with nonzero products.
typedef struct {
    const REAL *light;
    int32_t from, to;
} ray;

enum { BLURRED, ALPHA, DIVISOR, PASSED, LIT, KEPT, CUMULATIVE = DIVISOR };  // the first three, then their gradients

// Start (sign 1) or end (-1) of a run of weights 1, as an index into the tables of partial sums.
typedef struct {
    int64_t at;
    double sign;
} edge;

// Weights 1 in a window: their starts and ends within rows, and the ranges of rows that begin with weights 1.
typedef struct {
    edge *columns, *rows;
    int column_count, row_count, open;
} region;

typedef struct {
    ray *light, *lower, *upper;  // light of a layer; shared weights of runs with it as `lower`, or as the next layer
    int lower_count, upper_count;
    region own, behind;  // weights 1 of the layer, and of the layer and all farther ones
} outline;

// Buffers of a thread.
typedef struct {
    run *runs;          // of the rows of a window, at row % rows
    int64_t *made;      // index of the row, over all maps, to which they belong
    const run **heads;  // first run of each row of a window
    int32_t *members;   // layers in the window, near to far
    int64_t *stamps;    // by layer: number of the last window that contained it
    int64_t window;
    REAL *rows[3];      // masked rows: light, and the shared weights `lower` and `upper` of the outline
    REAL *nothing;      // a row of zeros
    ray *rays;          // of one channel
    vec (*total)[BAND], (*through)[BAND];  // by channel: light of the nearer layers, and their transmission
    outline outline;
    vec (*kept)[KEPT][BAND];  // of a block, by layer and channel, for gradients
    lines psfs;         // of a row of tiles, by layer and channel
    vec *psf;           // of a tile, (ORDERS, vectors), and
    double *tables;     // their tables
} workspace;

// ---- Tables: partial sums over the ends of a PSF's rows, by which the blur of a run is a difference of two entries.
// Rows (side + 2 BAND - 2, pitch): entry u of row BAND - 1 + k is the sum of row k's samples from column
// side + LANES - 2 - u on; rows beyond the PSF are zero. They are followed by the sums of all rows from
// k = side + BAND - 2 - u on.

static int64_t table_pitch(const scene_parameters *s) { return s->side + 2 * LANES; }
static int64_t table_rows(const scene_parameters *s) { return s->side + 2 * BAND - 2; }
static int64_t table_size(const scene_parameters *s) { return table_rows(s) * (table_pitch(s) + 1) + BAND; }

static void fill_table(const scene_parameters *s, const REAL *psf, double *table) {
    int64_t pitch = table_pitch(s), rows = table_rows(s);
    double *ends = table + rows * pitch;
    memset(table, 0, table_size(s) * sizeof(double));
    for (int64_t k = 0; k < s->side; k++) {
        double sum = 0, *row = table + (BAND - 1 + k) * pitch;
        for (int64_t u = 0; u < pitch; u++) {
            int64_t column = s->side + LANES - 2 - u;
            if (column >= 0 && column < s->side) sum += psf[column * s->side + k];
            row[u] = sum;
        }
        ends[s->side + BAND - 2 - k] = sum;
    }
    for (int64_t u = 1; u < rows; u++) ends[u] += ends[u - 1];
}

// ---- Runs.

static void find_runs(const scene_parameters *s, const REAL *lower, const REAL *share, run *runs) {
    int64_t width = s->width + s->side - 1, count = 0;
    for (int64_t x = 0; x < width; x++) {
        int shared = share && share[x] > 0;
        if (!x || lower[x] != lower[x - 1] || (share && shared != runs[count - 1].shared)) {
            int exists = lower[x] >= 0 && lower[x] + shared < s->layers;  // false for a NaN depth
            runs[count++] = (run){x, exists ? lower[x] : s->layers, exists && shared};
        }
    }
    runs[count] = (run){width, 0, 0};
}

static void find_runs_of_band(const scene_parameters *s, workspace *d, int64_t image, int64_t y) {
    int64_t rows = s->side + BAND - 1, width = s->width + s->side - 1, height = s->height + s->side - 1;
    for (int64_t r = y; r < y + rows; r++) {
        int64_t slot = r % rows, at = image * s->map_image + r * s->map_row;
        run *runs = d->runs + slot * (width + 1);
        if (d->made[slot] != image * height + r) find_runs(s, s->lower + at, s->share ? s->share + at : 0, runs);
        d->made[slot] = image * height + r;
        d->heads[r - y] = runs;
    }
}

// Moves to a window further right in the same rows; returns whether the window contains a single layer.
static int move_heads(workspace *d, int64_t rows, int64_t x, int64_t span) {
    int alone = 1;
    for (int64_t r = 0; r < rows; r++) {
        const run *p = d->heads[r];
        while (p[1].start <= x) p++;
        d->heads[r] = p;
        alone &= p[1].start >= x + span && !p->shared && p->layer == d->heads[0]->layer;
    }
    return alone;
}

INLINE int meet(workspace *d, int count, int32_t layer) {
    if (d->stamps[layer] == d->window) return count;
    d->stamps[layer] = d->window;
    int n = count;
    for (; n > 0 && d->members[n - 1] < layer; n--) d->members[n] = d->members[n - 1];
    d->members[n] = layer;
    return count + 1;
}

// Lists the layers of a window, near to far.
static int list_layers(const scene_parameters *s, workspace *d, int64_t rows, int64_t x, int64_t span) {
    int count = 0;
    d->window++;
    for (int64_t r = 0; r < rows; r++)
        for (const run *p = d->heads[r]; p->start < x + span; p++) {
            if (p->layer >= s->layers) continue;
            count = meet(d, count, p->layer);
            if (p->shared) count = meet(d, count, p->layer + 1);
        }
    return count;
}

typedef struct {
    int32_t from, to;
} extent;

INLINE void reach(extent *e, int32_t from, int32_t to) {
    if (e->from > from) e->from = from;
    e->to = to;
}

INLINE ray ray_of(const scene_parameters *s, extent e, const REAL *light, const REAL *nothing) {
    if (e.to == 0) return (ray){nothing, s->side, 0};
    return (ray){light, e.from < LANES ? 0 : e.from - LANES + 1, least(e.to, s->side)};
}

INLINE void add_edge(edge *edges, int *count, int64_t at, int begins) {
    edges[(*count)++] = (edge){at, begins ? 1 : -1};
}

INLINE void start_row(region *a, int64_t at, int whole) {
    if (whole != a->open) add_edge(a->rows, &a->row_count, at, whole);
    a->open = whole;
}

// Finds the runs and rows of a layer in a window. Rows of this layer alone are not masked, unless they are to be `copied`.
static void draw_outline(const scene_parameters *s, workspace *d, int64_t x, int32_t layer, int64_t pitch, int copied) {
    int64_t rows = s->side + BAND - 1, span = s->side + LANES - 1;
    outline *o = &d->outline;
    o->own.column_count = o->own.row_count = o->own.open = 0;
    o->behind.column_count = o->behind.row_count = o->behind.open = 0;
    o->lower_count = o->upper_count = 0;
    for (int64_t r = 0; r < rows; r++) {
        extent light = {span, 0}, lower = {span, 0}, upper = {span, 0};
        const run *p = d->heads[r];
        int64_t place = (BAND - 1 + r) * table_pitch(s) + s->side + LANES - 2 + x;  // subtract the first column of a run
        int was_own = p->layer == layer && !p->shared, was_behind = was_own || p->layer < layer;
        int whole = !copied && was_own && p[1].start >= x + span;
        start_row(&o->own, rows - 1 - r, was_own);
        start_row(&o->behind, rows - 1 - r, was_behind);
        for (; p->start < x + span; p++) {
            int32_t from = p->start < x ? 0 : p->start - x, to = least(p[1].start - x, span);
            int own = p->layer == layer && !p->shared, behind = own || p->layer < layer;
            int below = p->layer == layer && p->shared, above = p->layer == layer - 1 && p->shared;
            if (own != was_own) add_edge(o->own.columns, &o->own.column_count, place - p->start, own);
            if (behind != was_behind) add_edge(o->behind.columns, &o->behind.column_count, place - p->start, behind);
            was_own = own, was_behind = behind;
            if (own || below || above) reach(&light, from, to);
            if (below) reach(&lower, from, to);
            if (above) reach(&upper, from, to);
        }
        // Null means the row of the plane itself.
        o->light[r] = ray_of(s, light, whole ? 0 : d->rows[0] + r * pitch, d->nothing);
        o->lower[r] = ray_of(s, lower, d->rows[1] + r * pitch, d->nothing);
        o->upper[r] = ray_of(s, upper, d->rows[2] + r * pitch, d->nothing);
        o->lower_count += lower.to > 0;
        o->upper_count += upper.to > 0;
    }
}

// ---- Sums.

// Adds the products of two rows of light with a PSF: row `a` for the block's rows up to `split`, and row `b`, a PSF's
// height below it, for the others.
INLINE void add_rays(const ray *a, const ray *b, const REAL *psf, int64_t side, int split, int strips, vec sums[STRIPS][BAND]) {
    int64_t from = least(a->from, b->from), to = a->to > b->to ? a->to : b->to;
    for (int64_t j = from; j < to; j++)
#pragma GCC unroll 2
        for (int strip = 0; strip < strips; strip++) {
            vec x = *(const loose *)(a->light + j + strip * LANES), z = x;
            if (split < BAND - 1) z = *(const loose *)(b->light + j + strip * LANES);
#pragma GCC unroll 8
            for (int v = 0; v < BAND; v++) sums[strip][v] += psf[j * side + (v > split ? side : 0) - v] * (v > split ? z : x);
        }
}

// Convolves rows of light with a PSF. `side` is at least BAND - 1.
INLINE void convolve_rays(const ray *rays, const REAL *psf, int64_t side, int strips, vec (*total)[BAND]) {
    vec sums[STRIPS][BAND];
    memset(sums, 0, sizeof sums);
#pragma GCC unroll 7
    for (int r = 0; r < BAND - 1; r++) add_rays(rays + r, rays + r + side, psf + r, side, r, strips, sums);
    for (int64_t r = BAND - 1; r < side; r++) add_rays(rays + r, rays + r, psf + r, side, BAND - 1, strips, sums);
    for (int strip = 0; strip < strips; strip++)
        for (int v = 0; v < BAND; v++) total[strip][v] = sums[strip][v];
}

static void convolve_one(const ray *rays, const REAL *psf, int64_t side, vec (*total)[BAND]) {
    convolve_rays(rays, psf, side, 1, total);
}

// Adds the blur of weights 1: the sum over the starts and ends of runs of sign times the table's partial sum.
static void add_edges(const scene_parameters *s, const double *table, const region *a, vec total[BAND]) {
    int64_t pitch = table_pitch(s);
    dvec constant[BAND / DOUBLES] = {0};
    for (const edge *e = a->rows; e < a->rows + a->row_count; e++)
        for (int v = 0; v < BAND; v += DOUBLES)
            constant[v / DOUBLES] += e->sign * *(const dloose *)(table + table_rows(s) * pitch + e->at + v);
    for (int top = 0; top < BAND; top += EDGE_ROWS) {
        dvec sums[EDGE_ROWS][PARTS];
        for (int v = 0; v < EDGE_ROWS; v++)
            for (int p = 0; p < PARTS; p++) sums[v][p] = constant[(top + v) / DOUBLES][(top + v) % DOUBLES] - (dvec){0};
        for (const edge *e = a->columns; e < a->columns + a->column_count; e++)
#pragma GCC unroll 8
            for (int v = 0; v < EDGE_ROWS; v++)
#pragma GCC unroll 2
                for (int p = 0; p < PARTS; p++)
                    sums[v][p] += e->sign * *(const dloose *)(table + e->at - (top + v) * pitch + p * DOUBLES);
        for (int v = 0; v < EDGE_ROWS; v++)
            for (int p = 0; p < PARTS; p++) {
                part half = __builtin_convertvector(sums[v][p], part);
                memcpy((char *)&total[top + v] + p * sizeof half, &half, sizeof half);
            }
    }
}

// ---- Masked rows.

enum { LIGHT, LOWER, UPPER };

// Masks rows of light to a layer, or computes the rows of its shared weights, where the layer is present.
INLINE void mask_rows(const scene_parameters *s, const ray *rays, int32_t layer, int what, const REAL *lower, const REAL *share,
                      const REAL *light, REAL *out, int64_t pitch) {
    const vec own = (REAL)layer - (vec){0}, below = (REAL)(layer - 1) - (vec){0};
    for (int64_t r = 0; r < s->side + BAND - 1; r++) {
        if (!rays[r].light || !rays[r].to) continue;
        const REAL *l = lower + r * s->map_row, *f = share ? share + r * s->map_row : 0, *x = light + r * s->plane_row;
        for (int64_t j = 0;; j = least(j + LANES, s->side - 1)) {  // the last two vectors overlap
            vec at = *(const loose *)(l + j), weight;
            if (what == LIGHT && !share) weight = where(at == own, *(const loose *)(x + j));
            else {
                vec t = *(const loose *)(f + j);
                vec upper = where(at == below, t), rest = where(what == LOWER ? (at == own) & (t > 0) : at == own, 1 - t);
                weight = what == LIGHT ? (upper + rest) * *(const loose *)(x + j) : what == LOWER ? rest : upper;
            }
            *(loose *)(out + r * pitch + j) = weight;
            if (j == s->side - 1) break;
        }
    }
}

static void mask_light(const scene_parameters *s, const ray *rays, int32_t layer, const REAL *lower, const REAL *share,
                       const REAL *light, REAL *out, int64_t pitch) {
    if (share) mask_rows(s, rays, layer, LIGHT, lower, share, light, out, pitch);
    else mask_rows(s, rays, layer, LIGHT, lower, 0, light, out, pitch);
}

static int64_t window_pitch(const scene_parameters *s) { return (s->side + 2 * LANES) / LANES * LANES; }

// ---- Blocks.

// Rows or columns of pixels that are rendered together, within a block that begins at `at`: the last one of an image or
// a tile overlaps with others.
typedef struct {
    int64_t at, from, to, tile;
} span;

INLINE span span_at(int64_t from, int64_t end, int64_t size, int64_t pixels, int64_t tile) {
    return (span){least(from, pixels - size), from, least(from + size, end), tile};
}

// A block of one strip, at the corner of its window.
typedef struct {
    int64_t image;
    span rows, columns;
    int64_t light;  // of the first channel's pixel in `plane`
    const REAL *lower, *share;
    int layers;
} block;

static block block_at(const scene_parameters *s, workspace *d, int64_t image, span rows, span columns) {
    const int64_t corner = image * s->map_image + rows.at * s->map_row + columns.at;
    const int64_t light = image * s->plane_image + rows.at * s->plane_row + columns.at;
    int count = list_layers(s, d, s->side + BAND - 1, columns.at, s->side + LANES - 1);
    return (block){image, rows, columns, light, s->lower + corner, s->share ? s->share + corner : 0, count};
}

// What a term of a tile's PSF is multiplied by in a row of the block: 1, x or y.
INLINE vec factor(const scene_parameters *s, const block *b, int order, int v) {
    if (order == ALONG_X) return steps() + ((REAL)b->columns.at - s->over.column_middles[b->columns.tile]);
    return all(order == ALONG_Y ? (REAL)(b->rows.at + v) - s->over.row_middles[b->rows.tile] : 1);
}

// Renders a block of some strips with a single layer in its window: ((1 - veil) L + veil mean A) / A.
static void lay_alone(const scene_parameters *s, workspace *d, const double *tables, int64_t image, span lines, int64_t x) {
    const int64_t y = lines.at, layer = d->heads[0]->layer, area = s->side * s->side;
    for (int64_t c = 0; c < s->channels; c++) {
        REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + x;
        const REAL *plane = s->plane + image * s->plane_image + c * s->plane_channel + y * s->plane_row + x;
        for (int64_t r = 0; r < s->side + BAND - 1; r++) d->rays[r] = (ray){plane + r * s->plane_row, 0, s->side};
        vec light[STRIPS][BAND];
        convolve_rays(d->rays, s->psfs + (layer * s->channels + c) * area, s->side, STRIPS, light);
        REAL whole = tables[(layer * s->channels + c) * table_size(s) + table_rows(s) * (table_pitch(s) + 1) - 1];
        REAL veil = s->veil ? s->veil[layer * s->channels + c] : 0;
        REAL glow = s->veil ? veil * s->mean[image * s->channels + c] * whole : 0;
        REAL divisor = (whole > 0 ? whole : 0) + EPSILON;
        for (int v = lines.from - y; v < BAND; v++)
            for (int strip = 0; strip < STRIPS; strip++)
                *(loose *)(out + v * s->width + strip * LANES) = ((1 - veil) * light[strip][v] + glow) / divisor;
    }
}

// Finds a layer in a window, and the rows of its shared weights.
static void find_layer(const scene_parameters *s, workspace *d, const block *b, int32_t layer, int copied) {
    outline *o = &d->outline;
    draw_outline(s, d, b->columns.at, layer, window_pitch(s), copied);
    if (o->lower_count) mask_rows(s, o->lower, layer, LOWER, b->lower, b->share, b->lower, d->rows[1], window_pitch(s));
    if (o->upper_count) mask_rows(s, o->upper, layer, UPPER, b->lower, b->share, b->lower, d->rows[2], window_pitch(s));
}

// Masks the light of the layer that was found, in one channel.
static void find_light(const scene_parameters *s, workspace *d, const block *b, int32_t layer, int64_t c) {
    const REAL *plane = s->plane + b->light + c * s->plane_channel;
    for (int64_t r = 0; r < s->side + BAND - 1; r++) {
        d->rays[r] = d->outline.light[r];
        if (!d->rays[r].light) d->rays[r].light = plane + r * s->plane_row;
    }
    mask_light(s, d->outline.light, layer, b->lower, b->share, plane, d->rows[0], window_pitch(s));
}

// Blurs light, alpha and cumulative alpha of the n-th layer from near by a PSF. The layer and its light were found.
INLINE void blur(const scene_parameters *s, workspace *d, const REAL *psf, const double *table, const block *b, int n,
                 vec (*light)[BAND], vec (*own)[BAND], vec (*seen)[BAND]) {
    const outline *o = &d->outline;
    vec weight[1][BAND];
    convolve_one(d->rays, psf, s->side, light);
    add_edges(s, table, &o->own, *own);
    if (n == b->layers - 1) memcpy(seen, own, sizeof *seen);  // the farthest layer: the cumulative alpha is its own
    else add_edges(s, table, &o->behind, *seen);
    if (o->lower_count) {
        convolve_one(o->lower, psf, s->side, weight);
        for (int v = 0; v < BAND; v++) own[0][v] += weight[0][v], seen[0][v] += weight[0][v];
    }
    if (o->upper_count) {
        convolve_one(o->upper, psf, s->side, weight);
        for (int v = 0; v < BAND; v++) own[0][v] += weight[0][v];
    }
}

// Blurs planes as above in one channel, by the PSF of each pixel, whose light goes to `lit`.
static void blur_over_field(const scene_parameters *s, workspace *d, const block *b, int n, int64_t c, vec (*light)[BAND],
                            vec (*own)[BAND], vec (*seen)[BAND], vec *lit) {
    const int64_t plane = d->members[n] * s->channels + c, area = s->side * s->side, vectors = d->psfs.vectors;
    blend_nodes(&d->psfs, plane, s->psfs + plane * area, s->layers * s->channels * area, 1);
    blend_line(&d->psfs, plane, b->columns.tile, d->psf);
    for (int order = 0; order < ORDERS; order++) {
        if (!has_order(&s->over, b->rows.tile, b->columns.tile, order)) continue;
        double *table = d->tables + order * table_size(s);
        vec more[3][1][BAND], sum = {0};
        fill_table(s, (REAL *)(d->psf + order * vectors), table);
        for (int64_t k = 0; k < vectors; k++) sum += d->psf[order * vectors + k];
        blur(s, d, (REAL *)(d->psf + order * vectors), table, b, n, more[0], more[1], more[2]);
        const REAL whole = sum_of(sum);
        for (int v = 0; v < BAND; v++) {
            const vec times = factor(s, b, order, v);
            light[0][v] = times * more[0][0][v] + (order ? light[0][v] : all(0));
            own[0][v] = times * more[1][0][v] + (order ? own[0][v] : all(0));
            seen[0][v] = times * more[2][0][v] + (order ? seen[0][v] : all(0));
            lit[v] = times * whole + (order ? lit[v] : all(0));
        }
    }
}

// Blurs the n-th layer from near, which was found, in one channel. `lit` is only written with PSFs over the field.
INLINE void blur_layer(const scene_parameters *s, workspace *d, const double *tables, const block *b, int n, int64_t c,
                       vec (*light)[BAND], vec (*own)[BAND], vec (*seen)[BAND], vec *lit) {
    const int64_t plane = d->members[n] * s->channels + c;
    find_light(s, d, b, d->members[n], c);
    if (s->over.node_rows) blur_over_field(s, d, b, n, c, light, own, seen, lit);
    else blur(s, d, s->psfs + plane * s->side * s->side, tables + plane * table_size(s), b, n, light, own, seen);
}

// Renders a block of one strip by compositing its layers from near to far.
static void lay_over(const scene_parameters *s, workspace *d, const double *tables, int64_t image, span rows, span columns) {
    const block b = block_at(s, d, image, rows, columns);
    vec(*total)[BAND] = d->total, (*through)[BAND] = d->through;
    for (int64_t c = 0; c < s->channels; c++)
        for (int v = 0; v < BAND; v++) total[c][v] = (vec){0}, through[c][v] = 1 - (vec){0};
    for (int n = 0; n < b.layers; n++) {
        int32_t layer = d->members[n];
        find_layer(s, d, &b, layer, 0);
        for (int64_t c = 0; c < s->channels; c++) {
            vec light[1][BAND], own[1][BAND], seen[1][BAND], lit[BAND];
            blur_layer(s, d, tables, &b, n, c, light, own, seen, lit);
            REAL veil = s->veil ? s->veil[layer * s->channels + c] : 0;
            REAL glow = s->veil ? veil * s->mean[image * s->channels + c] : 0;
            for (int v = 0; v < BAND; v++) {
                vec passed = through[c][v] / (where(seen[0][v] > 0, seen[0][v]) + EPSILON);
                if (s->over.node_rows) light[0][v] *= lit[v];
                total[c][v] += passed * ((1 - veil) * light[0][v] + glow * own[0][v]);
                through[c][v] -= passed * own[0][v];
            }
        }
    }
    const int64_t first = columns.from - columns.at, count = columns.to - columns.from;
    for (int64_t c = 0; c < s->channels; c++)
        for (int64_t y = rows.from; y < rows.to; y++) {
            REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + columns.from;
            const REAL *from = (const REAL *)&total[c][y - rows.at] + first;
            store_some(out, from, count);
        }
}

// Counts of operations for the cost of a scene, see `count_operations` in occlusion_ops.py.
enum { PAIRS, COLUMNS, EDGES, COUNTS };

static int64_t count_columns(const ray *rays, int64_t side) {
    int64_t columns = 0;
    for (int64_t r = 0; r < side; r++) {
        const ray *a = rays + r, *b = r < BAND - 1 ? a + side : a;
        int64_t from = least(a->from, b->from), to = a->to > b->to ? a->to : b->to;
        if (to > from) columns += to - from;
    }
    return columns;
}

static void count_block(const scene_parameters *s, workspace *d, int64_t x, int64_t counts[COUNTS]) {
    int count = list_layers(s, d, s->side + BAND - 1, x, s->side + LANES - 1);
    const outline *o = &d->outline;
    counts[PAIRS] += count;
    for (int n = 0; n < count; n++) {
        draw_outline(s, d, x, d->members[n], window_pitch(s), 0);
        counts[COLUMNS] += count_columns(o->light, s->side);
        if (o->lower_count) counts[COLUMNS] += count_columns(o->lower, s->side);
        if (o->upper_count) counts[COLUMNS] += count_columns(o->upper, s->side);
        counts[EDGES] += o->own.column_count + (n < count - 1 ? o->behind.column_count : 0);
    }
}

// ---- Workspaces.

static workspace take_workspace(pool *p, const scene_parameters *s) {
    const int64_t rows = s->side + BAND - 1, ends = rows * (s->side + LANES - 1), pitch = window_pitch(s);
    workspace d = {.psfs = take_lines(p, &s->over, s->layers * s->channels, s->side * s->side)};
    outline *o = &d.outline;
    d.runs = take(p, rows * (s->width + s->side), sizeof(run));
    d.made = take(p, rows, sizeof *d.made), d.heads = take(p, rows, sizeof *d.heads);
    d.members = take(p, s->layers + 1, sizeof *d.members), d.stamps = take_zeros(p, s->layers + 1, sizeof *d.stamps);
    for (int n = 0; n < 3; n++) d.rows[n] = take_zeros(p, rows * pitch, sizeof(REAL));
    d.nothing = take_zeros(p, pitch, sizeof(REAL));
    d.total = take(p, s->channels, sizeof *d.total), d.through = take(p, s->channels, sizeof *d.through);
    d.rays = take(p, rows, sizeof(ray)), o->light = take(p, rows, sizeof(ray));
    o->lower = take(p, rows, sizeof(ray)), o->upper = take(p, rows, sizeof(ray));
    o->own.columns = take(p, ends, sizeof(edge)), o->behind.columns = take(p, ends, sizeof(edge));
    o->own.rows = take(p, rows, sizeof(edge)), o->behind.rows = take(p, rows, sizeof(edge));
    d.kept = take(p, s->gradient ? (s->layers + 1) * s->channels : 0, sizeof *d.kept);
    d.psf = take(p, ORDERS * d.psfs.vectors, sizeof(vec));
    d.tables = take(p, (s->over.node_rows ? ORDERS : 0) * table_size(s), sizeof(double));
    for (int64_t r = 0; !p->missing && r < rows; r++) d.made[r] = -1;
    return d;
}

// How many tables all blocks share: none where they have PSFs of their own.
static int64_t tables_of(const scene_parameters *s) { return s->over.node_rows ? 0 : s->layers * s->channels; }

// Rows of tiles or, with the same PSFs everywhere, bands of blocks.
static int64_t bands_of(const scene_parameters *s) { return s->over.node_rows ? s->over.down : (s->height + BAND - 1) / BAND; }

// Finds the rows of a band, with the runs of their windows.
static span begin_band(const scene_parameters *s, workspace *d, int64_t image, int64_t band) {
    const int64_t *edges = s->over.row_edges;
    const span rows = s->over.node_rows ? span_at(edges[band], edges[band + 1], BAND, s->height, band)
                                        : span_at(band * BAND, s->height, BAND, s->height, band);
    find_runs_of_band(s, d, image, rows.at);
    if (s->over.node_rows) begin_row(&d->psfs, band);
    return rows;
}

// The block after some columns of a band, in one tile.
static span next_block(const scene_parameters *s, span columns) {
    const int64_t *edges = s->over.column_edges;
    int64_t tile = columns.tile, end = s->width;
    if (s->over.node_rows) {
        tile += columns.to == edges[tile + 1];
        end = edges[tile + 1];
    }
    return span_at(columns.to, end, LANES, s->width, tile);
}

// Renders a band or, with `counts`, only counts its operations.
static void lay_band(const scene_parameters *s, workspace *d, const double *tables, int64_t n, int64_t *counts) {
    const int64_t height = s->side + BAND - 1, image = n / bands_of(s);
    const span rows = begin_band(s, d, image, n % bands_of(s));
    for (span x = {0}; x.to < s->width;) {
        x = next_block(s, x);
        int alone = move_heads(d, height, x.at, s->side + WIDTH - 1) && d->heads[0]->layer < s->layers;
        alone &= !s->over.node_rows && x.at + WIDTH <= s->width;
        if (counts && alone) counts[PAIRS]++, counts[COLUMNS] += STRIPS * s->side * s->side;
        else if (counts) count_block(s, d, x.at, counts);
        else if (alone) lay_alone(s, d, tables, image, rows, x.at);
        else lay_over(s, d, tables, image, rows, x);
        if (alone) x.to += WIDTH - LANES;
    }
}

// Counts the operations of every `every`-th band as of vectors of 64 bytes, which costs are known for. Only what a pair
// takes, the outline of a layer and its masks, is as much for narrow vectors. Returns 0 or NO_MEMORY.
int count(const scene_parameters *s) {
    pool p = {0};
    workspace d = take_workspace(&p, s);
    const int64_t bands = p.missing ? 0 : s->images * bands_of(s);
    for (int64_t n = s->every / 2; n < bands; n += s->every) lay_band(s, &d, 0, n, s->counts);
    for (int n = 0; n < COUNTS; n++)
        if (n != PAIRS) s->counts[n] = s->counts[n] * VECTOR_BYTES / 64;
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}

static double *take_tables(pool *p, const scene_parameters *s) {
    double *tables = take(p, tables_of(s) * table_size(s), sizeof(double));
    const int64_t count = tables ? tables_of(s) : 0;
#pragma omp parallel for num_threads(s->threads)
    for (int64_t n = 0; n < count; n++) fill_table(s, s->psfs + n * s->side * s->side, tables + n * table_size(s));
    return tables;
}

// Renders a scene by occlusion-aware compositing of its layers. Returns 0 or NO_MEMORY.
int occlude(const scene_parameters *s) {
    pool p = {0};
    const double *tables = take_tables(&p, s);
    workspace spaces[s->threads];
    for (int64_t n = 0; n < s->threads; n++) spaces[n] = take_workspace(&p, s);
    const int64_t bands = p.missing ? 0 : s->images * bands_of(s);
#pragma omp parallel for schedule(dynamic, 4) num_threads(s->threads)
    for (int64_t n = 0; n < bands; n++) lay_band(s, spaces + thread_number(), tables, n, 0);
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}

// ---- Gradients of the light, of the PSFs and of stray light. Each block is rendered again.

enum { LINES = 4, SPAN = REGISTERS / 8 };  // rows of a PSF, and vectors of each, whose sums stay in registers

// Gradients of a thread, by layer and channel.
typedef struct {
    double *tables, *psfs, *veil, *mean;  // the last three one after the other
    REAL *light;  // of the plane
    REAL *rows;   // of a window, which a block's light is spread to, by
    REAL *psf;    // a PSF with BAND - 1 zeros above and below it, columns first
    REAL *band;   // of PSFs, (LINES side / LINES, pitch) rounded up, of the blocks of one band
    char *met;    // whether a block of the band has the layer
    int64_t pitch, size;
    lines lines;  // of a row of tiles, and
    vec *nodes;   // of all of them, with PSFs over the field
} tally;

static int64_t plane_numbers(const scene_parameters *s) {
    return s->images * s->channels * (s->height + s->side - 1) * (s->width + s->side - 1);
}

// Of nodes over the field, or one.
static int64_t nodes_of(const scene_parameters *s) { return s->over.node_rows ? s->over.node_rows * s->over.node_columns : 1; }

static tally take_tally(pool *p, const scene_parameters *s) {
    const int64_t planes = s->layers * s->channels, area = s->side * s->side, pitch = (s->side + LANES - 1) / LANES * LANES;
    tally t = {.pitch = pitch, .size = (s->side + LINES - 1) / LINES * LINES * pitch};
    t.lines = take_lines(p, &s->over, planes, area);
    const int64_t numbers = nodes_of(s) * planes * area;
    t.tables = take_zeros(p, planes * table_size(s), sizeof(double));
    t.psfs = take_zeros(p, numbers + planes + s->images * s->channels, sizeof(double));
    t.veil = t.psfs + numbers, t.mean = t.veil + planes;
    t.band = take_zeros(p, planes * t.size, sizeof(REAL));
    t.light = take_zeros(p, s->plane_gradient ? plane_numbers(s) : 0, sizeof(REAL));
    t.rows = take(p, (s->side + BAND - 1) * window_pitch(s), sizeof(REAL));
    t.psf = take_zeros(p, s->side * (s->side + 2 * BAND - 2), sizeof(REAL));
    t.met = take_zeros(p, s->layers, 1);
    t.nodes = take_zeros(p, nodes_of(s) * planes * t.lines.vectors, sizeof(vec));
    return t;
}

// Adds the products of a row of light, the r-th, with the block's rows that it meets for lines `first` to `last`.
INLINE void add_row(const ray *row, REAL (*block)[LANES], int64_t r, int first, int last, int64_t j, int width, vec (*sums)[SPAN]) {
    if (!row->to) return;
    for (int lane = 0; lane < LANES; lane++)
#pragma GCC unroll 4
        for (int k = 0; k < width; k++) {
            const vec light = *(const loose *)(row->light + j + lane + k * LANES);
#pragma GCC unroll 4
            for (int q = first; q <= last; q++) sums[q][k] += block[r - q][lane] * light;
        }
}

// Adds to LINES rows of `total` the correlation of `count` rows of light with a block.
INLINE void correlate_lines(const ray *rays, int64_t count, REAL (*block)[LANES], int64_t j, int width, int64_t pitch, REAL *total) {
    vec sums[LINES][SPAN];
    for (int q = 0; q < LINES; q++)
        for (int k = 0; k < width; k++) sums[q][k] = *(const loose *)(total + q * pitch + j + k * LANES);
#pragma GCC unroll 3
    for (int r = 0; r < LINES - 1; r++) add_row(rays + r, block, r, 0, r, j, width, sums);
    for (int64_t r = LINES - 1; r < BAND; r++) add_row(rays + r, block, r, 0, LINES - 1, j, width, sums);
#pragma GCC unroll 3
    for (int r = BAND; r < BAND + LINES - 1; r++)
        if (r < count) add_row(rays + r, block, r, r - BAND + 1, LINES - 1, j, width, sums);
    for (int q = 0; q < LINES; q++)
        for (int k = 0; k < width; k++) *(loose *)(total + q * pitch + j + k * LANES) = sums[q][k];
}

// Adds the gradient of a PSF, whose convolution with rows of light has the gradient `block`: the transpose of convolve_one.
static void correlate_rays(const ray *rays, const vec *block, int64_t side, const tally *t, REAL *total) {
    REAL rows[BAND][LANES];
    memcpy(rows, block, sizeof rows);
    for (int64_t i = 0; i < side; i += LINES, total += LINES * t->pitch) {
        const int64_t count = least(LINES, side - i) + BAND - 1;
        int64_t from = side, to = 0;
        for (const ray *r = rays + i; r < rays + i + count; r++) {
            if (r->to && r->from < from) from = r->from;
            if (r->to > to) to = r->to;
        }
        int64_t j = from / LANES * LANES;
        for (; j + (SPAN - 1) * LANES < to; j += SPAN * LANES) correlate_lines(rays + i, count, rows, j, SPAN, t->pitch, total);
        for (; j + LANES < to; j += 2 * LANES) correlate_lines(rays + i, count, rows, j, 2, t->pitch, total);
        if (j < to) correlate_lines(rays + i, count, rows, j, 1, t->pitch, total);
    }
}

// The transpose of add_edges.
static void spread_edges(const scene_parameters *s, double *table, const region *a, const vec *block) {
    const int64_t pitch = table_pitch(s);
    dvec parts[BAND][PARTS];
    double sums[BAND] = {0};
    for (int v = 0; v < BAND; v++)
        for (int p = 0; p < PARTS; p++) {
            part half;
            memcpy(&half, (const char *)(block + v) + p * sizeof half, sizeof half);
            parts[v][p] = __builtin_convertvector(half, dvec);
            for (int n = 0; n < DOUBLES; n++) sums[v] += parts[v][p][n];
        }
    for (const edge *e = a->rows; e < a->rows + a->row_count; e++)
        for (int v = 0; v < BAND; v++) table[table_rows(s) * pitch + e->at + v] += e->sign * sums[v];
    for (const edge *e = a->columns; e < a->columns + a->column_count; e++)
        for (int v = 0; v < BAND; v++)
            for (int p = 0; p < PARTS; p++) *(dloose *)(table + e->at - v * pitch + p * DOUBLES) += e->sign * parts[v][p];
}

// The transpose of fill_table: adds to the gradient of a PSF, and leaves partial sums in the table.
static void fold_table(const scene_parameters *s, double *table, double *psf) {
    const int64_t pitch = table_pitch(s), rows = table_rows(s);
    double *ends = table + rows * pitch;
    for (int64_t u = rows - 2; u >= 0; u--) ends[u] += ends[u + 1];
    for (int64_t k = 0; k < s->side; k++) {
        double sum = ends[s->side + BAND - 2 - k], *row = table + (BAND - 1 + k) * pitch;
        for (int64_t u = pitch - 1; u >= 0; u--) {
            int64_t column = s->side + LANES - 2 - u;
            sum += row[u];
            if (column >= 0 && column < s->side) psf[column * s->side + k] += sum;
        }
    }
}

// Renders the layers of a block, and keeps what gradients are made of.
static void keep_layers(const scene_parameters *s, workspace *d, const double *tables, const block *b) {
    vec(*through)[BAND] = d->through;
    for (int64_t c = 0; c < s->channels; c++)
        for (int v = 0; v < BAND; v++) through[c][v] = 1 - (vec){0};
    for (int n = 0; n < b->layers; n++) {
        find_layer(s, d, b, d->members[n], 1);
        for (int64_t c = 0; c < s->channels; c++) {
            vec(*k)[BAND] = d->kept[n * s->channels + c];
            blur_layer(s, d, tables, b, n, c, k + BLURRED, k + ALPHA, k + CUMULATIVE, k[LIT]);
            for (int v = 0; v < BAND; v++) {
                k[DIVISOR][v] = where(k[CUMULATIVE][v] > 0, k[CUMULATIVE][v]) + EPSILON;
                k[PASSED][v] = through[c][v] / k[DIVISOR][v];
                through[c][v] -= k[PASSED][v] * k[ALPHA][v];
            }
        }
    }
}

// Makes of what was kept the gradients of the blurred planes, and of the PSF's light, from far to near.
static void turn_back(const scene_parameters *s, workspace *d, tally *t, const block *b) {
    const span rows = b->rows, columns = b->columns;
    vec(*through)[BAND] = d->through;  // its gradient
    for (int64_t c = 0; c < s->channels; c++) {
        vec gradient[BAND];
        for (int v = 0; v < BAND; v++) {
            const int64_t y = rows.at + v, row = ((b->image * s->channels + c) * s->height + y) * s->width;
            gradient[v] = (vec){0};  // of pixels that other blocks render
            if (y >= rows.from && y < rows.to)
                for (int64_t x = columns.from; x < columns.to; x++) gradient[v][x - columns.at] = s->gradient[row + x];
            through[c][v] = (vec){0};
        }
        for (int n = b->layers - 1; n >= 0; n--) {
            const int64_t plane = d->members[n] * s->channels + c;
            const REAL veil = s->veil ? s->veil[plane] : 0, mean = s->veil ? s->mean[b->image * s->channels + c] : 0;
            vec(*k)[BAND] = d->kept[n * s->channels + c], of_veil = {0}, of_mean = {0};
            for (int v = 0; v < BAND; v++) {
                const vec lit = s->over.node_rows ? k[LIT][v] : all(1), blurred = k[BLURRED][v], light = lit * blurred;
                vec own = k[ALPHA][v], divisor = k[DIVISOR][v], passed = k[PASSED][v];
                vec of_passed = gradient[v] * ((1 - veil) * light + veil * mean * own) - through[c][v] * own;
                of_veil += gradient[v] * passed * (mean * own - light);
                of_mean += gradient[v] * passed * own;
                k[BLURRED][v] = (1 - veil) * gradient[v] * passed * lit;
                k[LIT][v] = (1 - veil) * gradient[v] * passed * blurred;
                k[ALPHA][v] = passed * (veil * mean * gradient[v] - through[c][v]);
                k[CUMULATIVE][v] = where(divisor > EPSILON, -of_passed * passed / divisor);
                through[c][v] += of_passed / divisor;
            }
            t->veil[plane] += sum_of(of_veil);
            t->mean[b->image * s->channels + c] += veil * sum_of(of_mean);
        }
    }
}

// Adds the gradient of a PSF that has blurred the n-th layer, from those of its planes times 1, x or y.
static void add_layer(const scene_parameters *s, workspace *d, const tally *t, const block *b, int n, int64_t c, int order,
                      REAL *total, double *table) {
    const outline *o = &d->outline;
    vec planes[CUMULATIVE + 1][BAND], both[BAND];
    for (int k = 0; k <= CUMULATIVE; k++)
        for (int v = 0; v < BAND; v++) planes[k][v] = factor(s, b, order, v) * d->kept[n * s->channels + c][k][v];
    for (int v = 0; v < BAND; v++) both[v] = planes[ALPHA][v] + planes[CUMULATIVE][v];
    correlate_rays(d->rays, planes[BLURRED], s->side, t, total);
    if (n < b->layers - 1) spread_edges(s, table, &o->behind, planes[CUMULATIVE]);
    spread_edges(s, table, &o->own, n < b->layers - 1 ? planes[ALPHA] : both);
    if (o->lower_count) correlate_rays(o->lower, both, s->side, t, total);
    if (o->upper_count) correlate_rays(o->upper, planes[ALPHA], s->side, t, total);
}

// Adds the gradient of a layer's PSF in a tile to those of its row of tiles.
static void add_over_field(const scene_parameters *s, workspace *d, tally *t, const block *b, int n, int64_t c) {
    const int64_t plane = d->members[n] * s->channels + c, vectors = t->lines.vectors, area = s->side * s->side;
    memset(d->psf, 0, ORDERS * vectors * sizeof(vec));
    for (int order = 0; order < ORDERS; order++) {
        if (!has_order(&s->over, b->rows.tile, b->columns.tile, order)) continue;
        REAL *psf = (REAL *)(d->psf + order * vectors);
        vec of_light = {0};
        memset(t->band, 0, t->size * sizeof(REAL)), memset(t->tables, 0, table_size(s) * sizeof(double));
        memset(t->psfs, 0, area * sizeof(double));
        add_layer(s, d, t, b, n, c, order, t->band, t->tables);
        fold_table(s, t->tables, t->psfs);
        for (int v = 0; v < BAND; v++) of_light += factor(s, b, order, v) * d->kept[n * s->channels + c][LIT][v];
        const REAL whole = sum_of(of_light);
        for (int64_t j = 0; j < s->side; j++)
            for (int64_t i = 0; i < s->side; i++)
                psf[j * s->side + i] = whole + t->band[i * t->pitch + j] + (REAL)t->psfs[j * s->side + i];
    }
    spread_tile(&t->lines, plane, b->columns.tile, d->psf);
}

// Adds to rows of light the transpose of convolve_one, of a block's light. Neighbours in a row are added one round after the
// other, when what was stored is in memory.
static void spread_rays(const ray *rays, const REAL *psf, const vec *light, int64_t side, int64_t pitch, const tally *t) {
    const int64_t rows = side + BAND - 1, height = rows + BAND - 1;
    for (int64_t j = 0; j < side; j++) memcpy(t->psf + j * height + BAND - 1, psf + j * side, side * sizeof(REAL));
    for (int64_t lane = 0; lane < LANES; lane++)
        for (int64_t r = 0; r < rows; r++) {
            const int64_t from = rays[r].from, first = from + (lane + LANES - from % LANES) % LANES;
            for (int64_t j = first; j < rays[r].to; j += LANES) {
                REAL *to = t->rows + r * pitch + j;
                vec sum = *(const loose *)to;
#pragma GCC unroll 8
                for (int v = 0; v < BAND; v++) sum += t->psf[j * height + r + BAND - 1 - v] * light[v];
                *(loose *)to = sum;
            }
        }
}

// Adds the gradient of a layer's light, which was found, to that of the plane.
static void spread_light(const scene_parameters *s, workspace *d, tally *t, const block *b, int32_t layer, int64_t c,
                         const vec *light) {
    const int64_t side = s->side, rows = side + BAND - 1, pitch = window_pitch(s), plane = layer * s->channels + c;
    memset(t->rows, 0, rows * pitch * sizeof(REAL));
    if (s->over.node_rows) blend_line(&d->psfs, plane, b->columns.tile, d->psf);
    for (int order = 0; order < ORDERS; order++) {
        if (!has_order(&s->over, b->rows.tile, b->columns.tile, order)) continue;
        const REAL *psf = s->over.node_rows ? (REAL *)(d->psf + order * d->psfs.vectors) : s->psfs + plane * side * side;
        vec times[BAND];
        for (int v = 0; v < BAND; v++) times[v] = factor(s, b, order, v) * light[v];
        spread_rays(d->rays, psf, times, side, pitch, t);
    }
    for (int64_t r = 0; r < rows; r++) {
        const REAL *lower = b->lower + r * s->map_row, *share = b->share ? b->share + r * s->map_row : 0;
        REAL *to = t->light + b->light + c * s->plane_channel + r * s->plane_row;
        for (int64_t x = 0; d->rays[r].to && x < side + LANES - 1; x++) {
            const REAL next = share ? share[x] : 0;
            to[x] += (lower[x] == layer ? 1 - next : lower[x] == layer - 1 ? next : 0) * t->rows[r * pitch + x];
        }
    }
}

// Adds the gradients of light and PSFs from those of the planes that the PSFs have blurred.
static void add_layers(const scene_parameters *s, workspace *d, tally *t, const block *b) {
    for (int n = 0; n < b->layers; n++) {
        const int32_t layer = d->members[n];
        find_layer(s, d, b, layer, 1);
        t->met[layer] = 1;
        for (int64_t c = 0; c < s->channels; c++) {
            const int64_t plane = layer * s->channels + c;
            find_light(s, d, b, layer, c);
            if (s->plane_gradient) spread_light(s, d, t, b, layer, c, d->kept[n * s->channels + c][BLURRED]);
            if (!s->psf_gradient) continue;
            if (s->over.node_rows) add_over_field(s, d, t, b, n, c);
            else add_layer(s, d, t, b, n, c, VALUE, t->band + plane * t->size, t->tables + plane * table_size(s));
        }
    }
}

static void go_back(const scene_parameters *s, workspace *d, tally *t, const double *tables, int64_t n) {
    const int64_t image = n / bands_of(s), area = s->side * s->side, planes = s->layers * s->channels;
    const span rows = begin_band(s, d, image, n % bands_of(s));
    t->lines.row = -1;
    if (s->over.node_rows) begin_row(&t->lines, rows.tile);
    for (span x = {0}; x.to < s->width;) {
        x = next_block(s, x);
        move_heads(d, s->side + BAND - 1, x.at, 0);
        const block b = block_at(s, d, image, rows, x);
        keep_layers(s, d, tables, &b);
        turn_back(s, d, t, &b);
        add_layers(s, d, t, &b);
    }
    for (int64_t n = 0; n < planes; n++) {
        if (s->over.node_rows) spread_line(&t->lines, n, t->nodes + n * t->lines.vectors, planes * t->lines.vectors);
        if (s->over.node_rows || !t->met[n / s->channels]) continue;
        REAL *total = t->band + n * t->size;
        for (int64_t i = 0; i < s->side; i++)
            for (int64_t j = 0; j < s->side; j++) t->psfs[n * area + j * s->side + i] += total[i * t->pitch + j];
        memset(total, 0, t->size * sizeof *total);
    }
    memset(t->met, 0, s->layers);
}

// Sums numbers of all threads in their order, from one of those at `psfs` on.
static void sum_threads(const scene_parameters *s, const tally *tallies, int64_t first, int64_t count, REAL *out) {
    for (int64_t n = 0; out && n < count; n++) {
        double sum = 0;
        for (int64_t thread = 0; thread < s->threads; thread++) sum += tallies[thread].psfs[first + n];
        out[n] = sum;
    }
}

// Computes the gradients that are asked for from that of the light. Each thread sums bands, always the same ones, and threads
// are summed in their order. Returns 0 or NO_MEMORY.
int occlusion_gradients(const scene_parameters *s) {
    const int64_t all = s->layers * s->channels, area = s->side * s->side, numbers = nodes_of(s) * all * area;
    pool p = {0};
    const double *tables = take_tables(&p, s);
    workspace spaces[s->threads];
    tally tallies[s->threads];
    for (int64_t n = 0; n < s->threads; n++) spaces[n] = take_workspace(&p, s), tallies[n] = take_tally(&p, s);
    const int64_t bands = s->images * bands_of(s), threads = p.missing ? 0 : s->threads;
#pragma omp parallel for schedule(static, 1) num_threads(s->threads)
    for (int64_t thread = 0; thread < threads; thread++) {
        tally *t = tallies + thread;
        for (int64_t n = bands * thread / threads; n < bands * (thread + 1) / threads; n++)
            go_back(s, spaces + thread, t, tables, n);
        for (int64_t n = 0; n < tables_of(s); n++) fold_table(s, t->tables + n * table_size(s), t->psfs + n * area);
        for (int64_t n = 0; s->over.node_rows && s->psf_gradient && n < numbers; n++)
            t->psfs[n] = ((REAL *)t->nodes)[n / area * t->lines.vectors * LANES + n % area];
    }
    if (threads) {
        sum_threads(s, tallies, 0, numbers, s->psf_gradient);
        sum_threads(s, tallies, numbers, all, s->veil_gradient);
        sum_threads(s, tallies, numbers + all, s->images * s->channels, s->mean_gradient);
    }
    for (int64_t thread = 0; thread < threads && s->plane_gradient; thread++)
        for (int64_t n = 0; n < plane_numbers(s); n++)
            s->plane_gradient[n] = tallies[thread].light[n] + (thread ? s->plane_gradient[n] : 0);
    free_all(&p);
    return p.missing ? NO_MEMORY : 0;
}
