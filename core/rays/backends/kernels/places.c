// Values of arrays at the places of a lattice's points, under homogeneous transforms, and the adjoint: for resampling of volumes in
// the coordinates of views, and for back-projection of images.

#include "lanes.h"
#include "kernels.h"
#if LEVEL > 0
#include <immintrin.h>
#endif

#define JOIN_(name, level, real) name##_##level##_##real
#define JOIN(name, level, real) JOIN_(name, level, real)
#define KERNEL(name) JOIN(name, LEVEL, REAL)

// For one line of points, all arrays would be read all over memory; for one array, all lines would be written again.
#define ARRAYS_AT_ONCE 8

// Places of some points of a line in an array: the first of the 2 x 2 x 2 elements around each, and the shares of the second ones.
typedef struct {
    I inside, at[3];
    F share[3];
    F weight;
} Places;

typedef struct {
    double at[5], step[5]; // the five numbers p at the job's `middle`, and their change with the points' third coordinate
} Line;

INLINE Line line_of(const PlacesJob *job, const double *matrix, int64_t i, int64_t j) {
    // The start of a line is computed in double, relative to its middle, so that float is enough along it.
    Line line;
    UNROLLED for (int a = 0; a < 5; a++) {
        const double *row = matrix + 4 * a;
        line.at[a] = row[0] * i + row[1] * j + row[2] * job->middle + row[3], line.step[a] = row[2];
    }
    return line;
}

INLINE F along(const Line *line, int row, F third) { return third * (F)(REAL)line->step[row] + (F)(REAL)line->at[row]; }

INLINE I place(F x, int64_t n, I inside, I *first, F *share) {
    inside &= (x >= (F)-0.5) & (x <= (F)((REAL)n - (REAL)0.5));
    const F within = MIN(MAX(x, (F)0), (F)(REAL)(n - 1)); // 0 for what is not a number
    const F low = MIN(within, (F)(REAL)(n > 1 ? n - 2 : 0));
    *first = AS(I, low);
    *share = within - AS(F, *first);
    return inside;
}

INLINE void find_places(const PlacesJob *job, const Line *line, F third, const int flat, Places *p) {
    const F depth = along(line, 3, third);
    I inside = depth > (F)(REAL)job->nearest;
    const F inverse = 1 / (inside ? depth : (F)1);
    inside = place(along(line, 0, third) * inverse, job->m[0], inside, &p->at[0], &p->share[0]);
    inside = place(along(line, 1, third) * inverse, job->m[1], inside, &p->at[1], &p->share[1]);
    if (!flat) {
        const F divisor = along(line, 4, third);
        inside &= divisor > (F)0;
        inside = place(along(line, 2, third) / (inside ? divisor : (F)1), job->m[2], inside, &p->at[2], &p->share[2]);
    }
    p->inside = inside;
    p->weight = job->by_depth ? inverse * inverse : (F)1;
}

INLINE F take(const REAL *array, I index) {
#if LEVEL == 2
    return sizeof(REAL) == 4 ? (F)_mm512_i32gather_ps((__m512i)index, array, 4) : (F)_mm512_i64gather_pd((__m512i)index, array, 8);
#elif LEVEL == 1
    return sizeof(REAL) == 4 ? (F)_mm256_i32gather_ps((const float *)array, (__m256i)index, 4)
                             : (F)_mm256_i64gather_pd((const double *)array, (__m256i)index, 8);
#else
    F values;
    EACH_LANE(i) values[i] = array[index[i]];
    return values;
#endif
}

INLINE F some(const REAL *numbers, int n) {
    F taken = 0;
    if (n == (int)LANES) __builtin_memcpy(&taken, numbers, sizeof taken);
    else for (int i = 0; i < n; i++) taken[i] = numbers[i];
    return taken;
}

INLINE void put(REAL *numbers, int n, F values) {
    if (n == (int)LANES) __builtin_memcpy(numbers, &values, sizeof values);
    else for (int i = 0; i < n; i++) numbers[i] = values[i];
}

INLINE void add(int32_t *numbers, int n, I values) {
    typedef int32_t Whole __attribute__((ext_vector_type(LANES)));
    const Whole added = AS(Whole, values);
    Whole old;
    if (n == (int)LANES) {
        __builtin_memcpy(&old, numbers, sizeof old);
        old += added;
        __builtin_memcpy(numbers, &old, sizeof old);
    } else {
        for (int i = 0; i < n; i++) numbers[i] += added[i];
    }
}

// Interpolation between two neighbours along an axis; a single element is both neighbours.
INLINE F between(F first, F second, F share) { return first + share * (second - first); }

INLINE F plane_of(const REAL *array, I index, int64_t next, int64_t across, const Places *p) {
    const F near = between(take(array, index), take(array + next, index), p->share[1]);
    const F far = between(take(array + across, index), take(array + across + next, index), p->share[1]);
    return between(near, far, p->share[0]);
}

INLINE F value_at(const PlacesJob *job, const REAL *array, const Places *p, const int flat) {
    const int64_t *m = job->m, next = m[1] > 1 ? m[2] : 0, across = m[0] > 1 ? m[1] * m[2] : 0;
    const I index = (p->at[0] * (I)(__typeof__(p->at[0][0]))m[1] + p->at[1]) * (I)(__typeof__(p->at[0][0]))m[2];
    if (flat) return plane_of(array, index, next, across, p);
    const int64_t beyond = m[2] > 1;
    return between(plane_of(array, index + p->at[2], next, across, p), plane_of(array + beyond, index + p->at[2], next, across, p),
                   p->share[2]);
}

// A product of many numbers is stored as a number from 1 to 2 and a power of 2: neither grows too large or too small. Numbers that are
// not finite stay as they are.
#define FRACTION_BITS (sizeof(REAL) == 4 ? 23 : 52)
#define BIAS (sizeof(REAL) == 4 ? 127 : 1023)

INLINE F normalised(F product, I *exponent) {
    I bits = (I)product;
    const I zero = product < (F)(sizeof(REAL) == 4 ? 1.17549435e-38 : 2.2250738585072014e-308);
    const I usual = (product < (F)__builtin_inf()) & ~zero;
    *exponent = usual ? (bits >> FRACTION_BITS) - BIAS : (I)0;
    bits = (bits & (((I)1 << FRACTION_BITS) - 1)) | ((I)BIAS << FRACTION_BITS);
    return zero ? (F)0 : usual ? (F)bits : product;
}

// The smaller one; if x is not a number, x.
INLINE F least(F x, F y) { return ((x < y) | (x != x)) ? x : y; }

INLINE void combine(const PlacesJob *job, const REAL *array, const double *matrix, int64_t i, int64_t j, const int flat, const int how) {
    const int64_t n = job->n[2], start = (i * job->n[1] + j) * n;
    const Line line = line_of(job, matrix, i, j);
    REAL *values = (REAL *)job->points + start;
    for (int64_t k = 0; k < n; k += LANES) {
        const int lanes = (int)MIN((int64_t)LANES, n - k);
        Places p;
        find_places(job, &line, some((const REAL *)job->planes + k, lanes), flat, &p);
        if (!ANY(p.inside)) continue;
        const F value = value_at(job, array, &p, flat) * p.weight, old = some(values + k, lanes);
        I exponent = 0;
        const F changed = how == SUM ? old + value : how == LEAST ? least(old, value) : normalised(old * value, &exponent);
        put(values + k, lanes, p.inside ? changed : old);
        if (job->exponents) add(job->exponents + start + k, lanes, p.inside ? exponent : (I)0);
        if (job->seen) add(job->seen + start + k, lanes, -p.inside); // true is -1
    }
}

INLINE void combine_all(const PlacesJob *job, const int flat, const int how) {
    const int64_t size = job->m[0] * job->m[1] * job->m[2];
    for (int64_t first = 0; first < job->arrays; first += ARRAYS_AT_ONCE) {
        const int64_t end = MIN(first + ARRAYS_AT_ONCE, job->arrays);
        for (int64_t i = job->first; i < job->last; i++)
            for (int64_t j = 0; j < job->n[1]; j++)
                for (int64_t a = first; a < end; a++)
                    combine(job, (const REAL *)job->values + a * size, job->matrices + 20 * a, i, j, flat, how);
    }
}

void KERNEL(take_at)(const PlacesJob *job) {
    switch (2 * job->how + job->flat) {
    case 2 * SUM: combine_all(job, 0, SUM); break;
    case 2 * SUM + 1: combine_all(job, 1, SUM); break;
    case 2 * LEAST: combine_all(job, 0, LEAST); break;
    case 2 * LEAST + 1: combine_all(job, 1, LEAST); break;
    case 2 * PRODUCT: combine_all(job, 0, PRODUCT); break;
    default: combine_all(job, 1, PRODUCT);
    }
}

// Whether a line may share numbers out to elements of the array's first axis from `first` to `last`.
INLINE int may_give(const PlacesJob *job, const Line *line) {
    double place[2];
    UNROLLED for (int end = 0; end < 2; end++) {
        const double third = ((const REAL *)job->planes)[end ? job->n[2] - 1 : 0];
        const double depth = line->at[3] + third * line->step[3];
        if (!(depth > 0)) return 1; // a part of the line may: places change in one direction only between points in front
        place[end] = (line->at[0] + third * line->step[0]) / depth;
    }
    const int before = place[0] + 1 < job->first && place[1] + 1 < job->first; // never for what is not a number
    return !before && !(place[0] - 1 >= job->last && place[1] - 1 >= job->last);
}

INLINE void give_all(const PlacesJob *job, const int flat) {
    const int64_t *n = job->n, *m = job->m;
    // A single element along an axis is both neighbours: the share of the second one is 0, but the product is not a number if
    // the point's number is not finite. Along the first axis the second neighbour is not a plane of this job.
    const int64_t along_axes[3] = {m[1] * m[2], m[1] > 1 ? m[2] : 0, m[2] > 1};
    for (int64_t i = 0; i < n[0]; i++) for (int64_t j = 0; j < n[1]; j++) {
        const Line line = line_of(job, job->matrices, i, j);
        if (!may_give(job, &line)) continue;
        const REAL *given = (const REAL *)job->points + (i * n[1] + j) * n[2];
        for (int64_t k = 0; k < n[2]; k += LANES) {
            const int lanes = (int)MIN((int64_t)LANES, n[2] - k);
            const F f = some(given + k, lanes);
            if (!ANY(f != (F)0)) continue;
            Places p;
            find_places(job, &line, some((const REAL *)job->planes + k, lanes), flat, &p);
            const F value = p.inside ? f * p.weight : (F)0;
            for (int a = 0; a < lanes; a++) {
                if (value[a] == 0) continue;
                for (int corner = 0; corner < (flat ? 4 : 8); corner++) {
                    REAL share = value[a];
                    int64_t index = 0;
                    UNROLLED for (int axis = 0; axis < (flat ? 2 : 3); axis++) {
                        const int second = corner >> axis & 1;
                        share *= second ? p.share[axis][a] : 1 - p.share[axis][a];
                        index += (p.at[axis][a] + second) * along_axes[axis];
                    }
                    const int64_t plane = p.at[0][a] + (corner & 1);
                    if (share != 0 && plane >= job->first && plane < job->last) ((REAL *)job->values)[index] += share;
                }
            }
        }
    }
}

void KERNEL(give_at)(const PlacesJob *job) {
    if (job->flat) give_all(job, 1);
    else give_all(job, 0);
}
