// Direct convolution with SIMD vectors: a block of pixels is convolved only with the PSFs of the layers in the block.
//
// For gather, out[y][x] = sum over layers d of weight_d[y][x] * sum over j, k of psf_d[j][k] plane[y + k][x + j].
//
// A strip is ROWS rows of LANES pixels, one vector per row; a block is two strips side by side. The sums stay in
// registers: one vector of light is loaded once and multiplied by a different PSF sample for each row of the strip. The
// last blocks of a row and of a plane are shifted back inside and overlap with their neighbours.
//
// Layers are given as in scene.py: a pixel belongs to layer `index` or, with the weight `weight`, to the next one. PSFs
// are flipped by 180 degrees, so output pixel (y, x) reads plane pixels (y, x) to (y + side - 1, x + side - 1).
//
// Compiled by build.py with REAL as float or double; exact to rounding, without fast-math.

#include <stdlib.h>

#include "vectors.h"
#include "field.h"

enum { ROWS = 4, WIDTH = 2 * LANES };
enum { ROW_CHUNK = 4 };  // rows of light that are summed separately
enum { TERMS = 2 * ROWS * WIDTH };        // upper bound of the layers in a block
enum { PIECE_ROWS = 32, PIECE_BLOCKS = 32 };  // blocks whose correlations share one sum


// The fields of `_Scene` in gather_ops.py. Strides count elements; widths and heights are those of the output.
typedef struct {
    int64_t images, channels, height, width, layers, side, threads, slabs;
    int64_t plane_image, plane_channel, plane_row, index_image, index_row, weight_image, weight_row;
    int64_t weight_gradient;    // 0: blend by weights; 1: the next layer less the pixel's own
    const REAL *plane;          // light, larger by side - 1
    const REAL *psfs;           // (layers, channels, side, side), flipped, columns first
    const int64_t *index;       // (images, height, width)
    const REAL *weight;         // like index, or null
    const REAL *gradient;       // (images, channels, height, width): of what `mix` returns, for `correlate`
    REAL *out;                  // mix: (images, channels, height, width); correlate: zeros (slabs, layers, channels, side, side)
} scene;

// A layer present in a block, with a bit mask of its strips: 1 left, 2 right, 3 both.
typedef struct {
    int32_t layer, strips;
} member;

// Adds the products of two rows of light to the sums of strips. Row `upper` serves the strip's rows up to `split`, row
// `lower`, a PSF's height below it, the others, so that no product is wasted. `step` columns have separate sums, so that
// their additions do not depend on each other.
INLINE void add_rows(const REAL *upper, const REAL *lower, const REAL *psf, int64_t side, int split, int strips, int step,
                     vec sums[2][2][ROWS]) {
    int64_t j = 0;
    for (; j < side; j += step)
#pragma GCC unroll 2
        for (int s = 0; s < step; s++) {
            if (s && j + s == side) break;
#pragma GCC unroll 2
            for (int strip = 0; strip < strips; strip++) {
                vec x = *(const loose *)(upper + j + s + strip * LANES), z = x;
                if (split < ROWS - 1) z = *(const loose *)(lower + j + s + strip * LANES);
#pragma GCC unroll 4
                for (int v = 0; v < ROWS; v++)
                    sums[s][strip][v] += psf[(j + s) * side - v + (v > split ? side : 0)] * (v > split ? z : x);
            }
        }
}

// Convolves the light of strips with one PSF. Every ROW_CHUNK rows of light have separate sums, which are added at the
// end: blocked summation has a smaller rounding error than one long sum.
INLINE void convolve(const REAL *light, int64_t pitch, const REAL *psf, int64_t side, int strips, vec total[2][ROWS]) {
    const int step = strips == 1 ? 2 : 1;
    const REAL *lower = light + side * pitch;
    for (int strip = 0; strip < strips; strip++)
        for (int v = 0; v < ROWS; v++) {
            vec only = *(const loose *)(light + v * pitch + strip * LANES);
            total[strip][v] = side == 1 ? *psf * only : (vec){0};
        }
    if (side == 1) return;  // lower than a strip, handled above
    for (int64_t first = 0; first < side; first += ROW_CHUNK) {
        vec sums[2][2][ROWS];
        memset(sums, 0, sizeof sums);
        for (int64_t r = first; r < least(first + ROW_CHUNK, side); r++) {
            const REAL *x = light + r * pitch, *z = lower + r * pitch, *p = psf + r;
            if (r >= ROWS - 1) add_rows(x, x, p, side, ROWS - 1, strips, step, sums);
            else if (r == 0) add_rows(x, z, p, side, 0, strips, step, sums);
            else if (r == 1) add_rows(x, z, p, side, 1, strips, step, sums);
            else add_rows(x, z, p, side, 2, strips, step, sums);
        }
        for (int strip = 0; strip < strips; strip++)
            for (int v = 0; v < ROWS; v++)
                total[strip][v] += step == 2 ? sums[0][strip][v] + sums[1][strip][v] : sums[0][strip][v];
    }
}

static void convolve_strip(const REAL *light, int64_t pitch, const REAL *psf, int64_t side, vec total[2][ROWS]) {
    convolve(light, pitch, psf, side, 1, total);
}

static void convolve_block(const REAL *light, int64_t pitch, const REAL *psf, int64_t side, vec total[2][ROWS]) {
    convolve(light, pitch, psf, side, 2, total);
}

INLINE int note(member *members, int count, int64_t layer, int strip) {
    int n = 0;
    while (n < count && members[n].layer != layer) n++;
    if (n == count) members[count++] = (member){layer, 0};
    members[n].strips |= 1 << strip;
    return count;
}

// Lists the layers of a block's pixels and returns their number; 0 if a layer index is invalid, as for a NaN depth.
INLINE int list_members(const scene *s, const int64_t *index, const REAL *weight, member *members) {
    uint64_t other = 0, last = 0, layers = s->layers;
    for (int v = 0; v < ROWS; v++)
        for (int i = 0; i < WIDTH; i++) {
            uint64_t layer = index[v * s->index_row + i];
            other |= layer ^ (uint64_t)index[0];
            last = layer > last ? layer : last;
        }
    if (last >= layers) return 0;
    if (!weight && !other) {
        members[0] = (member){index[0], 3};
        return 1;
    }
    int count = 0;
    for (int v = 0; v < ROWS; v++)
        for (int i = 0; i < WIDTH; i++) {
            int64_t layer = index[v * s->index_row + i];
            REAL f = weight ? weight[v * s->weight_row + i] : 0;
            if (s->weight_gradient || f != 1) count = note(members, count, layer, i / LANES);
            if ((s->weight_gradient || f > 0) && layer + 1 < s->layers) count = note(members, count, layer + 1, i / LANES);
        }
    return count;
}

// Computes the weights of a layer for the pixels of a strip; for gradients, -1 for `index` and 1 for the next layer.
INLINE void weigh(const scene *s, const int64_t *index, const REAL *weight, int64_t layer, vec weights[ROWS]) {
    for (int v = 0; v < ROWS; v++) {
        const int64_t *l = index + v * s->index_row;
        const REAL *f = weight ? weight + v * s->weight_row : 0;
        REAL *w = (REAL *)&weights[v];
        if (s->weight_gradient)
            for (int i = 0; i < LANES; i++) w[i] = (REAL)(l[i] + 1 == layer) - (REAL)(l[i] == layer);
        else if (f)
            for (int i = 0; i < LANES; i++) w[i] = l[i] == layer ? 1 - f[i] : l[i] + 1 == layer ? f[i] : 0;
        else
            for (int i = 0; i < LANES; i++) w[i] = l[i] == layer;
    }
}

static void mix_block(const scene *s, const REAL *light, const int64_t *index, const REAL *weight, const member *members,
                      int count, const REAL *psfs, REAL *out, int skip) {
    vec total[2][ROWS], own[2][ROWS], weights[ROWS];
    int64_t stride = s->channels * s->side * s->side;
    if (count == 1 && !weight)
        convolve_block(light, s->plane_row, psfs + members->layer * stride, s->side, total);
    else {
        memset(total, 0, sizeof total);
        for (int n = 0; n < count; n++) {
            const REAL *psf = psfs + members[n].layer * stride;
            int first = members[n].strips == 2, last = members[n].strips != 1;
            if (members[n].strips == 3) convolve_block(light, s->plane_row, psf, s->side, own);
            else convolve_strip(light + first * LANES, s->plane_row, psf, s->side, own + first);
            for (int strip = first; strip <= last; strip++) {
                int at = strip * LANES;
                weigh(s, index + at, weight ? weight + at : 0, members[n].layer, weights);
                for (int v = 0; v < ROWS; v++) total[strip][v] += weights[v] * own[strip][v];
            }
        }
    }
    for (int v = skip; v < ROWS; v++)
        for (int strip = 0; strip < 2; strip++) *(loose *)(out + v * s->width + strip * LANES) = total[strip][v];
}

// Gathers light: each pixel is convolved with the PSFs of its layers. Guided scheduling gives threads long runs of
// adjacent bands, which weight light in the cache, and short runs at the end. Returns 0, or 1 for an invalid layer index.
int mix(const scene *s) {
    int64_t bands = (s->height + ROWS - 1) / ROWS, blocks = (s->width + WIDTH - 1) / WIDTH;
    int failed = 0;
#pragma omp parallel for schedule(guided, 8) num_threads(s->threads)
    for (int64_t band = 0; band < s->images * bands; band++) {
        int64_t image = band / bands, y = least(band % bands * ROWS, s->height - ROWS);
        const int64_t *index = s->index + image * s->index_image + y * s->index_row;
        const REAL *weight = s->weight ? s->weight + image * s->weight_image + y * s->weight_row : 0;
        int skip = band % bands * ROWS - y;  // rows of the previous band, which another thread may be writing
        member members[TERMS];
        for (int64_t block = 0; block < blocks; block++) {
            int64_t x = least(block * WIDTH, s->width - WIDTH);
            int count = list_members(s, index + x, weight ? weight + x : 0, members);
            if (count == 0) {
#pragma omp atomic write
                failed = 1;
            }
            for (int64_t c = 0; c < s->channels; c++) {
                const REAL *light = s->plane + image * s->plane_image + c * s->plane_channel + y * s->plane_row + x;
                REAL *out = s->out + ((image * s->channels + c) * s->height + y) * s->width + x;
                mix_block(s, light, index + x, weight ? weight + x : 0, members, count, s->psfs + c * s->side * s->side, out,
                          skip);
            }
        }
    }
    return failed;
}

// Adds the correlation of strips with the light for `count` rows of PSF samples: sum over pixels of own times light.
INLINE void correlate_rows(const REAL *light, int64_t pitch, const vec own[2][ROWS], int64_t side, int strips, int count,
                           vec *sums) {
    for (int64_t j = 0; j < side; j++) {
        vec total[ROWS];
#pragma GCC unroll 4
        for (int k = 0; k < count; k++) total[k] = sums[k * side + j];
#pragma GCC unroll 2
        for (int strip = 0; strip < strips; strip++)
#pragma GCC unroll 7
            for (int r = 0; r < ROWS + count - 1; r++) {
                vec x = *(const loose *)(light + r * pitch + j + strip * LANES);
#pragma GCC unroll 4
                for (int k = 0; k < count; k++)
                    if (r - k >= 0 && r - k < ROWS) total[k] += own[strip][r - k] * x;
            }
#pragma GCC unroll 4
        for (int k = 0; k < count; k++) sums[k * side + j] = total[k];
    }
}

INLINE void correlate_with(const REAL *light, int64_t pitch, const vec own[2][ROWS], int64_t side, int strips, vec *sums) {
    int64_t k = 0;
    for (; k + 4 <= side; k += 4) correlate_rows(light + k * pitch, pitch, own, side, strips, 4, sums + k * side);
    light += k * pitch, sums += k * side;
    if (side - k == 3) correlate_rows(light, pitch, own, side, strips, 3, sums);  // a side is odd
    if (side - k == 1) correlate_rows(light, pitch, own, side, strips, 1, sums);
}

static void correlate_strip(const REAL *light, int64_t pitch, const vec own[2][ROWS], int64_t side, vec *sums) {
    correlate_with(light, pitch, own, side, 1, sums);
}

static void correlate_block(const REAL *light, int64_t pitch, const vec own[2][ROWS], int64_t side, vec *sums) {
    correlate_with(light, pitch, own, side, 2, sums);
}

// Position of a block in a piece, with its layers members[start] to members[stop - 1].
typedef struct {
    int64_t y, x, skip_rows, skip_columns, start, stop;
} place;

// Correlates the pixels of a piece in one layer and channel with the light, summed over the piece.
static void correlate_piece(const scene *s, int64_t image, int64_t channel, int64_t layer, const place *places, int count,
                            const member *members, vec *sums) {
    const REAL *plane = s->plane + image * s->plane_image + channel * s->plane_channel;
    const REAL *gradient = s->gradient + (image * s->channels + channel) * s->height * s->width;
    memset(sums, 0, s->side * s->side * sizeof(vec));
    for (const place *p = places; p < places + count; p++)
        for (int64_t n = p->start; n < p->stop; n++) {
            if (members[n].layer != layer) continue;
            int first = members[n].strips == 2, last = members[n].strips != 1;
            vec weights[2][ROWS];
            for (int strip = first; strip <= last; strip++) {
                int64_t x = p->x + strip * LANES;
                weigh(s, s->index + image * s->index_image + p->y * s->index_row + x,
                      s->weight ? s->weight + image * s->weight_image + p->y * s->weight_row + x : 0, layer, weights[strip]);
                for (int v = 0; v < ROWS; v++) weights[strip][v] *= *(const loose *)(gradient + (p->y + v) * s->width + x);
                // Pixels of the overlap belong to the previous blocks.
                if (p->skip_rows || p->skip_columns)
                    for (int v = 0; v < ROWS; v++)
                        for (int i = 0; i < LANES; i++)
                            if (v < p->skip_rows || strip * LANES + i < p->skip_columns) weights[strip][v][i] = 0;
            }
            const REAL *light = plane + p->y * s->plane_row + p->x;
            if (members[n].strips == 3) correlate_block(light, s->plane_row, weights, s->side, sums);
            else correlate_strip(light + first * LANES, s->plane_row, weights + first, s->side, sums);
        }
}

// Computes the gradient in the PSFs: for each sample of each layer's PSF the correlation of the layer's pixels with the
// light, in separate sums for slabs of rows. Returns 0, or 1 if there is no memory.
int correlate(const scene *s) {
    int64_t bands = (s->height + ROWS - 1) / ROWS, blocks = (s->width + WIDTH - 1) / WIDTH, area = s->side * s->side;
    int64_t all = s->images * bands, failed = 0;
#pragma omp parallel for schedule(dynamic, 1) num_threads(s->threads)
    for (int64_t slab = 0; slab < s->slabs; slab++) {
        place places[PIECE_ROWS * PIECE_BLOCKS];
        member *members = malloc(sizeof(member) * PIECE_ROWS * PIECE_BLOCKS * TERMS);
        char *present = malloc(s->layers + 1);
        vec *sums = aligned_alloc(sizeof(vec), area * sizeof(vec));
        if (!members || !present || !sums) {
#pragma omp atomic write
            failed = 1;
        } else
            for (int64_t top = all * slab / s->slabs, next; top < all * (slab + 1) / s->slabs; top = next) {
                int64_t image = top / bands;
                next = least(least(top + PIECE_ROWS, all * (slab + 1) / s->slabs), (image + 1) * bands);
                for (int64_t left = 0; left < blocks; left += PIECE_BLOCKS) {
                    int count = 0;
                    int64_t end = 0;
                    memset(present, 0, s->layers + 1);
                    for (int64_t band = top; band < next; band++)
                        for (int64_t block = left; block < least(left + PIECE_BLOCKS, blocks); block++) {
                            int64_t y = least(band % bands * ROWS, s->height - ROWS);
                            int64_t x = least(block * WIDTH, s->width - WIDTH);
                            int found = list_members(
                                s, s->index + image * s->index_image + y * s->index_row + x,
                                s->weight ? s->weight + image * s->weight_image + y * s->weight_row + x : 0, members + end);
                            for (int n = 0; n < found; n++) present[members[end + n].layer] = 1;
                            places[count++] = (place){y, x, band % bands * ROWS - y, block * WIDTH - x, end, end + found};
                            end += found;
                        }
                    for (int64_t layer = 0; layer < s->layers; layer++)
                        for (int64_t c = 0; present[layer] && c < s->channels; c++) {
                            correlate_piece(s, image, c, layer, places, count, members, sums);
                            REAL *out = s->out + ((slab * s->layers + layer) * s->channels + c) * area;
                            for (int64_t n = 0; n < area; n++) out[n] += sum_of(sums[n]);
                        }
                }
            }
        free(members), free(present), free(sums);
    }
    return failed;
}
