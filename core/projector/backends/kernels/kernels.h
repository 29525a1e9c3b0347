// Line integrals through voxels and their gradients: the contract between the kernels and cpu.py.
//
// All coordinates of rays are in index space, where voxel i of an axis fills [i, i + 1) and a lattice's faces lie at 0
// and n. A point of a ray is source + alpha (target - source), alpha from 0 to 1. With f the volume, mu the attenuation
// coefficient (0 if there is none) and L the ray's length in mm, its integral is
//
//     L int_0^1 f(alpha) exp(-L int_0^alpha mu) dalpha
//
// The kernels allocate nothing, keep nothing and start no thread: a job belongs to the thread that calls, which needs
// 400 kB of stack. Nothing here is checked; cpu.py makes only jobs whose arrays are as large as said here, of
// fewer than 2^31 voxels in a lattice.

#pragma once
#include <stdint.h>

#define CONTRACT 4 // counted up with every change of this file: cpu.py takes no other

// Voxels (n[0], n[1], n[2]) in C order, of a job's kind of number.
typedef struct {
    void *voxels;
    int64_t n[3];
} Lattice;

// Rays from a source to the points corner + i row_step + j column_step, 0 <= i < rows, 0 <= j < columns, row by row.
typedef struct {
    double volume[4][3]; // source, corner, row step, column step in the volume's index space
    double mu[4][3];     // the same in mu's, where that has a lattice of its own
    double world[3][3];  // source to corner, row step, column step in mm; the steps are 0 where rays are parallel
    int64_t rows, columns;
    double parallel; // 1: the sources move along with the points, as far as these; 0: there is one source
} Fan;

// Rays one by one, columns of arrays (3, count) and (count).
typedef struct {
    const double *starts, *directions;       // in the volume's index space; a direction is source to target
    const double *mu_starts, *mu_directions; // in mu's, where that has a lattice of its own
    const double *lengths;                   // mm
    int64_t count;
} RayList;

// There is no mu, it shares the volume's lattice, or it has a lattice of its own.
enum { NO_MU, SAME_LATTICE, OWN_LATTICE };

typedef struct {
    int64_t is_double; // numbers of voxels and values are float (0) or double (1)
    int64_t attenuation; // NO_MU, SAME_LATTICE or OWN_LATTICE
    Lattice volume, mu;
    const Fan *fans; // the rays of all fans, in order
    int64_t n_fans;
    RayList list; // or, where there are no fans, these
    void *values; // one for every ray, in order
    const void *integrals; // with a task that needs them: as forward gave them
    double *derivatives;   // (7 or 14, rays): row after row, rays in order
    void *gradient;        // of mu's shape
} Job;

// Emission whose hole blurs by depth: voxels are shared out among the cells of a fine image, in planes of depth; pixels are
// weighted sums of cells. A voxel (x, y, z) lies at column c, row r and depth h where matrix (x, y, z, 1) = (c h, r h, h); it
// counts value / h^2, and nothing outside the fine image or nearer than `nearest`. Its plane is a number from 0 to PLANES - 1,
// (1 / h - first_plane) planes_per_inverse.
#define PLANES 4
#define RUN 16 // taps[1] PLANES is a multiple of it

typedef struct {
    int64_t is_double;
    Lattice volume;
    int64_t first, last; // those voxels, of the first axis, that this job is for
    double matrix[3][4];
    double nearest, first_plane, planes_per_inverse;
    const void *passes;       // share of each voxel's photons that attenuation leaves, of the volume's shape; or null
    void *cells;              // (rows, columns, PLANES)
    int64_t rows, columns;
    const void *kernel;       // (taps[0], taps[1], PLANES): what a pixel counts of the cells from its first on
    int64_t taps[2];
    int64_t step[2];          // cells from a pixel's first to its neighbour's, along rows and columns
    void *image;              // (pixels[0], pixels[1])
    int64_t pixels[2];
} DepthJob;

// Images that are interpolated at the places of voxels. All numbers are float; an image is at most 2^31 numbers large and
// has a margin of zeros: a row above, two below, a column on the left, two on the right.
typedef struct {
    const float *images;    // (views, rows, columns), margins included
    const double *matrices; // (views, 3, 4): from a voxel's indices, 1 to (column, row, 1) depth; 0 is the image's first
    int64_t views, rows, columns;
    float *volume; // (n[0], n[1], n[2])
    int64_t n[3];
} Smear;

// What level of processor the kernels are compiled for; any processor of the platform runs level 0.
int64_t best_level(void);
const char *level_name(int64_t level); // null if there is no such level

// CONTRACT, and the bytes of a Job, a Fan, a DepthJob and a Smear: cpu.py compares them with its own.
void contract(int64_t numbers[5]);

// values = integrals
void forward(int64_t level, const Job *job);

// volume += values, each along its ray with the weights of forward
void backproject(int64_t level, const Job *job);

// derivatives = integral / L, then its derivatives by the ray's start (3) and end (3) through the planes of the volume,
// where f jumps; with mu, for which the integrals are needed, also by start (3) and end (3) in mu's index space through
// the planes of mu, all at constant L, and by L at constant ends.
void differentiate(int64_t level, const Job *job);

// volume += the sum over all images of what is at the voxel's place there, interpolated linearly, divided by its depth^2
void smear(int64_t level, const Smear *job);

// gradient += the derivative by mu of the sum of values times integrals; the integrals are needed
void differentiate_by_mu(int64_t level, const Job *job);

// cells += what the voxels give to them, and the adjoint: voxels += cells, with the same weights
void voxels_to_cells(int64_t level, const DepthJob *job);
void cells_to_voxels(int64_t level, const DepthJob *job);

// image = weighted sums of cells, and the adjoint: cells += image, with the same weights
void cells_to_pixels(int64_t level, const DepthJob *job);
void pixels_to_cells(int64_t level, const DepthJob *job);
