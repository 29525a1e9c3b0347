// Line integrals through voxels and their gradients, the pinhole response, and interpolation: the contract between the
// kernels and their bindings in Python.
//
// All coordinates of rays are in index space, where voxel i of an axis fills [i, i + 1) and a lattice's faces lie at 0
// and n. A point of a ray is source + alpha (target - source), alpha from 0 to 1. With f the volume, mu the attenuation
// coefficient (0 if there is none) and L the ray's length in mm, its integral is
//
//     L int_0^1 f(alpha) exp(-L int_0^alpha mu) dalpha
//
// The kernels allocate no memory, store no state and start no thread: a job belongs to the calling thread, which needs
// 400 kB of stack. They check no argument; the binding makes jobs whose arrays have at least the sizes given here, with
// fewer than 2^31 voxels in a lattice.
//
// The bindings are cpu.py, here, and compiled.py in core/pinhole_response.

#pragma once
#include <stdint.h>

#define NODE_ROWS 4
#define GIVEN_ROWS 16
#define CONTRACT 13 // increased with every change of the code of this file: cpu.py refuses any other

// Voxels (n[0], n[1], n[2]) in C order, float or double as the job says.
typedef struct {
    void *voxels;
    int64_t n[3];
} Lattice;

// Rays from a source to the points corner + i row_step + j column_step, 0 <= i < rows, 0 <= j < columns, row by row.
typedef struct {
    double volume[4][3]; // source, corner, row step, column step in the volume's index space
    double mu[4][3];     // the same in the index space of mu, if that has a lattice of its own
    double world[3][3];  // vector from source to corner, mm, and its change from row to row and from column to column
    int64_t rows, columns;
    double parallel; // motion of the sources in units of that of the points: 0 for one source
} Fan;

// Rays one by one, as columns of arrays (3, count) and (count).
typedef struct {
    const double *starts, *directions;       // in the volume's index space; a direction is from source to target
    const double *mu_starts, *mu_directions; // in the index space of mu, if that has a lattice of its own
    const double *lengths;                   // mm
    int64_t count;
} RayList;

// Attenuation: there is no mu, mu shares the volume's lattice, or mu has a lattice of its own.
enum { NO_MU, SAME_LATTICE, OWN_LATTICE };

typedef struct {
    int64_t is_double; // voxels and values are float (0) or double (1)
    int64_t attenuation; // NO_MU, SAME_LATTICE or OWN_LATTICE
    Lattice volume, mu;
    const Fan *fans; // the rays of all fans, in order
    int64_t n_fans;
    RayList list; // the rays where there are no fans
    void *values; // one for every ray, in order
    const void *integrals; // results of forward, for a task that needs them
    double *derivatives;   // (7 or 14, rays): row after row, rays in order
    void *gradient;        // of mu's shape
} Job;

// The depth-dependent pinhole response (docs/pinhole-response.md): voxels are shared out among the cells of a fine image, in planes
// of depth; pixels are weighted sums of cells. A voxel takes part if its depth, matrix[2] (x, y, z, 1), is above `nearest` and at most
// `farthest`. A point of its piece i lies at column c, row r and depth h with matrix (x, y, z, 1) + shifts[i] + t line = (c h, r h, h), t
// being uniform from -1/2 to 1/2, and has the weight 1 / h^2, or 0 outside the fine image. Its plane is (1 / h - first_plane)
// planes_per_inverse, a number from 0 to planes - 1. With s the columns or rows that the line covers, it is sampled by one point if
// s <= of_point, by two points on the same cells if s <= of_pair, else by 2 + floor(s parts_per_cell) points; two or more have its
// variance.
//
// Between cells and pixels, the cells of a row are sorted by their place in a pixel: column c is number (c mod step[1]) (columns /
// step[1]) + c / step[1]. Up to 16 numbers after the last cell are read and not used, or 0 is added to them.
typedef struct {
    int64_t is_double;
    Lattice volume;
    int64_t first, last; // voxels of the first axis that belong to this job
    double matrix[3][4], line[3];
    const double (*shifts)[3];     // from a voxel's centre to those of its `pieces` equal pieces
    int64_t pieces;
    double of_point, of_pair, parts_per_cell;
    double nearest, farthest;
    double first_plane, planes_per_inverse;
    const void *passes;            // transmittance from each voxel, of the volume's shape; or null
    void *cells;                   // (planes, rows, columns), columns a multiple of step[1]
    int64_t planes, rows, columns; // at least 2 planes
    const void *kernel;            // (planes, taps[0] + 2 step[0], taps[1]): weights in a pixel of the cells from its first one on; step[0] rows
                                   // of 0 come before and after; with nodes, up to 15 numbers after the last are read and not used
    const void *bounds;            // (planes, taps[0] + 2 step[0], 2), of int64_t: each row's first tap that is not 0, and the end of such taps; or 0, 0
    int64_t taps[2];
    int64_t step[2];               // cells from the first cell of a pixel to that of its neighbour, along rows and columns
    void *image;                   // (pixels[0], pixels[1]); pixels_to_cells also reads (taps[1] - 1) / step[1] zeros before each row, and
                                   // zeros after it until there are columns / step[1] numbers, rounded up to a multiple of 16
    int64_t row;                   // numbers from a row of the image to the next
    int64_t pixels[2];
    // If nodes[0] > 0, pixel (i, j) has a kernel of its own, mixed linearly from those of the four nodes around its position
    // (node_rows[i], node_columns[j]), both ascending, from 0 to nodes - 1. `kernel` and `bounds` have two axes more after that of the planes, those
    // of the nodes; the bounds of a node include the taps of the next node along the first axis.
    int64_t nodes[2];              // at least 2 along either axis
    const double *node_rows, *node_columns;
    void *room;                    // scratch memory: (GIVEN_ROWS, NODE_ROWS, taps[1]) numbers and 16; and zeros, as many as NODE_ROWS rows of
                                   // pixels, each with 31 more, and 16
    const int64_t *columns_of;     // (taps[1]): the numbers of a pixel's cells in a sorted row, less that of its first
    double *gradient;              // array that derivatives are added to: (planes, taps[0], taps[1]) by the taps; or (3) by `line`, and for each piece
                                   // (4, 3): by its shift, and by its shift times x, y and z of the voxels
} DepthJob;

// Linear interpolation of arrays at the places of a lattice's points, and its adjoint, which shares the points' numbers out with
// the same weights. The place of point (i, j, k) follows from p = matrix (i, j, middle + planes[k], 1), five numbers, with an array's
// matrix: (p0 / p3, p1 / p3, p2 / p4) are indices in the array. Places up to half an element outside belong to the outermost
// elements; others, and those with p3 <= nearest or p4 <= 0, are not in the array. There is at least one point and one element, and at
// most 2^16 float elements along an axis. In a product, numbers below the least normal number are 0.
enum { SUM, LEAST, PRODUCT };

typedef struct {
    int64_t is_double;
    int64_t how;     // SUM, LEAST or PRODUCT: combination of a point's number with the interpolated value in take_at
    int64_t flat;    // 1: the arrays have one plane (m[2] = 1), and their third coordinate does not matter
    int64_t by_depth; // 1: interpolated or shared numbers are divided by p3^2
    void *points;    // (n[0], n[1], n[2])
    int64_t n[3];
    int64_t first, last; // range of the points' first axis in take_at, and of the array's, the only one written, in give_at
    const void *planes;  // (n[2]), ascending or descending
    double middle, nearest;
    void *values; // (arrays, m[0], m[1], m[2]), an array of fewer than 2^31 numbers
    int64_t arrays, m[3];
    const double *matrices; // (arrays, 5, 4)
    int32_t *seen;          // of the points' shape, or null: increased by 1 where an array has the point
    int32_t *exponents; // of the points' shape, with PRODUCT: a point's product is its number times 2 to this power
} PlacesJob;

// Photons that scatter in a body. World points and lengths are in mm, energies in keV. A voxel of the body holds the densities of its
// materials, each as a share of the material's own. Tables by energy have `energies` numbers, from `lowest` on; those by the momentum
// transfer x, 1/angstrom, have `momenta` numbers at even steps of sqrt(x).
#define MATERIALS 2
#define MOST_COLLISIONS 64 // of a history

typedef struct {
    double place[3], direction[3], energy; // of the photon when it begins
    double collides_at;                    // quantile of its first collision along the way through the body, above 0 and below 1
    double weight;                         // photons that it stands for
} Start;

typedef struct {
    double place[3], direction[3], energy; // before the collision
    float weight;                          // photons, of 1 that began
    int32_t voxel, order;                  // voxel of the body; 1 for the first collision
} Collision;

typedef struct {
    double hole[3], u[3], v[3], axis[3]; // the axis points to what is seen
    double slopes[4];                    // least and largest u / height and v / height of what is seen
    double margin, margin_by_height;     // mm beside them that are seen, too
    double nearest;                      // height above the hole's plane from which on places are seen, mm
    double area;                         // d_e^2 / 16, mm^2
    double least;                        // photons through the hole, of one history: contributions below play roulette for so many
} Module;

typedef struct {
    double corner[3], u[3], v[3]; // outer corner, and the ways along all of a row and all of a column
    double area[3];               // normal that points away from what is seen, times the panel's area, mm^2
    int64_t columns, rows;        // of bins, the job's cells, row by row
    int64_t places;               // number of places of the panel that each collision sees
} Panel;

typedef struct {
    int64_t is_double; // 0: there are no kernels of double
    const float *body; // (n[0], n[1], n[2], MATERIALS)
    int64_t n[3];
    double index_from_world[3][4]; // voxel i of an axis fills [i, i + 1)
    int64_t energies;
    double lowest, energies_per_kev; // photons of less energy are not followed
    const float *coefficients;       // (3, MATERIALS, energies): total, incoherent and coherent attenuation, 1/mm
    int64_t momenta;
    double momenta_per_root;
    const float *incoherent, *coherent; // (MATERIALS, momenta): r_e^2 / 2 times electrons per mm^3 times S(x), or F(x)^2, 1/mm
    const float *coherent_until;        // (MATERIALS, momenta): integral of F(x)^2 over x^2 from 0
    uint64_t seed;
    int64_t all_first, first, last; // numbers of the histories: the one of the first start, and those that are followed
    const Start *starts;            // (last - all_first)
    Collision *collisions;
    int64_t capacity;                  // at least MOST_COLLISIONS
    int64_t *followed, *n_collisions;  // results of follow: the first history that had no room, and the number of collisions
    const Module *holes;               // (modules)
    int64_t modules, first_module, last_module;
    const float *accepted;             // (modules, windows, energies): shares of the photons that are counted
    const float *worth;                // (modules, energies): importance of photons, above 0 where any window counts them
    int64_t windows, orders;
    const int32_t *cell_of;            // cells of the body's voxels
    int64_t cells;
    float *seen;                       // (orders, windows, cells, modules): photons of an even emission that would be seen alike
    double *totals;                    // (windows, modules): photons that pass the hole and are counted; or null
    double *spectra;                   // (modules, energies): photons that pass the hole; or null
    const Panel *panel;                // of see_panel, the only module
} PhotonJob;

// Highest level of kernels that this processor supports; any processor of the platform runs level 0.
int64_t best_level(void);
const char *level_name(int64_t level); // null if there is no such level

// CONTRACT, and the sizes in bytes of a Job, a Fan, a DepthJob, a PlacesJob and a PhotonJob: cpu.py compares them with its own.
void contract(int64_t numbers[6]);

// values = integrals
void forward(int64_t level, const Job *job);

// volume += values, each along its ray with the weights of forward
void backproject(int64_t level, const Job *job);

// derivatives = integral / L, then its derivatives by the ray's start (3) and end (3) through the planes of the volume,
// where f jumps; with mu, which needs the integrals, also by start (3) and end (3) in mu's index space through the planes of
// mu, all at constant L, and by L at constant ends.
void differentiate(int64_t level, const Job *job);

// gradient += the derivative by mu of the sum of values times integrals, which are needed
void differentiate_by_mu(int64_t level, const Job *job);

// cells += voxels, shared out; and the adjoint: voxels += cells, with the same weights
void voxels_to_cells(int64_t level, const DepthJob *job);
void cells_to_voxels(int64_t level, const DepthJob *job);

// image += weighted sums of cells; and the adjoint: cells = image, shared out with the same weights (with nodes cells +=)
void cells_to_pixels(int64_t level, const DepthJob *job);
void pixels_to_cells(int64_t level, const DepthJob *job);

// Derivatives: of the sum of the voxels times the adjoint of the cells, by the voxels' places; and of the sum of the image times
// weighted sums of cells, by the taps. Cells read beyond the last must be numbers, and zeros come after the image's rows.
void differentiate_places(int64_t level, const DepthJob *job);
void differentiate_taps(int64_t level, const DepthJob *job);

// points = points combined with the values of all arrays at their places, array by array
void take_at(int64_t level, const PlacesJob *job);

// the single array += the points' numbers, shared out: the adjoint of the sum in take_at
void give_at(int64_t level, const PlacesJob *job);

// collisions = those of the histories; and seen += what the modules see of the collisions, or photons in the bins of the panel
void follow(int64_t level, const PhotonJob *job);
void see(int64_t level, const PhotonJob *job);
void see_panel(int64_t level, const PhotonJob *job);
