// The depth-dependent pinhole response: voxels to the planes of a fine image and back, planes to pixels and back.

#include "kernels.h"
#include "lanes.h"

#define JOIN_(name, level, real) name##_##level##_##real
#define JOIN(name, level, real) JOIN_(name, level, real)
#define KERNEL(name) JOIN(name, LEVEL, REAL)

// Places of some voxels of a row, neighbours along z, in the fine image. They are in memory, since they are read one by one.
typedef struct {
    F parts;          // number of points along the line
    F is_pair;        // 1/2: the point is two points on the same cells; 0: one point
    I cell;           // index in `cells` of the first of 3 x 3 cells in the farther of two planes
    F along[2];       // columns of the points from the central one of the three
    F across[2][3];   // shares of their rows: a quadratic B-spline
    F nearer;         // share of the nearer plane
    F weight;         // 1 / depth^2; 0 outside the image
    // For derivatives: 1 / depth; column and row before rounding, and the columns and rows that the line covers; the position of the
    // point on the line; and the mean of 1 / depth^2 on the line of a single point, divided by 1 / depth^2, less 1.
    F inverse, at[2], covers[2], off, deep;
} Places;

enum { MOST_PARTS = 1 << 12 }; // there would be more only close before the pinhole's plane

INLINE void place_point(Places *p, int point, F along, F offset) {
    const F before = (F)0.5 - offset, after = (F)0.5 + offset;
    p->along[point] = along;
    p->across[point][0] = before * before * (F)0.5;
    p->across[point][1] = (F)0.75 - offset * offset;
    p->across[point][2] = after * after * (F)0.5;
}

// Find the places of point `number` of each voxel's piece, whose centre is `shift` from the voxel's.
INLINE void find_places(
    const DepthJob *job, const double row_start[3], F z, const double shift[3], int number, Places *p
) {
    F at[3], line[3];
    EACH_AXIS(a) at[a] = (F)(REAL)row_start[a] + z * (F)(REAL)job->matrix[a][2];
    EACH_AXIS(a) line[a] = (F)(REAL)job->line[a];
    const I in_zone = (at[2] > (F)(REAL)job->nearest) & (at[2] <= (F)(REAL)job->farthest);
    EACH_AXIS(a) at[a] += (F)(REAL)shift[a];
    F inverse = 1 / (in_zone ? at[2] : (F)1), u = at[0] * inverse, v = at[1] * inverse;
    const F wide = (line[0] - u * line[2]) * inverse, high = (line[1] - v * line[2]) * inverse;
    const F smear = MAX(ABS(wide), ABS(high)), more = MIN(smear * (F)(REAL)job->parts_per_cell, (F)MOST_PARTS);
    const I is_one = smear <= (F)(REAL)job->of_pair;
    p->is_pair = (is_one & (smear > (F)(REAL)job->of_point)) ? (F)0.5 : (F)0;
    p->parts = is_one ? (F)1 : 2 + AS(F, AS(I, in_zone ? more : (F)0));
    const F slope = line[2] * inverse;
    p->deep = slope * slope * (F)0.25, p->off = 0;
    F weight = 1 + p->deep; // the mean of 1 / depth^2 on the line
    if (ANY(!is_one)) {
        const F n = p->parts, off = ((F)(REAL)number - (n - 1) * (F)0.5) / __builtin_elementwise_sqrt(MAX(n * n - 1, (F)1));
        p->off = is_one ? (F)0 : off, p->deep = is_one ? p->deep : (F)0;
        EACH_AXIS(a) at[a] += p->off * line[a];
        inverse = 1 / (in_zone ? at[2] : (F)1), u = at[0] * inverse, v = at[1] * inverse;
        weight = is_one ? weight : 1 / n;
    }
    p->inverse = inverse, p->at[0] = u, p->at[1] = v, p->covers[0] = wide, p->covers[1] = high;
    const I inside = in_zone & (p->parts > (F)(REAL)number) & (u >= (F)1) & (u <= (F)(job->columns - 3)) & (v >= (F)1) &
                     (v <= (F)(job->rows - 2));
    u = inside ? u : (F)1, v = inside ? v : (F)1;
    const I column = AS(I, u + (F)0.5), row = AS(I, v + (F)0.5);
    const F last = (F)(REAL)(job->planes - 1);
    const F plane = MIN(MAX((inverse - (F)(REAL)job->first_plane) * (F)(REAL)job->planes_per_inverse, (F)0), last);
    const I farther = AS(I, MIN(plane, last - 1));
    p->cell = (farther * (I)job->rows + row - 1) * (I)job->columns + column - 1;
    u -= AS(F, column), v -= AS(F, row);
    const F apart = p->is_pair * (F)0.57735026918962576; // times 1/2, the standard deviation of a box, 1 / sqrt(12)
    place_point(p, 0, u - apart * wide, v - apart * high);
    if (ANY(p->is_pair != (F)0)) place_point(p, 1, u + apart * wide, v + apart * high);
    p->nearer = plane - AS(F, farther);
    p->weight = inside ? weight * inverse * inverse : (F)0;
}

typedef REAL Cells __attribute__((ext_vector_type(4), aligned(sizeof(REAL)))); // neighbours in a row

// Shares of three cells in a row, a quadratic B-spline, and 0 of a fourth.
INLINE Cells shares(REAL offset) {
    const Cells none = {0.125, 0.75, 0.125, 0}, once = {-0.5, 0, 0.5, 0}, twice = {0.5, -1, 0.5, 0};
    return none + offset * (once + offset * twice);
}

INLINE F some(const REAL *numbers, int n) {
    F taken = 0;
    for (int i = 0; i < n; i++) taken[i] = numbers[i];
    return taken;
}

// Voxels to cells, or cells to voxels.
INLINE void between(const DepthJob *job, const int gathers) {
    const int64_t *n = job->volume.n, of_plane = job->rows * job->columns;
    F lane;
    EACH_LANE(i) lane[i] = i;
    for (int64_t x = job->first; x < job->last; x++) for (int64_t y = 0; y < n[1]; y++) {
        REAL *const voxels = (REAL *)job->volume.voxels + (x * n[1] + y) * n[2];
        const REAL *passes = job->passes ? (const REAL *)job->passes + (x * n[1] + y) * n[2] : 0;
        double start[3];
        EACH_AXIS(a) start[a] = job->matrix[a][0] * x + job->matrix[a][1] * y + job->matrix[a][3];
        const double end = start[2] + job->matrix[2][2] * (n[2] - 1), margin = 1e-4 * (job->farthest - job->nearest);
        if (MAX(start[2], end) < job->nearest - margin || MIN(start[2], end) > job->farthest + margin) continue;
        for (int64_t z = 0; z < n[2]; z += LANES) {
            const int lanes = (int)MIN((int64_t)LANES, n[2] - z);
            const F f = gathers ? (F)0 : some(voxels + z, lanes);
            if (!gathers && !ANY(f != (F)0)) continue;
            Places p;
            for (int64_t piece = 0; piece < job->pieces; piece++) for (int number = 0; !number || ANY(p.parts > (F)(REAL)number); number++) {
                find_places(job, start, (F)(REAL)z + lane, job->shifts[piece], number, &p);
                if (!ANY(p.weight != (F)0)) continue;
                if (passes) p.weight *= some(passes + z, lanes);
                F value = gathers ? p.weight : p.weight * f;
                value = p.is_pair != (F)0 ? value * p.is_pair : value;
                // Each voxel's numbers are read by their addresses: to extract an element of a vector in a register takes long.
                const REAL *values = (const REAL *)&value, *nearer = (const REAL *)&p.nearer, *is_pair = (const REAL *)&p.is_pair;
                const REAL *along = (const REAL *)&p.along, *across = (const REAL *)p.across;
                const __typeof__(p.cell[0]) *first = (const void *)&p.cell;
                for (int i = 0; i < lanes; i++) {
                    if (values[i] == 0) continue;
                    Cells rows[3], taken[2] = {0}, given = shares(along[i]) * values[i];
                    UNROLLED for (int a = 0; a < 3; a++) rows[a] = across[a * LANES + i] * given;
                    if (is_pair[i] != 0) {
                        given = shares(along[LANES + i]) * values[i];
                        UNROLLED for (int a = 0; a < 3; a++) rows[a] += across[(3 + a) * LANES + i] * given;
                    }
                    REAL *cells = (REAL *)job->cells + first[i];
                    UNROLLED for (int k = 0; k < 2; k++, cells += of_plane) {
                        const REAL of = k ? nearer[i] : 1 - nearer[i];
                        UNROLLED for (int a = 0; a < 3; a++) {
                            Cells *at = (Cells *)(cells + a * job->columns);
                            if (gathers) taken[k] += rows[a] * *at;
                            else *at += rows[a] * of;
                        }
                    }
                    if (gathers) taken[0] += nearer[i] * (taken[1] - taken[0]), voxels[z + i] += (taken[0].x + taken[0].y) + taken[0].z;
                }
            }
        }
    }
}

// Interpolated value of the cells at a point, and its derivatives by column, row and plane.
typedef struct {
    REAL sum, by[3];
} Taken;

INLINE Taken take(const DepthJob *job, const REAL *cells, REAL along, const REAL *across, REAL nearer) {
    const Cells once = {-0.5, 0, 0.5, 0}, twice = {1, -2, 1, 0}, given = shares(along), more = once + along * twice;
    const REAL offset = across[2 * LANES] - across[0], rise[3] = {offset - (REAL)0.5, -2 * offset, offset + (REAL)0.5};
    Cells taken[2][3] = {0};
    UNROLLED for (int k = 0; k < 2; k++, cells += job->rows * job->columns) UNROLLED for (int a = 0; a < 3; a++) {
        const Cells row = *(const Cells *)(cells + a * job->columns);
        taken[k][0] += across[a * LANES] * row, taken[k][1] += rise[a] * row;
    }
    const Cells both = taken[0][0] + nearer * (taken[1][0] - taken[0][0]), up = taken[0][1] + nearer * (taken[1][1] - taken[0][1]);
#define TOTAL(three) ((three).x + (three).y + (three).z)
    return (Taken){
        TOTAL(both * given), {TOTAL(both * more), TOTAL(up * given), TOTAL((taken[1][0] - taken[0][0]) * given)}
    };
#undef TOTAL
}

INLINE void add_lanes(double *sum, F x) { EACH_LANE(i) *sum += x[i]; }

// Add the derivatives of some voxels' point: by the voxels' places, and by the line.
INLINE void add_gradient(const DepthJob *job, const Places *p, F value, const F taken[2][4], double sums[4][3], double xyz[3], F lane) {
    const F deep = (F)(REAL)job->line[2], inverse = p->inverse;
    const F sum = value * (taken[0][0] + taken[1][0]), by_weight = sum / (1 + p->deep);
    F at[3], line[3];
    at[2] = -2 * inverse * (sum + by_weight * p->deep) -
            value * (taken[0][3] + taken[1][3]) * (F)(REAL)job->planes_per_inverse * inverse * inverse;
    line[2] = p->parts == (F)1 ? by_weight * deep * inverse * inverse * (F)0.5 : (F)0;
    UNROLLED for (int a = 0; a < 2; a++) {
        const F by = value * (taken[0][a + 1] + taken[1][a + 1]) * inverse;
        const F apart = value * p->is_pair * (F)0.57735026918962576 * (taken[1][a + 1] - taken[0][a + 1]) * inverse;
        at[a] = by - apart * deep * inverse, line[a] = apart;
        at[2] -= by * p->at[a] + apart * (p->covers[a] - p->at[a] * deep * inverse);
        line[2] -= apart * p->at[a];
    }
    EACH_AXIS(a) {
        double along = 0, whole = 0, by_line = 0;
        add_lanes(&whole, at[a]), add_lanes(&along, at[a] * lane), add_lanes(&by_line, line[a] + p->off * at[a]);
        sums[0][a] += whole, sums[1][a] += whole * xyz[0], sums[2][a] += whole * xyz[1], sums[3][a] += whole * xyz[2] + along;
        job->gradient[a] += by_line;
    }
}

// Derivatives by matrix, shifts and line of the sum of the voxels times the adjoint of the cells.
void KERNEL(differentiate_places)(const DepthJob *job) {
    const int64_t *n = job->volume.n;
    F lane;
    EACH_LANE(i) lane[i] = i;
    for (int64_t x = job->first; x < job->last; x++) for (int64_t y = 0; y < n[1]; y++) for (int64_t z = 0; z < n[2]; z += LANES) {
        const int64_t of_row = (x * n[1] + y) * n[2];
        const int lanes = (int)MIN((int64_t)LANES, n[2] - z);
        F f = some((REAL *)job->volume.voxels + of_row + z, lanes);
        if (!ANY(f != (F)0)) continue;
        if (job->passes) f *= some((const REAL *)job->passes + of_row + z, lanes);
        double start[3], xyz[3] = {x, y, z};
        EACH_AXIS(a) start[a] = job->matrix[a][0] * x + job->matrix[a][1] * y + job->matrix[a][3];
        Places p;
        for (int64_t piece = 0; piece < job->pieces; piece++) for (int number = 0; !number || ANY(p.parts > (F)(REAL)number); number++) {
            find_places(job, start, (F)(REAL)z + lane, job->shifts[piece], number, &p);
            const F value = p.weight * f * (p.is_pair != (F)0 ? p.is_pair : (F)1);
            if (!ANY(value != (F)0)) continue;
            F taken[2][4] = {0};
            const REAL *values = (const REAL *)&value, *is_pair = (const REAL *)&p.is_pair, *nearer = (const REAL *)&p.nearer;
            const REAL *along = (const REAL *)&p.along, *across = (const REAL *)p.across;
            const __typeof__(p.cell[0]) *first = (const void *)&p.cell;
            for (int i = 0; i < lanes; i++) {
                if (values[i] == 0) continue;
                for (int point = 0; point < (is_pair[i] != 0 ? 2 : 1); point++) {
                    const REAL *cells = (const REAL *)job->cells + first[i];
                    const Taken of = take(job, cells, along[point * LANES + i], across + 3 * point * LANES + i, nearer[i]);
                    taken[point][0][i] = of.sum;
                    EACH_AXIS(a) taken[point][a + 1][i] = of.by[a];
                }
            }
            add_gradient(job, &p, value, taken, (double(*)[3])(job->gradient + 3 + 12 * piece), xyz, lane);
        }
    }
}

void KERNEL(voxels_to_cells)(const DepthJob *job) { between(job, 0); }
void KERNEL(cells_to_voxels)(const DepthJob *job) { between(job, 1); }

// The sums below run side by side for neighbours in a row, up to `WIDE` vectors of them, and for `TALL` rows, so that each number that
// is read serves several sums.
enum { WIDE = 5, TALL = LEVEL ? 2 : 1 };

typedef REAL Run __attribute__((ext_vector_type(LANES), aligned(sizeof(REAL))));

// sums += numbers, and their neighbours, times the taps of TALL rows, which are `apart` numbers apart.
INLINE void add_tapped(F sums[TALL][WIDE], const int wide, const REAL *numbers, const REAL *taps, int64_t apart) {
    REAL tap[TALL];
    UNROLLED for (int r = 0; r < TALL; r++) tap[r] = taps[r * apart];
    UNROLLED for (int w = 0; w < wide; w++) {
        const F some = *(const Run *)(numbers + w * LANES);
        UNROLLED for (int r = 0; r < TALL; r++) sums[r][w] += tap[r] * some;
    }
}

// A plane of cells. In a row the cells with the same place in their pixel are side by side, `together` of them.
typedef struct {
    const DepthJob *job;
    const REAL *kernel;        // the taps of a plane
    const int64_t (*bounds)[2]; // bounds of the rows of taps
    REAL *cells;               // cells of the plane
    int64_t together;
} Plane;

INLINE Plane plane_of(const DepthJob *job, int64_t number) {
    const int64_t row = number * (job->taps[0] + 2 * job->step[0]) + job->step[0];
    return (Plane){
        job, (const REAL *)job->kernel + row * job->taps[1], (const int64_t (*)[2])job->bounds + row,
        (REAL *)job->cells + number * job->rows * job->columns, job->columns / job->step[1],
    };
}

// Taps at `place` in a pixel that are not 0 in TALL rows of the kernel, `apart` rows apart: from *first to before *last.
INLINE void find_taps(const Plane *of, int64_t row, int64_t apart, int64_t place, int64_t *first, int64_t *last) {
    const int64_t step = of->job->step[1];
    *first = of->job->taps[1], *last = 0;
    UNROLLED for (int r = 0; r < TALL; r++) {
        *first = MIN(*first, of->bounds[row + r * apart][0]), *last = MAX(*last, of->bounds[row + r * apart][1]);
    }
    *first = place + MAX(*first - place + step - 1, (int64_t)0) / step * step;
}

// Sums of pixels from (i, j) on, each over the cells from its first one on.
INLINE void sum_cells(const Plane *of, int64_t i, int64_t j, const int wide) {
    const DepthJob *job = of->job;
    const int64_t *taps = job->taps, *step = job->step, first = i * step[0];
    const int64_t rows = MIN(taps[0] + (TALL - 1) * step[0], job->rows - first);
    F sums[TALL][WIDE] = {0};
    for (int64_t a = 0; a < rows; a++) for (int64_t place = 0; place < step[1]; place++) {
        int64_t b, last;
        find_taps(of, a, -step[0], place, &b, &last);
        const REAL *cells = of->cells + (first + a) * job->columns + place * of->together + j + b / step[1];
        const REAL *const row = of->kernel + a * taps[1];
        for (; b < last; b += step[1], cells++) add_tapped(sums, wide, cells, row + b, -step[0] * taps[1]);
    }
    for (int64_t r = 0; r < MIN((int64_t)TALL, job->pixels[0] - i); r++) {
        REAL *const pixels = (REAL *)job->image + (i + r) * job->row + j;
        const int64_t n = MIN(wide * (int64_t)LANES, job->pixels[1] - j);
        for (int64_t p = 0; p < n; p++) pixels[p] += ((const REAL *)sums[r])[p];
    }
}

// The adjoint: cells from row r on, at one place in the pixels from j on. Rows at the same place in their pixels are computed together.
INLINE void sum_pixels(const Plane *of, int64_t r, int64_t place, int64_t j, const int wide) {
    const DepthJob *job = of->job;
    const int64_t *taps = job->taps, *step = job->step;
    const int64_t first = r < taps[0] ? 0 : (r - taps[0]) / step[0] + 1, last = MIN(job->pixels[0] - 1, r / step[0] + TALL - 1);
    F sums[TALL][WIDE] = {0};
    for (int64_t i = first; i <= last; i++) {
        int64_t b, end;
        find_taps(of, r - i * step[0], step[0], place, &b, &end);
        const REAL *pixels = (const REAL *)job->image + i * job->row + j - b / step[1];
        const REAL *const row = of->kernel + (r - i * step[0]) * taps[1];
        for (; b < end; b += step[1], pixels--) add_tapped(sums, wide, pixels, row + b, step[0] * taps[1]);
    }
    for (int64_t t = 0; t < TALL && r + t * step[0] < job->rows; t++) {
        REAL *const cells = of->cells + (r + t * step[0]) * job->columns + place * of->together + j;
        const int64_t n = MIN(wide * (int64_t)LANES, of->together - j);
        for (int64_t i = 0; i < n; i++) cells[i] = ((const REAL *)sums[t])[i];
    }
}

// DO(wide) for runs of `wide` vectors from j on, up to number n of a row.
#define EACH_RUN(j, from, n, DO)                                 \
    for (int64_t j = from, wide; j < n; j += wide * LANES) {     \
        wide = MIN((n - j - 1) / (int64_t)LANES + 1, WIDE);      \
        switch (wide) {                                          \
        case 1: DO(1); break;                                    \
        case 2: DO(2); break;                                    \
        case 3: DO(3); break;                                    \
        case 4: DO(4); break;                                    \
        default: DO(5);                                          \
        }                                                        \
    }

// If pixels have kernels of their own, NODE_ROWS rows of pixels from row i on are computed together, for one column of nodes and its
// shares of the pixels. For each row of cells from the first one of row i on, the taps of each of these rows are mixed in the job's room,
// which is large enough for GIVEN_ROWS rows of cells.

// A node's weight in a pixel along one axis.
INLINE REAL of_node(double place, int64_t node) { return (REAL)MAX(1 - __builtin_fabs(place - node), 0.0); }

// Number of rows of cells that NODE_ROWS rows of pixels from row i on sum.
INLINE int64_t tall_of(const DepthJob *job, int64_t i) {
    return MIN(job->taps[0] + (NODE_ROWS - 1) * job->step[0], job->rows - i * job->step[0]);
}

// The nodes before NODE_ROWS rows of pixels: their taps, the shares of the next nodes, and the bounds of taps that are not 0.
typedef struct {
    const REAL *kernels[NODE_ROWS];
    REAL shares[NODE_ROWS];
    const int64_t (*bounds[NODE_ROWS])[2];
} Nodes;

INLINE Nodes nodes_of(const DepthJob *job, int64_t number, int64_t i, int64_t node) {
    Nodes nodes;
    for (int r = 0; r < NODE_ROWS; r++) {
        const double place = job->node_rows[MIN(i + r, job->pixels[0] - 1)];
        const int64_t before = MIN((int64_t)place, job->nodes[0] - 2);
        const int64_t first = ((number * job->nodes[0] + before) * job->nodes[1] + node) * (job->taps[0] + 2 * job->step[0]) + job->step[0];
        nodes.kernels[r] = (const REAL *)job->kernel + first * job->taps[1], nodes.shares[r] = (REAL)(place - before);
        nodes.bounds[r] = (const int64_t (*)[2])job->bounds + first;
    }
    return nodes;
}

// Mix the taps at row a of the cells from *low to before *high, the bounds of all NODE_ROWS rows, and up to `beside` taps beside them.
INLINE void mix(const DepthJob *job, const Nodes *nodes, int64_t a, int64_t beside, REAL *room, int64_t *low, int64_t *high) {
    const int64_t *taps = job->taps, next = job->nodes[1] * (taps[0] + 2 * job->step[0]) * taps[1];
    *low = taps[1], *high = 0;
    UNROLLED for (int r = 0; r < NODE_ROWS; r++) {
        const int64_t row = a - r * job->step[0];
        if (row < 0 || row >= taps[0] || !nodes->bounds[r][row][1]) continue;
        *low = MIN(*low, nodes->bounds[r][row][0]), *high = MAX(*high, nodes->bounds[r][row][1]);
    }
    if (!*high) return;
    const int64_t first = MAX(*low - beside, (int64_t)0), last = MIN(*high + beside, taps[1]);
    UNROLLED for (int r = 0; r < NODE_ROWS; r++) {
        const int64_t row = a - r * job->step[0];
        const int is_there = row >= 0 && row < taps[0];
        const REAL *const one = nodes->kernels[r] + row * taps[1], share = nodes->shares[r];
        REAL *const mixed = room + r * taps[1];
        for (int64_t b = first; b < last; b += LANES) { // whole vectors: numbers after `last` are written anew, or not used
            *(Run *)(mixed + b) = is_there ? *(const Run *)(one + b) + share * (*(const Run *)(one + next + b) - *(const Run *)(one + b)) : (Run)0;
        }
    }
}

// Columns of pixels in which a column of nodes has a share.
INLINE void find_columns(const DepthJob *job, int64_t node, int64_t *first, int64_t *last) {
    int64_t j = 0;
    while (j < job->pixels[1] && job->node_columns[j] <= node - 1) j++;
    *first = j;
    while (j < job->pixels[1] && job->node_columns[j] < node + 1) j++;
    *last = j;
}

INLINE void sum_for_node(const DepthJob *job, const Plane *of, const Nodes *nodes, int64_t i, int64_t j, int64_t node, const int wide) {
    const int64_t *taps = job->taps, *step = job->step;
    REAL *const tap = job->room;
    F sums[2][NODE_ROWS][WIDE] = {0};
    for (int64_t a = 0; a < tall_of(job, i); a++) {
        const REAL *const cells = of->cells + (i * step[0] + a) * job->columns + j;
        int64_t b, end;
        mix(job, nodes, a, 0, tap, &b, &end);
#define ADD(chain, b)                                                                       \
    UNROLLED for (int w = 0; w < wide; w++) {                                               \
        const F some = *(const Run *)(cells + job->columns_of[b] + w * LANES);              \
        UNROLLED for (int r = 0; r < NODE_ROWS; r++) sums[chain][r][w] += tap[b + r * taps[1]] * some; \
    }
        for (; b + 1 < end; b += 2) {
            ADD(0, b)
            ADD(1, b + 1)
        }
        if (b < end) ADD(0, b)
#undef ADD
    }
    for (int64_t r = 0; r < MIN((int64_t)NODE_ROWS, job->pixels[0] - i); r++) {
        UNROLLED for (int w = 0; w < wide; w++) sums[0][r][w] += sums[1][r][w];
        REAL *const pixels = (REAL *)job->image + (i + r) * job->row + j;
        const int64_t n = MIN(wide * (int64_t)LANES, job->pixels[1] - j);
        for (int64_t p = 0; p < n; p++) pixels[p] += ((const REAL *)sums[0][r])[p] * of_node(job->node_columns[j + p], node);
    }
}

// The adjoint: `pixels` are NODE_ROWS rows, `apart` numbers apart, times the node's share, with a zero before each. Two neighbouring taps
// of a place are added together, so that a cell is read and stored once for both. Neighbouring rows of cells follow each other, since a
// processor cannot read at once, a column farther on, what it has just stored. Numbers beyond the node's pixels are 0, and may be added
// anywhere.
INLINE void give_for_node(const DepthJob *job, const Plane *of, const Nodes *nodes, const REAL *pixels, int64_t apart, int64_t i, int64_t j, const int wide) {
    const int64_t *taps = job->taps, *step = job->step, tall = tall_of(job, i);
    REAL *const room = job->room;
    F some[2][NODE_ROWS][WIDE];
    UNROLLED for (int k = 0; k < 2; k++) UNROLLED for (int r = 0; r < NODE_ROWS; r++) UNROLLED for (int w = 0; w < wide; w++) {
        some[k][r][w] = *(const Run *)(pixels + r * apart + j + w * LANES + 1 - k);
    }
    for (int64_t first = 0; first < tall; first += GIVEN_ROWS) {
        const int64_t n = MIN((int64_t)GIVEN_ROWS, tall - first);
        int64_t low[GIVEN_ROWS], high[GIVEN_ROWS], least = taps[1], most = 0;
        for (int64_t a = 0; a < n; a++) {
            mix(job, nodes, first + a, step[1], room + a * NODE_ROWS * taps[1], &low[a], &high[a]);
            least = MIN(least, low[a]), most = MAX(most, high[a]);
        }
        for (int64_t pair = 0; pair < most; pair += 2 * step[1]) for (int64_t b = pair; b < MIN(pair + step[1], most); b++) {
            if (b + step[1] < least) continue;
            REAL *cells = of->cells + (i * step[0] + first) * job->columns + j + job->columns_of[b];
            const REAL *tap = room + b;
#define GIVE(both)                                                                            \
    for (int64_t a = 0; a < n; a++, cells += job->columns, tap += NODE_ROWS * taps[1]) {      \
        if (b + both * step[1] < low[a] || b >= high[a]) continue;                            \
        UNROLLED for (int w = 0; w < wide; w++) {                                             \
            F sum = *(const Run *)(cells + w * LANES);                                        \
            UNROLLED for (int r = 0; r < NODE_ROWS; r++) {                                    \
                sum += tap[r * taps[1]] * some[0][r][w];                                      \
                if (both) sum += tap[r * taps[1] + step[1]] * some[1][r][w];                  \
            }                                                                                 \
            *(Run *)(cells + w * LANES) = sum;                                                \
        }                                                                                     \
    }
            if (b + step[1] < taps[1]) GIVE(1) else GIVE(0)
#undef GIVE
        }
    }
}

INLINE void sum_for_nodes(const DepthJob *job) {
    for (int64_t number = 0; number < job->planes; number++) for (int64_t i = 0; i < job->pixels[0]; i += NODE_ROWS) {
        const Plane plane = plane_of(job, number);
        for (int64_t node = 0, first, last; node < job->nodes[1]; node++) {
            const Nodes nodes = nodes_of(job, number, i, node);
            find_columns(job, node, &first, &last);
#define SUM(wide) sum_for_node(job, &plane, &nodes, i, j, node, wide)
            EACH_RUN(j, first, last, SUM);
#undef SUM
        }
    }
}

// The cells must be 0 before.
INLINE void give_for_nodes(const DepthJob *job) {
    const int64_t apart = (job->pixels[1] + 31) / 16 * 16;
    REAL *const some = (REAL *)job->room + GIVEN_ROWS * NODE_ROWS * job->taps[1] + 16;
    for (int64_t number = 0; number < job->planes; number++) for (int64_t i = 0; i < job->pixels[0]; i += NODE_ROWS) {
        const Plane plane = plane_of(job, number);
        for (int64_t node = 0, first, last; node < job->nodes[1]; node++) {
            const Nodes nodes = nodes_of(job, number, i, node);
            find_columns(job, node, &first, &last);
            for (int64_t r = 0; r < MIN((int64_t)NODE_ROWS, job->pixels[0] - i); r++) for (int64_t j = first; j < last; j++) {
                some[r * apart + j + 1] = ((const REAL *)job->image)[(i + r) * job->row + j] * of_node(job->node_columns[j], node);
            }
#define GIVE_RUN(wide) give_for_node(job, &plane, &nodes, some, apart, i, j, wide)
            EACH_RUN(j, first, last + 1, GIVE_RUN);
#undef GIVE_RUN
            for (int r = 0; r < NODE_ROWS; r++) for (int64_t j = first; j < last; j++) some[r * apart + j + 1] = 0;
        }
    }
}

void KERNEL(cells_to_pixels)(const DepthJob *job) {
    if (job->nodes[1]) {
        sum_for_nodes(job);
        return;
    }
    for (int64_t number = 0; number < job->planes; number++) {
        const Plane plane = plane_of(job, number);
        for (int64_t i = 0; i < job->pixels[0]; i += TALL) {
#define SUM(wide) sum_cells(&plane, i, j, wide)
            EACH_RUN(j, 0, job->pixels[1], SUM);
#undef SUM
        }
    }
}

// Derivatives by the taps of the sum of the pixels of cells_to_pixels, each times its number in `image`.
void KERNEL(differentiate_taps)(const DepthJob *job) {
    const int64_t *taps = job->taps, *step = job->step;
    for (int64_t number = 0; number < job->planes; number++) {
        const Plane plane = plane_of(job, number);
        for (int64_t a = 0; a < taps[0]; a++) for (int64_t b = plane.bounds[a][0]; b < plane.bounds[a][1]; b++) {
            Run sum = {0};
            for (int64_t i = 0; i < job->pixels[0]; i++) {
                const REAL *pixels = (const REAL *)job->image + i * job->row; // zeros come after it
                const REAL *cells = plane.cells + (i * step[0] + a) * job->columns + b % step[1] * plane.together + b / step[1];
                for (int64_t j = 0; j < job->pixels[1]; j += LANES) sum += *(const Run *)(pixels + j) * *(const Run *)(cells + j);
            }
            add_lanes(job->gradient + (number * taps[0] + a) * taps[1] + b, sum);
        }
    }
}

void KERNEL(pixels_to_cells)(const DepthJob *job) {
    if (job->nodes[1]) {
        give_for_nodes(job);
        return;
    }
    for (int64_t number = 0; number < job->planes; number++) {
        const Plane plane = plane_of(job, number);
        for (int64_t r = 0; r < job->rows; r++) {
            if (r / job->step[0] % TALL) continue; // computed with the row above
            for (int64_t place = 0; place < job->step[1]; place++) {
#define SUM(wide) sum_pixels(&plane, r, place, j, wide)
                EACH_RUN(j, 0, plane.together, SUM);
#undef SUM
            }
        }
    }
}
