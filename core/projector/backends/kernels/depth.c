// The image of a pinhole blurred depth by depth: voxels to planes of a fine image and back, planes to pixels and back.
// Four planes lie side by side in memory, so that one vector holds a cell of all of them.

#include "kernels.h"
#include "lanes.h"

#define JOIN_(name, level, real) name##_##level##_##real
#define JOIN(name, level, real) JOIN_(name, level, real)
#define KERNEL(name) JOIN(name, LEVEL, REAL)

typedef REAL Cell __attribute__((ext_vector_type(PLANES), aligned(sizeof(REAL)))); // of the fine image, in all planes

// Where some voxels of a row, neighbours along z, lie in the fine image. In memory: they are taken one by one.
typedef struct {
    I cell;                // the first of 3 x 3 cells, a number in `cells`
    F along[3], across[3]; // shares of their columns and rows: a quadratic B-spline
    F plane;               // between 0 and PLANES - 1
    F weight;              // 1 / depth^2; 0 outside the image
} Places;

INLINE void spline(F offset, F shares[3]) {
    const F left = (F)0.5 - offset, right = (F)0.5 + offset;
    shares[0] = left * left * (F)0.5;
    shares[1] = (F)0.75 - offset * offset;
    shares[2] = right * right * (F)0.5;
}

INLINE void find_places(const DepthJob *job, const double row_start[3], F z, Places *p) {
    F at[3];
    EACH_AXIS(a) at[a] = (F)(REAL)row_start[a] + z * (F)(REAL)job->matrix[a][2];
    const I in_front = at[2] > (F)(REAL)job->nearest;
    const F inverse = 1 / (in_front ? at[2] : (F)1);
    const F u = at[0] * inverse, v = at[1] * inverse;
    const I inside = in_front & (u >= (F)1) & (u <= (F)(job->columns - 2)) & (v >= (F)1) & (v <= (F)(job->rows - 2));
    const I column = AS(I, inside ? u + (F)0.5 : (F)1), row = AS(I, inside ? v + (F)0.5 : (F)1);
    p->cell = ((row - 1) * (I)job->columns + column - 1) * PLANES;
    spline(inside ? u - AS(F, column) : (F)0, p->along);
    spline(inside ? v - AS(F, row) : (F)0, p->across);
    p->plane = MIN(MAX((inverse - (F)(REAL)job->first_plane) * (F)(REAL)job->planes_per_inverse, (F)0), (F)(PLANES - 1));
    p->weight = inside ? inverse * inverse : (F)0;
}

INLINE REAL sum_of(Cell cell) { return (cell.x + cell.y) + (cell.z + cell.w); }

INLINE Cell shares_of_planes(REAL plane) {
    const Cell number = {0, 1, 2, 3};
    return MAX(1 - ABS(number - plane), (Cell)0);
}

INLINE F some(const REAL *numbers, int n) {
    F taken = 0;
    for (int i = 0; i < n; i++) taken[i] = numbers[i];
    return taken;
}

// Voxels to cells, or cells to voxels.
INLINE void between(const DepthJob *job, const int gathers) {
    const int64_t *n = job->volume.n, width = job->columns * PLANES;
    F lane;
    EACH_LANE(i) lane[i] = i;
    for (int64_t x = job->first; x < job->last; x++) for (int64_t y = 0; y < n[1]; y++) {
        REAL *const voxels = (REAL *)job->volume.voxels + (x * n[1] + y) * n[2];
        const REAL *passes = job->passes ? (const REAL *)job->passes + (x * n[1] + y) * n[2] : 0;
        double start[3];
        EACH_AXIS(a) start[a] = job->matrix[a][0] * x + job->matrix[a][1] * y + job->matrix[a][3];
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
            const REAL *values = (const REAL *)&value, *planes = (const REAL *)&p.plane, *along = (const REAL *)p.along;
            const REAL *across = (const REAL *)p.across;
            const __typeof__(p.cell[0]) *first = (const void *)&p.cell;
            for (int i = 0; i < lanes; i++) {
                if (values[i] == 0) continue;
                REAL *cell = (REAL *)job->cells + first[i];
                const Cell of_voxel = shares_of_planes(planes[i]) * values[i];
                const Cell left = (Cell)along[i], middle = (Cell)along[LANES + i], right = (Cell)along[2 * LANES + i];
                Cell sum = 0;
                UNROLLED for (int a = 0; a < 3; a++, cell += width) {
                    Cell *of = (Cell *)cell;
                    const Cell share = (Cell)across[a * LANES + i];
                    if (gathers) {
                        sum += share * (left * of[0] + middle * of[1] + right * of[2]);
                    } else {
                        const Cell given = of_voxel * share;
                        of[0] += given * left;
                        of[1] += given * middle;
                        of[2] += given * right;
                    }
                }
                if (gathers) voxels[z + i] += sum_of(sum * of_voxel);
            }
        }
    }
}

void KERNEL(voxels_to_cells)(const DepthJob *job) { between(job, 0); }
void KERNEL(cells_to_voxels)(const DepthJob *job) { between(job, 1); }

// A pixel is a sum over the cells around its centre, row by row: the taps of all planes are one run of numbers, a multiple
// of RUN long, and as many sums run side by side.
typedef REAL Run __attribute__((ext_vector_type(RUN), aligned(sizeof(REAL))));

void KERNEL(cells_to_pixels)(const DepthJob *job) {
    const int64_t run = job->taps[1] * PLANES, width = job->columns * PLANES;
    for (int64_t i = 0; i < job->pixels[0]; i++) for (int64_t j = 0; j < job->pixels[1]; j++) {
        const REAL *taps = job->kernel;
        const REAL *cells = (const REAL *)job->cells + i * job->step[0] * width + j * job->step[1] * PLANES;
        Run sums[2] = {0, 0}; // of even and odd rows: none waits for the other
        for (int64_t a = 0; a < job->taps[0]; a++, taps += run, cells += width) {
            Run sum = sums[a % 2];
            for (int64_t b = 0; b < run; b += RUN) sum += *(const Run *)(taps + b) * *(const Run *)(cells + b);
            sums[a % 2] = sum;
        }
        const Run sum = sums[0] + sums[1];
        REAL total = 0;
        UNROLLED for (int b = 0; b < RUN; b++) total += sum[b];
        ((REAL *)job->image)[i * job->pixels[1] + j] = total;
    }
}

void KERNEL(pixels_to_cells)(const DepthJob *job) {
    const int64_t run = job->taps[1] * PLANES, width = job->columns * PLANES;
    for (int64_t i = 0; i < job->pixels[0]; i++) for (int64_t j = 0; j < job->pixels[1]; j++) {
        const REAL *taps = job->kernel;
        REAL *cells = (REAL *)job->cells + i * job->step[0] * width + j * job->step[1] * PLANES;
        const REAL value = ((const REAL *)job->image)[i * job->pixels[1] + j];
        if (value == 0) continue;
        for (int64_t a = 0; a < job->taps[0]; a++, taps += run, cells += width) {
            for (int64_t b = 0; b < run; b += RUN) *(Run *)(cells + b) += value * *(const Run *)(taps + b);
        }
    }
}
