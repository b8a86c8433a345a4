// PSFs over the field, which are known at nodes. In a tile they are h0 + x hx + y hy, with x and y from its middle.
//
// Nodes are blended along their columns once for each row of tiles, then along this row for each tile. A PSF is a plane of
// numbers in any order.

// The fields of `Places` in places.py.
typedef struct {
    int64_t node_rows, node_columns;           // 0: PSFs are the same everywhere
    int64_t down, across;                      // rows and columns of tiles
    const int64_t *row_edges, *column_edges;   // (down + 1,), (across + 1,): where tiles begin, and the end
    const REAL *row_middles, *column_middles;  // (down,), (across,): where slopes begin
    const REAL *row_weights, *column_weights;  // (down, 2, node_rows), (across, 2, node_columns): of nodes, and slopes
} field;

enum { VALUE, ALONG_X, ALONG_Y, ORDERS };

// PSFs of a row of tiles. Slots hold the planes that it needs, value and slope along y, at each column of nodes.
typedef struct {
    const field *f;
    int64_t numbers, vectors;  // of a plane
    vec *lines;                // (slots, 2, node_columns, vectors)
    char *made;                // (slots,)
    int64_t slots, row;
} lines;

INLINE int any(const REAL *numbers, int64_t count) {
    for (int64_t n = 0; n < count; n++)
        if (numbers[n] != 0) return 1;
    return 0;
}

// Whether a tile has a slope.
INLINE int has_order(const field *f, int64_t row, int64_t column, int order) {
    if (order == ALONG_X) return any(f->column_weights + (2 * column + 1) * f->node_columns, f->node_columns);
    return order == VALUE || any(f->row_weights + (2 * row + 1) * f->node_rows, f->node_rows);
}

static inline void begin_row(lines *l, int64_t row) {
    if (l->row == row) return;
    l->row = row;
    memset(l->made, 0, l->slots);
}

INLINE vec *line_at(const lines *l, int64_t slot, int slope) {
    return l->lines + (slot * 2 + slope) * l->f->node_columns * l->vectors;
}

enum { AHEAD = 4096 / sizeof(REAL) };  // numbers that are asked for before they are read

// Blends the nodes of a plane along their columns, `next` numbers from node to node, if this row has not yet done it. Nodes
// come from far memory: each is read once, from its begin to its end, two at a time.
static inline void blend_nodes(lines *l, int64_t slot, const REAL *nodes, int64_t next, REAL scale) {
    const field *f = l->f;
    if (l->made[slot]) return;
    l->made[slot] = 1;
    const int sloped = has_order(f, l->row, 0, ALONG_Y);
    const REAL *weights = f->row_weights + 2 * l->row * f->node_rows, *slopes = weights + f->node_rows;
    for (int64_t column = 0; column < f->node_columns; column++) {
        vec *value = line_at(l, slot, 0) + column * l->vectors, *slope = line_at(l, slot, 1) + column * l->vectors;
        for (int64_t row = 0; row < f->node_rows; row += 2) {
            const int two = row + 1 < f->node_rows;
            const REAL *a = nodes + (row * f->node_columns + column) * next, *b = a + two * f->node_columns * next;
            const REAL v = weights[row] * scale, u = two ? weights[row + 1] * scale : 0;
            const REAL s = slopes[row] * scale, t = two ? slopes[row + 1] * scale : 0;
            for (int64_t n = 0, k = 0; n < l->vectors; n++, k += LANES) {
                __builtin_prefetch(a + k + AHEAD), __builtin_prefetch(b + k + AHEAD);
                const vec x = load_some(a + k, l->numbers - k), y = load_some(b + k, l->numbers - k);
                value[n] = v * x + u * y + (row ? value[n] : all(0));
                if (sloped) slope[n] = s * x + t * y + (row ? slope[n] : all(0));
            }
        }
    }
}

// Blends the line of a slot for a tile: `psf` is (ORDERS, vectors).
static inline void blend_line(const lines *l, int64_t slot, int64_t column, vec *psf) {
    const field *f = l->f;
    const int along_x = has_order(f, l->row, column, ALONG_X), along_y = has_order(f, l->row, column, ALONG_Y);
    const REAL *weights = f->column_weights + 2 * column * f->node_columns, *slopes = weights + f->node_columns;
    const vec *value = line_at(l, slot, 0), *slope = line_at(l, slot, 1);
    for (int64_t n = 0; n < l->vectors; n++) {
        vec h = {0}, x = {0}, y = {0};
        for (int64_t c = 0, k = n; c < f->node_columns; c++, k += l->vectors) {
            h += weights[c] * value[k];
            if (along_x) x += slopes[c] * value[k];
            if (along_y) y += weights[c] * slope[k];
        }
        psf[n] = h, psf[l->vectors + n] = x, psf[2 * l->vectors + n] = y;
    }
}

// The transpose: adds the gradients of a tile's PSF to those of its line, which it clears when it is the first.
static inline void spread_tile(lines *l, int64_t slot, int64_t column, const vec *psf) {
    const field *f = l->f;
    const REAL *weights = f->column_weights + 2 * column * f->node_columns, *slopes = weights + f->node_columns;
    vec *value = line_at(l, slot, 0), *slope = line_at(l, slot, 1);
    if (!l->made[slot]) memset(value, 0, 2 * f->node_columns * l->vectors * sizeof(vec));
    l->made[slot] = 1;
    for (int64_t c = 0; c < f->node_columns; c++)
        for (int64_t n = 0; n < l->vectors; n++) {
            value[c * l->vectors + n] += weights[c] * psf[n] + slopes[c] * psf[l->vectors + n];
            slope[c * l->vectors + n] += weights[c] * psf[2 * l->vectors + n];
        }
}

// Adds the gradients of a slot's line to those of a plane at the nodes, `next` vectors from node to node.
static inline void spread_line(const lines *l, int64_t slot, vec *nodes, int64_t next) {
    const field *f = l->f;
    if (!l->made[slot]) return;
    for (int64_t n = 0; n < f->node_rows * f->node_columns; n++, nodes += next) {
        const REAL *weights = f->row_weights + 2 * l->row * f->node_rows + n / f->node_columns;
        const vec *value = line_at(l, slot, 0) + n % f->node_columns * l->vectors, *slope = line_at(l, slot, 1) + n % f->node_columns * l->vectors;
        for (int64_t k = 0; k < l->vectors; k++) nodes[k] += weights[0] * value[k] + weights[f->node_rows] * slope[k];
    }
}

static inline lines take_lines(pool *p, const field *f, int64_t slots, int64_t numbers) {
    const int64_t vectors = (numbers + LANES - 1) / LANES;
    vec *all = take(p, f->node_rows ? 2 * slots * f->node_columns * vectors : 0, sizeof(vec));
    return (lines){f, numbers, vectors, all, take_zeros(p, slots, 1), slots, -1};
}
