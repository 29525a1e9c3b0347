// Voxel-driven backprojection, as filtered backprojections need it: a voxel takes from every image what is at its place there,
// interpolated, divided by the square of its depth.
//
// Compiled once for every level of processor, for float.

#include "lanes.h"
#include "kernels.h"
#if LEVEL > 0
#include <immintrin.h>
#endif

#define BEHIND 1e-3f // depths, in distances from source to detector, at which nothing is taken
// Of one line of voxels all views would read images all over memory, of one view all lines would write the whole volume.
#define VIEWS_AT_ONCE 8

INLINE F take(const float *image, I index) {
#if LEVEL == 2
    return (F)_mm512_i32gather_ps((__m512i)index, image, 4);
#elif LEVEL == 1
    return (F)_mm256_i32gather_ps(image, (__m256i)index, 4);
#else
    F values;
    EACH_LANE(i) values[i] = image[index[i]];
    return values;
#endif
}

INLINE void add_line(const Smear *job, const double *p, const float *image, const double x, const double y, float *line) {
    const int64_t n = job->n[2], stride = job->columns;
    const F last_column = job->columns - 2, last_row = job->rows - 2;
    // Places are computed in double where a line begins, and relative to its middle, so that float is enough along it.
    const double middle = 0.5 * (n - 1);
    float at[3], step[3];
    EACH_AXIS(a) at[a] = p[4 * a] * x + p[4 * a + 1] * y + p[4 * a + 2] * middle + p[4 * a + 3], step[a] = p[4 * a + 2];
    F lanes;
    EACH_LANE(i) lanes[i] = i - (float)middle;
    for (int64_t k = 0; k < n; k += LANES) {
        const F z = lanes + (float)k;
        const F depth = z * step[2] + at[2];
        const I front = depth > (F)BEHIND;
        const F inverse = 1 / (front ? depth : (F)1);
        const F column = MAX(MIN((z * step[0] + at[0]) * inverse, last_column), (F)0);
        const F row = MAX(MIN((z * step[1] + at[1]) * inverse, last_row), (F)0);
        const I j = AS(I, column), i = AS(I, row);
        const F right = column - AS(F, j), down = row - AS(F, i);
        const I index = i * (I)(int32_t)stride + j;
        const F above = take(image, index), below = take(image + stride, index);
        const F above_right = take(image + 1, index), below_right = take(image + stride + 1, index);
        const F upper = above + right * (above_right - above), lower = below + right * (below_right - below);
        const F value = (upper + down * (lower - upper)) * (inverse * inverse);
        const F added = front ? value : (F)0;
        if (k + (int64_t)LANES <= n) {
            F old;
            __builtin_memcpy(&old, line + k, sizeof old);
            old += added;
            __builtin_memcpy(line + k, &old, sizeof old);
        } else {
            for (int64_t rest = 0; rest < n - k; rest++) line[k + rest] += added[rest];
        }
    }
}

#define NAME(level) JOINED(smear, level)
#define JOINED(task, level) JOINED_(task, level)
#define JOINED_(task, level) task##_##level

void NAME(LEVEL)(const Smear *job) {
    for (int64_t first = 0; first < job->views; first += VIEWS_AT_ONCE) {
        const int64_t end = first + VIEWS_AT_ONCE < job->views ? first + VIEWS_AT_ONCE : job->views;
        for (int64_t i = 0; i < job->n[0]; i++)
            for (int64_t j = 0; j < job->n[1]; j++)
                for (int64_t m = first; m < end; m++)
                    add_line(job, job->matrices + 12 * m, job->images + m * job->rows * job->columns, i, j,
                             job->volume + (i * job->n[1] + j) * job->n[2]);
    }
}
