// Direct convolution with SIMD vectors: a block of pixels is convolved only with the PSFs of the layers in the block.
//
// For gather, out[y][x] = sum over layers d of weight_d[y][x] * sum over j, k of psf_d[j][k] plane[y + k][x + j].
//
// A strip is ROWS rows of LANES pixels, one vector per row; a block is two strips side by side. The sums stay in
// registers: one vector of light is loaded once and multiplied by a different PSF sample for each row of the strip. The
// last blocks of a row and of a plane are shifted back inside and overlap with their neighbours.
//
// A PSF is a list of terms, its samples that are not zero. Columns of a disc are runs of one value: of sums of the light
// down its columns it takes the two ends of each run, so that a disc has as many terms as pixels on its edge, not in its
// area (summed-area tables in one dimension; Crow 1984).
//
// Layers are given as in scene.py: a pixel belongs to layer `index` or, with the weight `weight`, to the next one. PSFs
// are flipped by 180 degrees, so output pixel (y, x) reads plane pixels (y, x) to (y + side - 1, x + side - 1).
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include "vectors.h"

enum { ROWS = 4, WIDTH = 2 * LANES };
enum { TERMS = 2 * ROWS * WIDTH };        // upper bound of the layers in a block
enum { TILE_ROWS = 16, TILE_COLUMNS = 256 };  // of pixels that share sums of columns, which stay in the cache
enum { RUN = 5 };  // terms in adjacent rows that are added together

// The fields in gather_ops.py. Strides count elements; widths and heights are those of the output.
typedef struct {
    int64_t threads, images, channels, height, width, layers, side;
    int64_t weight_gradient;    // 0: blend by weights; 1: the next layer less the pixel's own
    const REAL *plane;          // light, larger by side - 1
    int64_t plane_image, plane_channel, plane_row;
    const REAL *psfs;           // (layers, channels, side, side), flipped, columns first
    const int64_t *index;       // (images, height, width)
    int64_t index_image, index_row;
    const REAL *weight;         // like index, or null
    int64_t weight_image, weight_row;
    REAL *out;                  // (images, channels, height, width)
} scene;

// A layer present in a block, with a bit mask of its strips: 1 left, 2 right, 3 both.
typedef struct {
    int32_t layer, strips;
} member;

// The PSFs as terms. Of PSF p (layer by layer, channel by channel) those with n + 1 terms in adjacent rows are runs
// first[p * RUN + n] to first[p * RUN + n + 1] - 1.
typedef struct {
    int64_t *first;    // (psfs * RUN + 1,)
    uint8_t *summed;   // (psfs,): 1 for terms of sums down columns, 0 for terms of the light
    int64_t *offsets;  // (runs,): of the first term, from the first sample that a pixel reads
    REAL *weights;     // (runs, RUN)
    int sums;          // whether any PSF takes sums
} terms;

// Lists the terms of all PSFs, if there is memory for them; `pitch` is that of the sums.
static terms list_terms(pool *p, const scene *s, int64_t pitch) {
    const int64_t psfs = s->layers * s->channels, side = s->side, most = side * (side / 2 + 1);  // runs of one PSF
    terms t = {take_zeros(p, psfs * RUN + 1, sizeof(int64_t)), take(p, psfs, 1), take(p, psfs * most, sizeof(int64_t)),
               take(p, psfs * most * RUN, sizeof(REAL)), 0};
    REAL *column = take(p, side + 1, sizeof(REAL));
    int64_t end = 0;
    for (int64_t n = 0; !p->missing && n < psfs; n++) {
        const REAL *psf = s->psfs + n * side * side;
        int64_t samples = 0, ends = 0, *first = t.first + n * RUN;
        for (int64_t j = 0; j < side; j++, psf += side) {
            for (int64_t r = 0; r < side; r++) samples += psf[r] != 0, ends += psf[r] != (r ? psf[r - 1] : 0);
            ends += psf[side - 1] != 0;
        }
        const int summed = t.summed[n] = ends < samples;
        t.sums |= summed;
        for (int length = 1; length <= RUN; length++) {
            psf = s->psfs + n * side * side;
            for (int64_t j = 0; j < side; j++, psf += side) {
                for (int64_t r = 0; r <= side; r++)
                    column[r] = summed ? (r ? psf[r - 1] : 0) - (r < side ? psf[r] : 0) : r < side ? psf[r] : 0;
                for (int64_t r = 0, next; r <= side; r = next) {
                    for (next = r; next <= side && next < r + RUN && column[next] != 0;) next++;
                    if (next - r == length) {
                        t.offsets[end] = r * (summed ? pitch : s->plane_row) + j;
                        memcpy(t.weights + end++ * RUN, column + r, length * sizeof(REAL));
                    }
                    next += next == r;
                }
            }
            first[length] = end;
        }
    }
    return t;
}

// Adds terms of a PSF, `count` in adjacent rows, to strips: a row of light is loaded once for all rows of a strip.
INLINE void add_terms(const REAL *light, int64_t pitch, const REAL *weights, int count, int strips, vec sums[2][ROWS]) {
#pragma GCC unroll 2
    for (int strip = 0; strip < strips; strip++)
#pragma GCC unroll 8
        for (int r = 0; r < ROWS + count - 1; r++) {
            const vec x = *(const loose *)(light + r * pitch + strip * LANES);
#pragma GCC unroll 4
            for (int v = 0; v < ROWS; v++)
                if (r - v >= 0 && r - v < count) sums[strip][v] += weights[r - v] * x;
        }
}

// Convolves strips with one PSF.
INLINE void convolve(const terms *t, int64_t psf, const REAL *light, int64_t pitch, int strips, vec total[2][ROWS]) {
    const int64_t *first = t->first + psf * RUN;
    int64_t n = first[0];
    vec sums[2][ROWS];
    memset(sums, 0, sizeof sums);
#pragma GCC unroll 5
    for (int count = 1; count <= RUN; count++)
        for (; n < first[count]; n++) add_terms(light + t->offsets[n], pitch, t->weights + n * RUN, count, strips, sums);
    memcpy(total, sums, strips * sizeof *sums);
}

static void convolve_strip(const terms *t, int64_t psf, const REAL *light, int64_t pitch, vec total[2][ROWS]) {
    convolve(t, psf, light, pitch, 1, total);
}

static void convolve_block(const terms *t, int64_t psf, const REAL *light, int64_t pitch, vec total[2][ROWS]) {
    convolve(t, psf, light, pitch, 2, total);
}

// The labels of a block's pixels in vectors, and the weights of the next layer: zeros where there are none.
typedef struct {
    bits layer[2][ROWS];
    vec next[2][ROWS];
} labels;

INLINE void read_labels(const scene *s, const int64_t *index, const REAL *weight, labels *l) {
    for (int strip = 0; strip < 2; strip++)
        for (int v = 0; v < ROWS; v++) {
            const int64_t at = strip * LANES;
            for (int i = 0; i < LANES; i++) l->layer[strip][v][i] = index[v * s->index_row + at + i];
            l->next[strip][v] = (vec){0};
            if (weight) l->next[strip][v] = *(const loose *)(weight + v * s->weight_row + at);
        }
}

// Lists the layers of a block's pixels and returns their number; 0 if a layer index is invalid, as for a NaN depth. `seen`
// has 2 * (layers + 1) zeros, and keeps them.
INLINE int list_members(const scene *s, const int64_t *index, const REAL *weight, uint8_t *seen, member *members) {
    uint64_t other = 0, first = index[0], last = first, layers = s->layers;
    for (int v = 0; v < ROWS; v++)
        for (int i = 0; i < WIDTH; i++) {
            uint64_t layer = index[v * s->index_row + i];
            other |= layer ^ (uint64_t)index[0];
            first = layer < first ? layer : first;
            last = layer > last ? layer : last;
        }
    if (last >= layers) return 0;
    if (!weight && !other) {
        members[0] = (member){index[0], 3};
        return 1;
    }
    for (int strip = 0; strip < 2; strip++)
        for (int v = 0; v < ROWS; v++)
            for (int i = strip * LANES; i < (strip + 1) * LANES; i++) {
                const int64_t layer = index[v * s->index_row + i];
                const REAL f = weight ? weight[v * s->weight_row + i] : 0;
                seen[2 * (layer + (!s->weight_gradient && f == 1)) + strip] = 1;
                seen[2 * (layer + (s->weight_gradient || f > 0)) + strip] = 1;
            }
    int count = 0;
    for (uint64_t layer = first; layer <= last + 1; layer++) {
        const int strips = seen[2 * layer] + 2 * seen[2 * layer + 1];
        seen[2 * layer] = seen[2 * layer + 1] = 0;
        if (strips && layer < layers) members[count++] = (member){layer, strips};
    }
    return count;
}

// Computes the weights of a layer for the pixels of a strip; for gradients, -1 for `index` and 1 for the next layer.
INLINE void weigh(const scene *s, const labels *l, int strip, int64_t layer, vec weights[ROWS]) {
    for (int v = 0; v < ROWS; v++) {
        const bits own = l->layer[strip][v] == (lane)layer, below = l->layer[strip][v] == (lane)(layer - 1);
        const vec f = l->next[strip][v];
        if (s->weight_gradient) weights[v] = where(below, all(1)) - where(own, all(1));
        else weights[v] = choose(own, 1 - f, where(below, f));
    }
}

// Sums light down the columns of a tile: row r has the sum of the r rows above it. They begin anew in each tile, so that
// their rounding error does not grow with the image.
INLINE void sum_columns(const REAL *light, int64_t light_pitch, int64_t rows, int64_t columns, REAL *sums, int64_t pitch) {
    memset(sums, 0, columns * sizeof(REAL));
    for (int64_t r = 0; r < rows; r++, light += light_pitch, sums += pitch)
        for (int64_t x = 0; x < columns; x++) sums[pitch + x] = sums[x] + light[x];
}

// What a thread gathers a tile in.
typedef struct {
    uint8_t *seen;             // see list_members
    REAL *sums;                // (channels, TILE_ROWS + side, pitch)
    vec (*total)[2][ROWS];     // (channels,) of a block
} desk;

// Gathers a block whose first pixel is (y, x), in a tile from (top, left) on; its rows before `row` are written already.
// Returns whether its layer indices are valid.
INLINE int mix_block(const scene *s, const terms *t, const desk *d, int64_t pitch, int64_t image, int64_t top, int64_t left,
                     int64_t y, int64_t x, int64_t row) {
    const int64_t *index = s->index + image * s->index_image + y * s->index_row + x;
    const REAL *weight = s->weight ? s->weight + image * s->weight_image + y * s->weight_row + x : 0;
    member members[TERMS];
    labels l;
    vec own[2][ROWS], weights[2][ROWS];
    const int count = list_members(s, index, weight, d->seen, members);
    read_labels(s, index, weight, &l);
    memset(d->total, 0, s->channels * sizeof *d->total);
    for (int n = 0; n < count; n++) {
        const int strips = members[n].strips, first = strips == 2, last = strips != 1;
        for (int strip = first; strip <= last; strip++) weigh(s, &l, strip, members[n].layer, weights[strip]);
        for (int64_t c = 0; c < s->channels; c++) {
            const int64_t psf = members[n].layer * s->channels + c, from = t->summed[psf] ? pitch : s->plane_row;
            const REAL *light = t->summed[psf] ? d->sums + (c * (TILE_ROWS + s->side) + y - top) * pitch + x - left
                                               : s->plane + image * s->plane_image + c * s->plane_channel + y * s->plane_row + x;
            if (strips == 3) convolve_block(t, psf, light, from, own);
            else convolve_strip(t, psf, light + first * LANES, from, own + first);
            for (int strip = first; strip <= last; strip++)
                for (int v = 0; v < ROWS; v++) d->total[c][strip][v] += weights[strip][v] * own[strip][v];
        }
    }
    for (int64_t c = 0; c < s->channels; c++) {
        REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + x;
        for (int64_t v = row - y; v < ROWS; v++)
            for (int strip = 0; strip < 2; strip++) *(loose *)(out + v * s->width + strip * LANES) = d->total[c][strip][v];
    }
    return count > 0;
}

// Gathers light: each pixel is convolved with the PSFs of its layers. A thread takes TILE_ROWS rows of an image at a time, and
// writes no other. Returns 0, REFUSED for an invalid layer index, or NO_MEMORY.
int mix(const scene *s) {
    const int64_t bands = (s->height + TILE_ROWS - 1) / TILE_ROWS, pitch = (TILE_COLUMNS + s->side - 1 + LANES) / LANES * LANES;
    const int64_t plane = (TILE_ROWS + s->side) * pitch;
    pool p = {0};
    const terms t = list_terms(&p, s, pitch);
    desk desks[s->threads];
    for (int64_t n = 0; n < s->threads; n++)
        desks[n] = (desk){take_zeros(&p, 2 * (s->layers + 1), 1), take(&p, t.sums ? s->channels * plane : 0, sizeof(REAL)),
                          take(&p, s->channels, sizeof *desks->total)};
    int status = p.missing ? NO_MEMORY : 0;
    const int64_t count = status ? 0 : s->images * bands;
#pragma omp parallel for schedule(dynamic) num_threads(s->threads)
    for (int64_t band = 0; band < count; band++) {
        const desk *d = desks + thread_number();
        const int64_t image = band / bands, first = band % bands * TILE_ROWS;
        const int64_t top = least(first, s->height - ROWS), bottom = least(first + TILE_ROWS, s->height);
        for (int64_t begin = 0; begin < s->width; begin += TILE_COLUMNS) {
            const int64_t left = least(begin, s->width - WIDTH), right = least(begin + TILE_COLUMNS, s->width);
            const REAL *light = s->plane + image * s->plane_image + top * s->plane_row + left;
            for (int64_t c = 0; t.sums && c < s->channels; c++)
                sum_columns(light + c * s->plane_channel, s->plane_row, bottom - top + s->side - 1, right - left + s->side - 1,
                            d->sums + c * plane, pitch);
            for (int64_t row = first; row < bottom; row += ROWS)
                for (int64_t column = begin; column < right; column += WIDTH) {
                    const int64_t y = least(row, s->height - ROWS), x = least(column, s->width - WIDTH);
                    if (mix_block(s, &t, d, pitch, image, top, left, y, x, row)) continue;
#pragma omp atomic write
                    status = REFUSED;
                }
        }
    }
    free_all(&p);
    return status;
}
