/* A plain projector in C, the yardstick of the benchmark: one ray after the other, voxel by voxel, exact (R. Siddon,
 * Medical Physics 12 (1985) 252; stepping as of J. Amanatides and A. Woo, Eurographics 1987), parallel over tiles of
 * pixels with OpenMP. No vector code by hand.
 *
 *     cc -O3 -march=native -fopenmp -shared -fPIC siddon.c -o siddon.so -lm
 *
 * Volumes are float[nx][ny][nz]. Rays are in index space, where voxel i of an axis fills [i, i + 1]. A camera is 12
 * numbers: the source, the centre of pixel (0, 0), and the steps to the next column and to the next row. Voxels are
 * cubes of `size` mm. Images are float[views][rows][columns], value times mm.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MIN(a, b) ((a) < (b) ? (a) : (b)) /* one instruction, which fmin is not */
#define MAX(a, b) ((a) > (b) ? (a) : (b))
#define TILE 8 /* pixels along each side that one thread traces one after the other: neighbours share their voxels */

typedef struct {
    double alpha, end; /* fractions of the ray: where it is, where it leaves the volume or ends */
    double x, y, z;    /* fractions at which it meets the next plane of each axis */
    double dx, dy, dz; /* from plane to plane */
    long voxel, sx, sy, sz;
    double length; /* mm */
} Ray;

/* The first plane of an axis, the way to the next ones, and the index of the first voxel. */
static int first_plane(double source, double along, double alpha, int n, double *next, double *step, int *up)
{
    int i = (int)floor(source + alpha * along);
    i = i < 0 ? 0 : i >= n ? n - 1 : i;
    *up = along > 0;
    *step = along != 0 ? 1 / fabs(along) : INFINITY;
    *next = along != 0 ? (i + *up - source) / along : INFINITY;
    return i;
}

/* Put the ray from `source` to `target` before its first voxel; 0 if it misses. */
static int enter(Ray *ray, const double *source, const double *target, const int *n, double size)
{
    double along[3];
    ray->alpha = 0;
    ray->end = 1;
    for (int a = 0; a < 3; a++) {
        along[a] = target[a] - source[a];
        if (along[a] != 0) {
            double first = -source[a] / along[a], last = (n[a] - source[a]) / along[a];
            ray->alpha = MAX(ray->alpha, MIN(first, last));
            ray->end = MIN(ray->end, MAX(first, last));
        } else if (source[a] < 0 || source[a] >= n[a]) {
            return 0;
        }
    }
    /* A little short, so that rounding never steps out of the volume. */
    ray->end -= 1e-9;
    if (ray->alpha >= ray->end)
        return 0;
    int ux, uy, uz;
    long i = first_plane(source[0], along[0], ray->alpha, n[0], &ray->x, &ray->dx, &ux);
    long j = first_plane(source[1], along[1], ray->alpha, n[1], &ray->y, &ray->dy, &uy);
    long k = first_plane(source[2], along[2], ray->alpha, n[2], &ray->z, &ray->dz, &uz);
    ray->voxel = (i * n[1] + j) * n[2] + k;
    ray->sx = (ux ? 1L : -1L) * n[1] * n[2];
    ray->sy = (uy ? 1L : -1L) * n[2];
    ray->sz = uz ? 1 : -1;
    ray->length = size * sqrt(along[0] * along[0] + along[1] * along[1] + along[2] * along[2]);
    return 1;
}

/* The voxel that the ray is in and the fraction of the ray that is in it; moves on to the next. -1 at the end. */
static inline long advance(Ray *ray, double *part)
{
    if (ray->alpha >= ray->end)
        return -1;
    long voxel = ray->voxel;
    double next;
    if (ray->x < ray->y && ray->x < ray->z) {
        next = ray->x;
        ray->x += ray->dx;
        ray->voxel += ray->sx;
    } else if (ray->y < ray->z) {
        next = ray->y;
        ray->y += ray->dy;
        ray->voxel += ray->sy;
    } else {
        next = ray->z;
        ray->z += ray->dz;
        ray->voxel += ray->sz;
    }
    next = MIN(next, ray->end);
    *part = next - ray->alpha;
    ray->alpha = next;
    return voxel;
}

/* The ray of pixel `q`, pixels counted tile by tile through all views; 0 if it misses. `pixel` is its place in memory. */
static inline int ray_of(long tile, int inside, const double *cameras, int rows, int columns, const int *n, double size,
                         Ray *ray, long *pixel)
{
    long across = (columns + TILE - 1) / TILE, down = (rows + TILE - 1) / TILE;
    long m = tile / (across * down), row = tile / across % down * TILE + inside / TILE;
    long column = tile % across * TILE + inside % TILE;
    if (row >= rows || column >= columns)
        return 0;
    const double *camera = cameras + 12 * m;
    double target[3];
    for (int a = 0; a < 3; a++)
        target[a] = camera[3 + a] + column * camera[6 + a] + row * camera[9 + a];
    *pixel = (m * rows + row) * columns + column;
    return enter(ray, camera, target, n, size);
}

static long tiles(int views, int rows, int columns)
{
    return (long)views * ((rows + TILE - 1) / TILE) * ((columns + TILE - 1) / TILE);
}

void forward(const float *volume, const int *n, double size, const double *cameras, int views, int rows, int columns,
             float *images)
{
    memset(images, 0, sizeof(float) * views * rows * columns);
#pragma omp parallel for schedule(dynamic, 8)
    for (long tile = 0; tile < tiles(views, rows, columns); tile++)
        for (int inside = 0; inside < TILE * TILE; inside++) {
            Ray ray;
            long pixel, p;
            double part, sum = 0;
            if (!ray_of(tile, inside, cameras, rows, columns, n, size, &ray, &pixel))
                continue;
            while ((p = advance(&ray, &part)) >= 0)
                sum += part * volume[p];
            images[pixel] = (float)(sum * ray.length);
        }
}

/* Adds to `volume`. Each thread has a volume of its own; 0 if there is no memory for them. */
int adjoint(float *volume, const int *n, double size, const double *cameras, int views, int rows, int columns,
            const float *images)
{
    long voxels = (long)n[0] * n[1] * n[2];
    int failed = 0;
#pragma omp parallel
    {
        float *own = calloc(voxels, sizeof(float));
        if (!own) {
#pragma omp atomic write
            failed = 1;
        }
#pragma omp barrier
        if (!failed) {
#pragma omp for schedule(dynamic, 8)
            for (long tile = 0; tile < tiles(views, rows, columns); tile++)
                for (int inside = 0; inside < TILE * TILE; inside++) {
                    Ray ray;
                    long pixel, p;
                    double part;
                    if (!ray_of(tile, inside, cameras, rows, columns, n, size, &ray, &pixel))
                        continue;
                    double value = images[pixel] * ray.length;
                    while ((p = advance(&ray, &part)) >= 0)
                        own[p] += (float)(part * value);
                }
#pragma omp critical
            for (long p = 0; p < voxels; p++)
                volume[p] += own[p];
        }
        free(own);
    }
    return !failed;
}

/* Line integrals of `volume`, weakened by `mu` (1/mm, on the same voxels) on the way to the source. */
void attenuated(const float *volume, const float *mu, const int *n, double size, const double *cameras, int views, int rows,
                int columns, float *images)
{
    memset(images, 0, sizeof(float) * views * rows * columns);
#pragma omp parallel for schedule(dynamic, 8)
    for (long tile = 0; tile < tiles(views, rows, columns); tile++)
        for (int inside = 0; inside < TILE * TILE; inside++) {
            Ray ray;
            long pixel, p;
            double part, sum = 0;
            float left = 1;
            if (!ray_of(tile, inside, cameras, rows, columns, n, size, &ray, &pixel))
                continue;
            while ((p = advance(&ray, &part)) >= 0) {
                float depth = (float)(part * ray.length) * mu[p], lost = -expm1f(-depth);
                sum += part * volume[p] * left * (depth > 1e-6f ? lost / depth : 1);
                left -= left * lost;
            }
            images[pixel] = (float)(sum * ray.length);
        }
}
