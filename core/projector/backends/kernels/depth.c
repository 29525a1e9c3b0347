// The image of a pinhole blurred depth by depth: voxels to planes of a fine image and back, planes to pixels and back.

#include "kernels.h"
#include "lanes.h"

#define JOIN_(name, level, real) name##_##level##_##real
#define JOIN(name, level, real) JOIN_(name, level, real)
#define KERNEL(name) JOIN(name, LEVEL, REAL)

// Where some voxels of a row, neighbours along z, lie in the fine image. In memory: they are taken one by one.
typedef struct {
    I cell;           // the first of 3 x 3 cells in the farther of two planes, a number in `cells`
    F along;          // columns from the middle one of the three
    F across[3];      // shares of their rows: a quadratic B-spline
    F nearer;         // share of the nearer plane
    F weight;         // 1 / depth^2; 0 outside the image
} Places;

INLINE void find_places(const DepthJob *job, const double row_start[3], F z, Places *p) {
    F at[3];
    EACH_AXIS(a) at[a] = (F)(REAL)row_start[a] + z * (F)(REAL)job->matrix[a][2];
    const I in_zone = (at[2] > (F)(REAL)job->nearest) & (at[2] <= (F)(REAL)job->farthest);
    EACH_AXIS(a) at[a] += (F)(REAL)job->shift[a];
    const F inverse = 1 / (in_zone ? at[2] : (F)1);
    const F u = at[0] * inverse, v = at[1] * inverse;
    const I inside = in_zone & (u >= (F)1) & (u <= (F)(job->columns - 3)) & (v >= (F)1) & (v <= (F)(job->rows - 2));
    const I column = AS(I, inside ? u + (F)0.5 : (F)1), row = AS(I, inside ? v + (F)0.5 : (F)1);
    const F last = (F)(REAL)(job->planes - 1);
    const F plane = MIN(MAX((inverse - (F)(REAL)job->first_plane) * (F)(REAL)job->planes_per_inverse, (F)0), last);
    const I farther = AS(I, MIN(plane, last - 1));
    p->cell = (farther * (I)job->rows + row - 1) * (I)job->columns + column - 1;
    p->along = inside ? u - AS(F, column) : (F)0;
    const F offset = inside ? v - AS(F, row) : (F)0, before = (F)0.5 - offset, after = (F)0.5 + offset;
    p->across[0] = before * before * (F)0.5;
    p->across[1] = (F)0.75 - offset * offset;
    p->across[2] = after * after * (F)0.5;
    p->nearer = plane - AS(F, farther);
    p->weight = inside ? inverse * inverse : (F)0;
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
            find_places(job, start, (F)(REAL)z + lane, &p);
            if (!ANY(p.weight != (F)0)) continue;
            if (passes) p.weight *= some(passes + z, lanes);
            const F value = gathers ? p.weight : p.weight * f;
            // Each voxel's numbers by their addresses: an element of a vector in a register is dear.
            const REAL *values = (const REAL *)&value, *nearer = (const REAL *)&p.nearer;
            const REAL *along = (const REAL *)&p.along, *across = (const REAL *)p.across;
            const __typeof__(p.cell[0]) *first = (const void *)&p.cell;
            for (int i = 0; i < lanes; i++) {
                if (values[i] == 0) continue;
                const Cells row = shares(along[i]) * values[i];
                REAL *cells = (REAL *)job->cells + first[i];
                REAL of[2] = {1 - nearer[i], nearer[i]}, sum = 0;
                UNROLLED for (int k = 0; k < 2; k++, cells += of_plane) {
                    const Cells given = row * of[k];
                    Cells taken = 0;
                    UNROLLED for (int a = 0; a < 3; a++) {
                        Cells *at = (Cells *)(cells + a * job->columns);
                        const REAL share = across[a * LANES + i];
                        if (gathers) taken += share * *at;
                        else *at += share * given;
                    }
                    if (gathers) taken *= given, sum += (taken.x + taken.y) + taken.z;
                }
                if (gathers) voxels[z + i] += sum;
            }
        }
    }
}

void KERNEL(voxels_to_cells)(const DepthJob *job) { between(job, 0); }
void KERNEL(cells_to_voxels)(const DepthJob *job) { between(job, 1); }

// The sums below run side by side for neighbours in a row, up to `WIDE` vectors of them, and for `TALL` rows, so that what is read
// counts for several.
enum { WIDE = 5, TALL = LEVEL ? 2 : 1 };

typedef REAL Run __attribute__((ext_vector_type(LANES), aligned(sizeof(REAL))));

// sums += numbers, and those beside them, times taps of as many rows; the rows' taps lie `apart`.
INLINE void add_tapped(F sums[TALL][WIDE], const int wide, const REAL *numbers, const REAL *taps, int64_t apart) {
    REAL tap[TALL];
    int any = 0;
    UNROLLED for (int r = 0; r < TALL; r++) tap[r] = taps[r * apart], any |= tap[r] != 0;
    if (!any) return; // the corners around a disc
    UNROLLED for (int w = 0; w < wide; w++) {
        const F some = *(const Run *)(numbers + w * LANES);
        UNROLLED for (int r = 0; r < TALL; r++) sums[r][w] += tap[r] * some;
    }
}

// target += the first `n` of a row of sums.
INLINE void add_sums(REAL *target, const F sums[WIDE], int64_t n) {
    const REAL *sum = (const REAL *)sums;
    for (int64_t i = 0; i < n; i++) target[i] += sum[i];
}

// A row of cells has those with the same place in their pixel side by side, `together` of them.
typedef struct {
    const DepthJob *job;
    const REAL *kernel;  // the taps of a plane
    REAL *cells;         // of the plane
    int64_t together;
} Plane;

INLINE Plane plane_of(const DepthJob *job, int64_t number) {
    return (Plane){
        job, (const REAL *)job->kernel + (number * (job->taps[0] + 2 * job->step[0]) + job->step[0]) * job->taps[1],
        (REAL *)job->cells + number * job->rows * job->columns, job->columns / job->step[1],
    };
}

// Pixels from (i, j) on: each is a sum over the cells from its first on.
INLINE void sum_cells(const Plane *of, int64_t i, int64_t j, const int wide) {
    const DepthJob *job = of->job;
    const int64_t *taps = job->taps, *step = job->step, first = i * step[0];
    const int64_t rows = MIN(taps[0] + (TALL - 1) * step[0], job->rows - first);
    F sums[TALL][WIDE] = {0};
    for (int64_t a = 0; a < rows; a++) for (int64_t place = 0; place < step[1]; place++) {
        const REAL *cells = of->cells + (first + a) * job->columns + place * of->together + j;
        const REAL *const row = of->kernel + a * taps[1];
        for (int64_t b = place; b < taps[1]; b += step[1], cells++) add_tapped(sums, wide, cells, row + b, -step[0] * taps[1]);
    }
    for (int64_t r = 0; r < MIN((int64_t)TALL, job->pixels[0] - i); r++) {
        add_sums((REAL *)job->image + (i + r) * job->row + j, sums[r], MIN(wide * (int64_t)LANES, job->pixels[1] - j));
    }
}

// The adjoint: cells from row r on, at one place of pixels j on. Rows at the same place in their pixels are done together.
INLINE void sum_pixels(const Plane *of, int64_t r, int64_t place, int64_t j, const int wide) {
    const DepthJob *job = of->job;
    const int64_t *taps = job->taps, *step = job->step;
    const int64_t first = r < taps[0] ? 0 : (r - taps[0]) / step[0] + 1, last = MIN(job->pixels[0] - 1, r / step[0] + TALL - 1);
    F sums[TALL][WIDE] = {0};
    for (int64_t i = first; i <= last; i++) {
        const REAL *pixels = (const REAL *)job->image + i * job->row + j;
        const REAL *const row = of->kernel + (r - i * step[0]) * taps[1];
        for (int64_t b = place; b < taps[1]; b += step[1], pixels--) add_tapped(sums, wide, pixels, row + b, step[0] * taps[1]);
    }
    for (int64_t t = 0; t < TALL && r + t * step[0] < job->rows; t++) {
        REAL *const cells = of->cells + (r + t * step[0]) * job->columns + place * of->together + j;
        add_sums(cells, sums[t], MIN(wide * (int64_t)LANES, of->together - j));
    }
}

// DO(wide) for every `wide` vectors from j on, until n numbers of a row are done.
#define EACH_RUN(j, n, DO)                                       \
    for (int64_t j = 0, wide; j < n; j += wide * LANES) {        \
        wide = MIN((n - j - 1) / (int64_t)LANES + 1, WIDE);      \
        switch (wide) {                                          \
        case 1: DO(1); break;                                    \
        case 2: DO(2); break;                                    \
        case 3: DO(3); break;                                    \
        case 4: DO(4); break;                                    \
        default: DO(5);                                          \
        }                                                        \
    }

void KERNEL(cells_to_pixels)(const DepthJob *job) {
    for (int64_t number = 0; number < job->planes; number++) {
        const Plane plane = plane_of(job, number);
        for (int64_t i = 0; i < job->pixels[0]; i += TALL) {
#define SUM(wide) sum_cells(&plane, i, j, wide)
            EACH_RUN(j, job->pixels[1], SUM);
#undef SUM
        }
    }
}

void KERNEL(pixels_to_cells)(const DepthJob *job) {
    for (int64_t number = 0; number < job->planes; number++) {
        const Plane plane = plane_of(job, number);
        for (int64_t r = 0; r < job->rows; r++) {
            if (r / job->step[0] % TALL) continue; // done with the row above
            for (int64_t place = 0; place < job->step[1]; place++) {
#define SUM(wide) sum_pixels(&plane, r, place, j, wide)
                EACH_RUN(j, plane.together, SUM);
#undef SUM
            }
        }
    }
}
