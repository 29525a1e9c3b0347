// Line integrals through voxels and their gradients: the contract between the kernels and cpu.py.
//
// All coordinates of rays are in index space, where voxel i of an axis fills [i, i + 1) and a lattice's faces lie at 0
// and n. A point of a ray is source + alpha (target - source), alpha from 0 to 1. With f the volume, mu the attenuation
// coefficient (0 if there is none) and L the ray's length in mm, its integral is
//
//     L int_0^1 f(alpha) exp(-L int_0^alpha mu) dalpha
//
// The kernels allocate nothing, keep nothing and start no thread: a job belongs to the thread that calls, which needs
// 400 kB of stack. Nothing here is checked; cpu.py makes only jobs whose arrays are as large as this file asks, of
// fewer than 2^31 voxels in a lattice.

#pragma once
#include <stdint.h>

#define NODE_ROWS 4
#define GIVEN_ROWS 16
#define CONTRACT 10 // counted up with every change of this file: cpu.py takes no other

// Voxels (n[0], n[1], n[2]) in C order, of a job's kind of number.
typedef struct {
    void *voxels;
    int64_t n[3];
} Lattice;

// Rays from a source to the points corner + i row_step + j column_step, 0 <= i < rows, 0 <= j < columns, row by row.
typedef struct {
    double volume[4][3]; // source, corner, row step, column step in the volume's index space
    double mu[4][3];     // the same in mu's, where that has a lattice of its own
    double world[3][3];  // source to corner in mm, and by how much a ray changes with its row and column
    int64_t rows, columns;
    double parallel; // the sources move along with the points, this many times as far: 0 if there is one source
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
// weighted sums of cells. A voxel counts where matrix[2] (x, y, z, 1) is above `nearest` and at most `farthest`. A place in it lies at
// column c, row r and depth h where matrix (x, y, z, 1) + shifts[i] + t line = (c h, r h, h), t being from -1/2 to 1/2 evenly, and counts
// value / h^2, but nothing outside the fine image. Its plane is a number from 0 to planes - 1, (1 / h - first_plane)
// planes_per_inverse. Where the line covers s columns or rows, it is taken as one point if s <= of_point, as two that share
// their cells if s <= of_pair, else as 2 + floor(s parts_per_cell); more than one have its variance.
//
// Between cells and pixels, a row's cells lie sorted by their place in a pixel: column c is number (c mod step[1]) (columns / step[1])
// + c / step[1]. Up to 16 numbers after the last cell are read and not used, or 0 is added to them.
typedef struct {
    int64_t is_double;
    Lattice volume;
    int64_t first, last; // those voxels, of the first axis, that this job is for
    double matrix[3][4], line[3];
    const double (*shifts)[3];     // of `pieces` equal pieces of a voxel from its middle
    int64_t pieces;
    double of_point, of_pair, parts_per_cell;
    double nearest, farthest;
    double first_plane, planes_per_inverse;
    const void *passes;            // share of each voxel's photons that attenuation leaves, of the volume's shape; or null
    void *cells;                   // (planes, rows, columns), columns a multiple of step[1]
    int64_t planes, rows, columns; // at least 2 planes
    const void *kernel;            // (planes, taps[0] + 2 step[0], taps[1]): what a pixel counts of the cells from its first on; step[0] rows
                                   // of 0 come before and after; where there are nodes, up to 15 numbers after the last are read and not used
    const void *bounds;            // (planes, taps[0] + 2 step[0], 2), of int64_t: each row's first tap that is not 0, and the one after the last; or 0, 0
    int64_t taps[2];
    int64_t step[2];               // cells from a pixel's first to its neighbour's, along rows and columns
    void *image;                   // (pixels[0], pixels[1]); pixels_to_cells also reads (taps[1] - 1) / step[1] zeros before each row, and
                                   // zeros after it until there are columns / step[1] numbers, rounded up to a multiple of 16
    int64_t row;                   // from a row of the image to the next
    int64_t pixels[2];
    // Where nodes[0] > 0, pixel (i, j) has a kernel of its own: mixed linearly from those of the four nodes around its place,
    // (node_rows[i], node_columns[j]), both ascending, from 0 to nodes - 1. `kernel` and `bounds` have two axes more after that of the planes, those
    // of the nodes; the bounds of a node are also those of the next node's taps along the first axis.
    int64_t nodes[2];              // at least 2 along either axis
    const double *node_rows, *node_columns;
    void *room;                    // (GIVEN_ROWS, NODE_ROWS, taps[1]) numbers and 16; and zeros, as many as NODE_ROWS rows of pixels, each with
                                   // 31 more, and 16
    const int64_t *columns_of;     // (taps[1]): the numbers of a pixel's cells in a sorted row, less that of its first
    double *gradient;              // what derivatives are added to: (planes, taps[0], taps[1]), or by `line` (3), and for each piece (4, 3): by
                                   // its `shifts`, and the same times x, y and z of the voxels
} DepthJob;

// Arrays that are interpolated linearly at the places of a lattice's points, or that are given the points' numbers, shared out with
// the same weights. The place of point (i, j, k) is that of (i, j, middle + planes[k], 1) under an array's matrix: of the five
// numbers p that it makes, (p0 / p3, p1 / p3, p2 / p4) are indices in the array. Places up to half an element outside belong to
// the outermost elements; others, and those with p3 <= nearest or p4 <= 0, are not in the array. There are points and elements, of
// elements at most 2^16 along an axis if they are float. In a product, what is less than the least normal number counts as 0.
enum { SUM, LEAST, PRODUCT };

typedef struct {
    int64_t is_double;
    int64_t how;     // in which way take_at combines a point's number with what it takes
    int64_t flat;    // 1: the arrays are one plane (m[2] = 1), whose third coordinate nothing depends on
    int64_t by_depth; // 1: what is taken or given is divided by p3^2
    void *points;    // (n[0], n[1], n[2])
    int64_t n[3];
    int64_t first, last; // take_at: of the points' first axis; give_at: of the array's, which alone are written
    const void *planes;  // (n[2]), ascending or descending
    double middle, nearest;
    void *values; // (arrays, m[0], m[1], m[2]), an array of fewer than 2^31 numbers
    int64_t arrays, m[3];
    const double *matrices; // (arrays, 5, 4)
    int32_t *seen;          // of the points' shape, or null: counted up where an array has the point
    int32_t *exponents; // of the points' shape, with PRODUCT: a point's product is its number times 2 to this power
} PlacesJob;

// What level of processor the kernels are compiled for; any processor of the platform runs level 0.
int64_t best_level(void);
const char *level_name(int64_t level); // null if there is no such level

// CONTRACT, and the bytes of a Job, a Fan, a DepthJob and a PlacesJob: cpu.py compares them with its own.
void contract(int64_t numbers[5]);

// values = integrals
void forward(int64_t level, const Job *job);

// volume += values, each along its ray with the weights of forward
void backproject(int64_t level, const Job *job);

// derivatives = integral / L, then its derivatives by the ray's start (3) and end (3) through the planes of the volume,
// where f jumps; with mu, for which the integrals are needed, also by start (3) and end (3) in mu's index space through
// the planes of mu, all at constant L, and by L at constant ends.
void differentiate(int64_t level, const Job *job);

// gradient += the derivative by mu of the sum of values times integrals; the integrals are needed
void differentiate_by_mu(int64_t level, const Job *job);

// cells += what the voxels give to them, and the adjoint: voxels += cells, with the same weights
void voxels_to_cells(int64_t level, const DepthJob *job);
void cells_to_voxels(int64_t level, const DepthJob *job);

// image = weighted sums of cells, and the adjoint: cells += image, with the same weights
void cells_to_pixels(int64_t level, const DepthJob *job);
void pixels_to_cells(int64_t level, const DepthJob *job);

// Derivatives: of the sum of the voxels times what they take from cells, by their places; and of the sum of the image times
// weighted sums of cells, by the taps. Cells read beyond their last must be numbers, and zeros come after the image's rows.
void differentiate_places(int64_t level, const DepthJob *job);
void differentiate_taps(int64_t level, const DepthJob *job);

// points = points combined with what all arrays have at their places, array by array
void take_at(int64_t level, const PlacesJob *job);

// the one array += the points' numbers, shared out: the adjoint of take_at's sum
void give_at(int64_t level, const PlacesJob *job);
