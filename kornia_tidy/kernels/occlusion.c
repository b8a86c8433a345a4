// Occlusion by direct convolution: a block of pixels meets the layers of its window, each only in the rows and columns
// where it is.
//
// A block is BAND rows of LANES pixels, and its sums stay in registers. All that is added up is positive, so that
// sample by sample in REAL it keeps its relative accuracy however small it is (transforms do not).
//
// - Light is convolved, masked to a layer. A row of it above and one below the window's middle together serve each of
//   the block's rows once: no product is wasted.
// - Weights are whole ones along runs of pixels. The blur of a run is a difference of two sums over a PSF's row, one for
//   each of its ends: looked up in double, since differences do keep only their absolute accuracy.
// - Weights that are shared by two layers are convolved like light.
//
// Compiled by build.py with REAL as float or double.

#include "direct.c"

enum { BAND = 8, DOUBLES = 8, PARTS = LANES / DOUBLES };

typedef double dvec __attribute__((vector_size(64)));
typedef double dloose __attribute__((vector_size(64), aligned(8), may_alias));
typedef REAL part __attribute__((vector_size(DOUBLES * sizeof(REAL))));

static const REAL EPSILON = 1e-6;  // as in dense_occlusion.py

// The fields of `_Scene` in occlusion_ops.py. Widths and heights are those of the output; planes are larger by side - 1.
typedef struct {
    int64_t images, channels, height, width, layers, side, threads;
    int64_t plane_image, plane_channel, plane_row, map_image, map_row;
    const REAL *plane;  // light
    const REAL *psfs;   // (layers, channels, side, side), flipped, columns first
    const REAL *lower;  // layers of the plane's pixels; `layers` and more: in none
    const REAL *share;  // below 1: of the next layer; like lower, or null
    const REAL *mean;   // (images, channels) light that strays, or null
    const REAL *stray_light;   // (layers, channels)
    REAL *out;          // (images, channels, height, width)
} scene_parameters;

// Pixels of one row and one `lower`, up to the next run: either all of them share light with the next layer, or none.
typedef struct {
    int32_t start, layer, shared;
} run;

// A row of light or weights, and the columns of the PSF that meet any of it.
typedef struct {
    const REAL *light;
    int32_t from, to;
} ray;

// Where whole weights begin (sign 1) or end (-1), as a place in the tables of sums.
typedef struct {
    int64_t at;
    double sign;
} edge;

// Whole weights in a window: where they begin and end within rows, and from which row to which they fill rows' starts.
typedef struct {
    edge *columns, *rows;
    int column_count, row_count, open;
} region;

typedef struct {
    ray *light, *lower, *upper;  // of a layer: all of its light; shared weights of runs whose `lower` it is, or is the next
    int lower_count, upper_count;
    region own, behind;  // of whole weights of the layer; and of it and all behind it
} outline;

// What a thread works with.
typedef struct {
    run *runs;          // of the rows of a window, at row % rows
    int64_t *made;      // which row of all maps they are of
    const run **heads;  // the runs in which the rows of a window begin
    int32_t *members;   // layers in the window, near to far
    int64_t *stamps;    // by layer: the window it was last seen in
    int64_t window;
    REAL *rows[3];      // masked: light, shared weights of runs whose `lower` the layer is, or is the next
    REAL *nothing;      // a row of zeros
    ray *rays;          // of one channel
    vec (*total)[BAND], (*through)[BAND];  // by channel: light of the layers so far, and how much they let through
    outline outline;
    void *all[20];
    int count;
} workspace;

// ---- Tables: sums over the ends of a PSF's rows.
// rows (side + 2 BAND - 2, pitch): row BAND - 1 + k holds, rising by u, the sum of row k's samples from column
// side + LANES - 2 - u on; rows beyond the PSF hold zeros. Then the sums of all rows from k = side + BAND - 2 - u on.

static int64_t table_pitch(const scene_parameters *s) { return s->side + 2 * LANES; }
static int64_t table_rows(const scene_parameters *s) { return s->side + 2 * BAND - 2; }
static int64_t table_size(const scene_parameters *s) { return table_rows(s) * (table_pitch(s) + 1) + DOUBLES; }

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
            int exists = lower[x] >= 0 && lower[x] + shared < s->layers;  // not where depth is not a number
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

// Goes on to a window further right in the same rows; says whether all of it is one layer's.
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

// Where a layer is in a window.
static void draw_outline(const scene_parameters *s, workspace *d, int64_t x, int32_t layer, int64_t pitch) {
    int64_t rows = s->side + BAND - 1, span = s->side + LANES - 1;
    outline *o = &d->outline;
    o->own.column_count = o->own.row_count = o->own.open = 0;
    o->behind.column_count = o->behind.row_count = o->behind.open = 0;
    o->lower_count = o->upper_count = 0;
    for (int64_t r = 0; r < rows; r++) {
        extent light = {span, 0}, lower = {span, 0}, upper = {span, 0};
        const run *p = d->heads[r];
        int64_t place = (BAND - 1 + r) * table_pitch(s) + s->side + LANES - 2 + x;  // less the column where a run begins
        int was_own = p->layer == layer && !p->shared, was_behind = was_own || p->layer < layer;
        int whole = was_own && p[1].start >= x + span;
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
        // Rows that are the layer's alone need no mask: null for the plane's own row.
        o->light[r] = ray_of(s, light, whole ? 0 : d->rows[0] + r * pitch, d->nothing);
        o->lower[r] = ray_of(s, lower, d->rows[1] + r * pitch, d->nothing);
        o->upper[r] = ray_of(s, upper, d->rows[2] + r * pitch, d->nothing);
        o->lower_count += lower.to > 0;
        o->upper_count += upper.to > 0;
    }
}

// ---- Sums.

// Two rows of light meet a PSF: row `a` for the block's rows up to `split`, row `b`, a PSF's height below, for the others.
INLINE void add_rays(const ray *a, const ray *b, const REAL *psf, int64_t side, int split, int strips, vec sums[2][BAND]) {
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

// `side` is at least BAND - 1.
INLINE void convolve_rays(const ray *rays, const REAL *psf, int64_t side, int strips, vec total[2][BAND]) {
    vec sums[2][BAND];
    memset(sums, 0, sizeof sums);
#pragma GCC unroll 7
    for (int r = 0; r < BAND - 1; r++) add_rays(rays + r, rays + r + side, psf + r, side, r, strips, sums);
    for (int64_t r = BAND - 1; r < side; r++) add_rays(rays + r, rays + r, psf + r, side, BAND - 1, strips, sums);
    for (int strip = 0; strip < strips; strip++)
        for (int v = 0; v < BAND; v++) total[strip][v] = sums[strip][v];
}

static void convolve_one(const ray *rays, const REAL *psf, int64_t side, vec total[2][BAND]) {
    convolve_rays(rays, psf, side, 1, total);
}

static void convolve_two(const ray *rays, const REAL *psf, int64_t side, vec total[2][BAND]) {
    convolve_rays(rays, psf, side, 2, total);
}

// The blur of whole weights, from where their runs begin and end.
static void add_edges(const scene_parameters *s, const double *table, const region *a, vec total[BAND]) {
    int64_t pitch = table_pitch(s);
    dvec constant = {0}, sums[BAND][PARTS];
    for (const edge *e = a->rows; e < a->rows + a->row_count; e++)
        constant += e->sign * *(const dloose *)(table + table_rows(s) * pitch + e->at);
    for (int v = 0; v < BAND; v++)
        for (int p = 0; p < PARTS; p++) sums[v][p] = constant[v] - (dvec){0};
    for (const edge *e = a->columns; e < a->columns + a->column_count; e++)
#pragma GCC unroll 8
        for (int v = 0; v < BAND; v++)
#pragma GCC unroll 2
            for (int p = 0; p < PARTS; p++)
                sums[v][p] += e->sign * *(const dloose *)(table + e->at - v * pitch + p * DOUBLES);
    for (int v = 0; v < BAND; v++)
        for (int p = 0; p < PARTS; p++) {
            part half = __builtin_convertvector(sums[v][p], part);
            memcpy((char *)&total[v] + p * sizeof half, &half, sizeof half);
        }
}

// ---- Masked rows.

INLINE vec only(vec x, __typeof__((vec){0} == (vec){0}) mask) {
    union {
        vec x;
        __typeof__((vec){0} == (vec){0}) bits;
    } masked = {.x = x};
    masked.bits &= mask;
    return masked.x;
}

enum { LIGHT, LOWER, UPPER };

// A layer's light, or its shared weights, in the rows that hold any.
INLINE void mask_rows(const scene_parameters *s, const ray *rays, int32_t layer, int what, const REAL *lower, const REAL *share,
                      const REAL *light, REAL *out, int64_t pitch) {
    const vec own = (REAL)layer - (vec){0}, below = (REAL)(layer - 1) - (vec){0};
    for (int64_t r = 0; r < s->side + BAND - 1; r++) {
        if (!rays[r].light || !rays[r].to) continue;
        const REAL *l = lower + r * s->map_row, *f = share ? share + r * s->map_row : 0, *x = light + r * s->plane_row;
        for (int64_t j = 0;; j = least(j + LANES, s->side - 1)) {  // the last ones overlap
            vec at = *(const loose *)(l + j), weight;
            if (what == LIGHT && !share) weight = only(*(const loose *)(x + j), at == own);
            else {
                vec t = *(const loose *)(f + j);
                vec upper = only(t, at == below), rest = only(1 - t, what == LOWER ? (at == own) & (t > 0) : at == own);
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

// A block of two strips whose window is all of one layer.
static void lay_alone(const scene_parameters *s, workspace *d, const double *tables, int64_t image, int64_t y, int64_t x, int skip) {
    int32_t layer = d->heads[0]->layer;
    int64_t area = s->side * s->side, rows = s->side + BAND - 1;
    for (int64_t c = 0; c < s->channels; c++) {
        REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + x;
        REAL whole = 0;
        vec light[2][BAND];
        memset(light, 0, sizeof light);
        if (layer < s->layers) {
            whole = tables[(layer * s->channels + c) * table_size(s) + table_rows(s) * (table_pitch(s) + 1) - 1];
            for (int64_t r = 0; r < rows; r++) {
                const REAL *row = s->plane + image * s->plane_image + c * s->plane_channel + (y + r) * s->plane_row + x;
                d->rays[r] = (ray){row, 0, s->side};
            }
            convolve_two(d->rays, s->psfs + (layer * s->channels + c) * area, s->side, light);
        }
        REAL stray_light = s->stray_light && layer < s->layers ? s->stray_light[layer * s->channels + c] : 0;
        REAL background = s->stray_light ? stray_light * s->mean[image * s->channels + c] * whole : 0;
        REAL divisor = (whole > 0 ? whole : 0) + EPSILON;
        for (int v = skip; v < BAND; v++)
            for (int strip = 0; strip < 2; strip++)
                *(loose *)(out + v * s->width + strip * LANES) = ((1 - stray_light) * light[strip][v] + background) / divisor;
    }
}

// A block of one strip, layer over layer.
static void lay_over(const scene_parameters *s, workspace *d, const double *tables, int64_t image, int64_t y, int64_t x, int skip) {
    int64_t area = s->side * s->side, rows = s->side + BAND - 1, pitch = window_pitch(s);
    int count = list_layers(s, d, rows, x, s->side + LANES - 1);
    int64_t corner = image * s->map_image + y * s->map_row + x;
    const REAL *lower = s->lower + corner, *share = s->share ? s->share + corner : 0;
    outline *o = &d->outline;
    vec(*total)[BAND] = d->total, (*through)[BAND] = d->through;
    for (int64_t c = 0; c < s->channels; c++)
        for (int v = 0; v < BAND; v++) total[c][v] = (vec){0}, through[c][v] = 1 - (vec){0};
    for (int n = 0; n < count; n++) {
        int32_t layer = d->members[n];
        draw_outline(s, d, x, layer, pitch);
        if (o->lower_count) mask_rows(s, o->lower, layer, LOWER, lower, share, lower, d->rows[1], pitch);
        if (o->upper_count) mask_rows(s, o->upper, layer, UPPER, lower, share, lower, d->rows[2], pitch);
        for (int64_t c = 0; c < s->channels; c++) {
            const REAL *psf = s->psfs + (layer * s->channels + c) * area;
            const double *table = tables + (layer * s->channels + c) * table_size(s);
            const REAL *plane = s->plane + image * s->plane_image + c * s->plane_channel + y * s->plane_row + x;
            for (int64_t r = 0; r < rows; r++) {
                d->rays[r] = o->light[r];
                if (!d->rays[r].light) d->rays[r].light = plane + r * s->plane_row;
            }
            vec light[2][BAND], own[2][BAND], seen[BAND], weight[2][BAND];
            mask_light(s, o->light, layer, lower, share, plane, d->rows[0], pitch);
            convolve_one(d->rays, psf, s->side, light);
            add_edges(s, table, &o->own, own[0]);
            if (n == count - 1) memcpy(seen, own[0], sizeof seen);  // nothing lies behind
            else add_edges(s, table, &o->behind, seen);
            if (o->lower_count) {
                convolve_one(o->lower, psf, s->side, weight);
                for (int v = 0; v < BAND; v++) own[0][v] += weight[0][v], seen[v] += weight[0][v];
            }
            if (o->upper_count) {
                convolve_one(o->upper, psf, s->side, weight);
                for (int v = 0; v < BAND; v++) own[0][v] += weight[0][v];
            }
            REAL stray_light = s->stray_light ? s->stray_light[layer * s->channels + c] : 0;
            REAL background = s->stray_light ? stray_light * s->mean[image * s->channels + c] : 0;
            for (int v = 0; v < BAND; v++) {
                vec passed = through[c][v] / (only(seen[v], seen[v] > 0) + EPSILON);
                total[c][v] += passed * ((1 - stray_light) * light[0][v] + background * own[0][v]);
                through[c][v] -= passed * own[0][v];
            }
        }
    }
    for (int64_t c = 0; c < s->channels; c++) {
        REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + x;
        for (int v = skip; v < BAND; v++) *(loose *)(out + v * s->width) = total[c][v];
    }
}

// What a block of one strip costs, see `direct_cost` in direct_occlusion.py.
enum { ALONE, PAIRS, COLUMNS, EDGES, COUNTS };

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
        draw_outline(s, d, x, d->members[n], window_pitch(s));
        counts[COLUMNS] += count_columns(o->light, s->side);
        if (o->lower_count) counts[COLUMNS] += count_columns(o->lower, s->side);
        if (o->upper_count) counts[COLUMNS] += count_columns(o->upper, s->side);
        counts[EDGES] += o->own.column_count + (n < count - 1 ? o->behind.column_count : 0);
    }
}

// ---- Workspaces.

static void *take(workspace *d, int64_t bytes) {
    void *memory = aligned_alloc(64, (bytes + 127) / 64 * 64);
    if (memory) memset(memory, 0, bytes);
    return d->all[d->count++] = memory;
}

static int set_up(const scene_parameters *s, workspace *d) {
    int64_t rows = s->side + BAND - 1, span = s->side + LANES - 1, pitch = window_pitch(s);
    outline *o = &d->outline;
    d->count = 0, d->window = 0;
    d->runs = take(d, rows * (s->width + s->side) * sizeof(run));
    d->made = take(d, rows * sizeof *d->made);
    d->heads = take(d, rows * sizeof *d->heads);
    d->members = take(d, (s->layers + 1) * sizeof *d->members);
    d->stamps = take(d, (s->layers + 1) * sizeof *d->stamps);
    for (int n = 0; n < 3; n++) d->rows[n] = take(d, rows * pitch * sizeof(REAL));
    d->nothing = take(d, pitch * sizeof(REAL));
    d->rays = take(d, rows * sizeof(ray));
    d->total = take(d, s->channels * sizeof *d->total);
    d->through = take(d, s->channels * sizeof *d->through);
    o->light = take(d, rows * sizeof(ray));
    o->lower = take(d, rows * sizeof(ray));
    o->upper = take(d, rows * sizeof(ray));
    o->own.columns = take(d, rows * span * sizeof(edge));
    o->behind.columns = take(d, rows * span * sizeof(edge));
    o->own.rows = take(d, rows * sizeof(edge));
    o->behind.rows = take(d, rows * sizeof(edge));
    int ok = 1;
    for (int n = 0; n < d->count; n++) ok &= d->all[n] != 0;
    for (int64_t r = 0; ok && r < rows; r++) d->made[r] = -1;
    return ok;
}

static void tear_down(workspace *d) {
    for (int n = 0; n < d->count; n++) free(d->all[n]);
}

// Lays the layers of a band, or with `counts` only counts what that would cost.
static void lay_band(const scene_parameters *s, workspace *d, const double *tables, int64_t band, int64_t *counts) {
    int64_t bands = (s->height + BAND - 1) / BAND, rows = s->side + BAND - 1, image = band / bands;
    int64_t top = band % bands * BAND, y = least(top, s->height - BAND);
    int skip = top - y;  // rows that the band before has made, maybe on another thread
    find_runs_of_band(s, d, image, y);
    for (int64_t x = 0, next; x < s->width; x = next) {
        int64_t left = least(x, s->width - LANES);
        int wide = left + WIDTH <= s->width && move_heads(d, rows, left, s->side + WIDTH - 1);
        next = x + (wide ? WIDTH : LANES);
        if (!wide) move_heads(d, rows, left, 0);
        if (counts && wide) counts[ALONE]++;
        else if (counts) count_block(s, d, left, counts);
        else if (wide) lay_alone(s, d, tables, image, y, left, skip);
        else lay_over(s, d, tables, image, y, left, skip);
    }
}

// Adds up what every `every`-th band would cost. Returns 0, or 1 if there is no memory.
int count(const scene_parameters *s, int64_t every, int64_t *counts) {
    int64_t bands = s->images * ((s->height + BAND - 1) / BAND);
    workspace d;
    int ok = set_up(s, &d);
    for (int64_t n = every / 2; ok && n < bands; n += every) lay_band(s, &d, 0, n, counts);
    tear_down(&d);
    return !ok;
}

// Lays the layers of a scene over one another. Returns 0, or 1 if there is no memory.
int occlude(const scene_parameters *s) {
    int64_t bands = (s->height + BAND - 1) / BAND, all = s->layers * s->channels, failed = 0;
    double *tables = malloc(all * table_size(s) * sizeof(double));
    if (!tables) return 1;
#pragma omp parallel num_threads(s->threads)
    {
#pragma omp for
        for (int64_t n = 0; n < all; n++) fill_table(s, s->psfs + n * s->side * s->side, tables + n * table_size(s));
        workspace d;
        int ok = set_up(s, &d);
        if (!ok) {
#pragma omp atomic write
            failed = 1;
        }
#pragma omp for schedule(dynamic, 4)
        for (int64_t n = 0; n < s->images * bands; n++)
            if (ok) lay_band(s, &d, tables, n, 0);
        tear_down(&d);
    }
    free(tables);
    return failed;
}
