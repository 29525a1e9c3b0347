// Photons that scatter in a body: their flights and collisions, and what modules and panels see of each collision (docs/scatter.md).

#include "kernels.h"

#define INLINE static inline __attribute__((always_inline))
#define MIN(x, y) ((x) < (y) ? (x) : (y))
#define MAX(x, y) ((x) > (y) ? (x) : (y))
#define ABS(x) __builtin_fabsf(x)
#define KERNEL_(name, level) name##_##level##_float
#define KERNEL__(name, level) KERNEL_(name, level)
#define KERNEL(name) KERNEL__(name, LEVEL)

#define PI 3.14159265358979323846
#define ELECTRON 510.99895      // keV, the energy of an electron at rest
#define MOMENTUM (1 / 12.398420) // 1/angstrom per keV: x = E MOMENTUM sin(theta / 2)
#define FAINT 1e-3f             // weights below it, of 1 at the start, play roulette
#define FAR 1e30f

// --- numbers -------------------------------------------------------------------------------------------------------------------

// A history's random numbers: splitmix64 (G. L. Steele, D. Lea, C. H. Flood, OOPSLA 2014), begun at a hash of seed and number.
typedef uint64_t Random;

INLINE uint64_t mixed(uint64_t z) {
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return z ^ z >> 31;
}

INLINE double uniform(Random *random) { // above 0 and below 1
    *random += 0x9e3779b97f4a7c15u;
    return ((double)(mixed(*random) >> 12) + 0.5) * 0x1p-52;
}

INLINE float exponential(float x) { // exp(x) for x <= 0, relative error below 3e-7
    x = MAX(x, -80.0f) * 1.44269504f;
    const float whole = (float)(int)(x - 0.5f), f = (x - whole) * 0.693147181f; // f from -0.35 to 0.35
    const float series = 1 + f * (1 + f * (0.5f + f * (0.166666667f + f * (0.0416666667f + f * (0.00833333f + f * 0.00138889f)))));
    union { int32_t bits; float value; } power = {((int)whole + 127) << 23};
    return series * power.value;
}

INLINE double depth_of(double u) { // -log(u), 0 < u < 1, relative error below 1e-7
    union { double value; uint64_t bits; } parts = {u};
    const int exponent = (int)(parts.bits >> 52) - 1022;
    parts.bits = (parts.bits & 0xfffffffffffffu) | 0x3fe0000000000000u; // 0.5 to 1
    double m = parts.value;
    int shift = 0;
    if (m < 0.70710678) m *= 2, shift = 1;
    const double s = (m - 1) / (m + 1), q = s * s; // |s| < 0.172
    const double log_m = 2 * s * (1 + q * (1.0 / 3 + q * (1.0 / 5 + q * (1.0 / 7 + q * (1.0 / 9)))));
    return -(log_m + (exponent - shift) * 0.69314718055994531);
}

typedef struct {
    int64_t first;
    float share;
} Between;

INLINE Between between(double x, int64_t n) { // neighbours of x in a table of n >= 2 numbers
    const double inside = MIN(MAX(x, 0.0), n - 1.0);
    const int64_t first = MIN((int64_t)inside, n - 2);
    return (Between){first, (float)(inside - (double)first)};
}

INLINE float in(const float *table, Between at) { return table[at.first] + at.share * (table[at.first + 1] - table[at.first]); }

INLINE double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// --- tables --------------------------------------------------------------------------------------------------------------------

enum { TOTAL, INCOHERENT, COHERENT, KINDS };

INLINE float coefficient(const PhotonJob *job, int kind, int material, Between energy) {
    return in(job->coefficients + (kind * MATERIALS + material) * job->energies, energy);
}

INLINE Between energy_place(const PhotonJob *job, double energy) {
    return between((energy - job->lowest) * job->energies_per_kev, job->energies);
}

INLINE Between momentum_place(const PhotonJob *job, double x) {
    return between(__builtin_sqrt(x) * job->momenta_per_root, job->momenta);
}

// --- flights -------------------------------------------------------------------------------------------------------------------

// Walk from a place along a direction (mm, unit vector) through the body, at most `limit` mm, adding the path through each material,
// mm of its full density, until the optical depth is `depth`. Return the mm walked; `depth_left` is what is missing, 0 if nothing.
INLINE double walk(const PhotonJob *job, const double *place, const double *direction, double limit, const float *mu, float depth,
                   float *paths, float *depth_left, int64_t *voxel) {
    float at[3], slope[3], next[3], delta[3];
    double enter = 0, leave = limit;
    for (int a = 0; a < MATERIALS; a++) paths[a] = 0;
    *depth_left = depth;
    double start[3], speed[3];
    for (int a = 0; a < 3; a++) {
        const double *row = job->index_from_world[a];
        start[a] = dot(row, place) + row[3], speed[a] = dot(row, direction);
        if (speed[a] == 0) {
            if (!(start[a] >= 0 && start[a] < (double)job->n[a])) return limit;
            continue;
        }
        const double first = (0 - start[a]) / speed[a], last = ((double)job->n[a] - start[a]) / speed[a];
        enter = MAX(enter, MIN(first, last)), leave = MIN(leave, MAX(first, last));
    }
    if (!(enter < leave)) return limit;
    int64_t index[3];
    for (int a = 0; a < 3; a++) {
        const double entry = start[a] + enter * speed[a];
        index[a] = (int64_t)MIN(MAX(entry, 0.0), (double)job->n[a] - 0.5);
        at[a] = (float)(entry - (double)index[a]), slope[a] = (float)speed[a];
        delta[a] = slope[a] != 0 ? 1 / ABS(slope[a]) : FAR;
        next[a] = slope[a] != 0 ? MAX((slope[a] > 0 ? 1 - at[a] : at[a]) * delta[a], 0.0f) : FAR;
    }
    const int64_t strides[3] = {job->n[1] * job->n[2], job->n[2], 1};
    int64_t here = 0, steps[3], room[3]; // of each axis, the step to the next voxel, and how many of them are ahead
    for (int a = 0; a < 3; a++) {
        here += index[a] * strides[a], steps[a] = slope[a] > 0 ? strides[a] : -strides[a];
        room[a] = slope[a] > 0 ? job->n[a] - 1 - index[a] : index[a];
    }
    const float end = (float)(leave - enter);
    float t = 0, left = depth, water = 0, bone = 0;
    for (;;) {
        const int x = (next[0] < next[1]) & (next[0] < next[2]), y = !x & (next[1] < next[2]), z = !(x | y);
        const float stop = MIN(MIN(MIN(next[0], next[1]), next[2]), end), length = MAX(stop - t, 0.0f);
        const float *densities = job->body + MATERIALS * here;
        const float lost = (densities[0] * mu[0] + densities[1] * mu[1]) * length;
        if (lost >= left) {
            const float part = length * left / lost;
            paths[0] = water + densities[0] * part, paths[1] = bone + densities[1] * part;
            *depth_left = 0, *voxel = here;
            return enter + t + part;
        }
        left -= lost, water += densities[0] * length, bone += densities[1] * length;
        t = stop;
        room[0] -= x, room[1] -= y, room[2] -= z;
        if (!(t < end) | ((room[0] | room[1] | room[2]) < 0)) break;
        next[0] += x ? delta[0] : 0, next[1] += y ? delta[1] : 0, next[2] += z ? delta[2] : 0;
        here += x ? steps[0] : y ? steps[1] : steps[2];
    }
    *depth_left = left, paths[0] = water, paths[1] = bone;
    return limit;
}

// --- collisions ----------------------------------------------------------------------------------------------------------------

INLINE double compton_energy(double energy, double cosine) { return energy / (1 + energy / ELECTRON * (1 - cosine)); }

INLINE double momentum(double energy, double cosine) { return energy * MOMENTUM * __builtin_sqrt(MAX(0.5 * (1 - cosine), 0.0)); }

// Cosine drawn from Klein and Nishina's law, as J. C. Butcher and H. Messel, Nuclear Physics 20 (1960) 15, draw it, and from the
// material's incoherent scattering function.
static double draw_compton(const PhotonJob *job, double energy, int material, Random *random) {
    const float *table = job->incoherent + material * job->momenta;
    const double k = energy / ELECTRON, least = 1 / (1 + 2 * k);
    const double narrow = depth_of(least), wide = (1 - least * least) / 2;
    for (;;) {
        const double which = uniform(random) * (narrow + wide), u = uniform(random);
        const double ratio = which < narrow ? exponential((float)(-narrow * u)) : __builtin_sqrt(least * least + 2 * wide * u);
        const double cosine = 1 - (1 / ratio - 1) / k, sine2 = 1 - cosine * cosine;
        const double accepted = 1 - ratio * sine2 / (1 + ratio * ratio);
        const float bound = in(table, momentum_place(job, momentum(energy, cosine))) / table[job->momenta - 1];
        if (uniform(random) < accepted * bound) return MIN(MAX(cosine, -1.0), 1.0);
    }
}

// Cosine drawn from the material's squared form factor, by its integral over x^2, and accepted by (1 + cos^2) / 2.
static double draw_rayleigh(const PhotonJob *job, double energy, int material, Random *random) {
    const float *table = job->coherent_until + material * job->momenta;
    const double largest = energy * MOMENTUM;
    const Between end = momentum_place(job, largest);
    const double roots = 1 / job->momenta_per_root;
    for (;;) {
        const float sought = (float)uniform(random) * in(table, end);
        int64_t low = 0, high = end.first + 1;
        while (high - low > 1) {
            const int64_t middle = (low + high) / 2;
            if (table[middle] <= sought) low = middle;
            else high = middle;
        }
        const double first = low * roots * low * roots, last = high * roots * high * roots; // x at the ends
        const double share = (sought - table[low]) / MAX(table[high] - table[low], 1e-30f);
        const double square = first * first + share * (last * last - first * first);
        const double cosine = MAX(1 - 2 * square / (largest * largest), -1.0);
        if (2 * uniform(random) < 1 + cosine * cosine) return cosine;
    }
}

// Turn a unit vector by the angle of this cosine, to a side drawn at random.
static void turn(double *direction, double cosine, Random *random) {
    double a, b, square;
    do {
        a = 2 * uniform(random) - 1, b = 2 * uniform(random) - 1, square = a * a + b * b;
    } while (square > 1 || square < 1e-12);
    const double sine = __builtin_sqrt(MAX(1 - cosine * cosine, 0.0) / square);
    const double x = direction[0], y = direction[1], z = direction[2], sign = z < 0 ? -1 : 1;
    const double p = -1 / (sign + z), q = x * y * p; // T. Duff et al., Journal of Computer Graphics Techniques 6 (2017) 1
    const double across[2][3] = {{1 + sign * x * x * p, sign * q, -sign * x}, {q, sign + y * y * p, -y}};
    for (int i = 0; i < 3; i++) direction[i] = cosine * direction[i] + sine * (a * across[0][i] + b * across[1][i]);
    const double norm = 1 / __builtin_sqrt(dot(direction, direction));
    for (int i = 0; i < 3; i++) direction[i] *= norm;
}

// --- histories -----------------------------------------------------------------------------------------------------------------

void KERNEL(follow)(const PhotonJob *job) {
    int64_t n = 0, history = job->first;
    for (; history < job->last && job->capacity - n >= MOST_COLLISIONS; history++) {
        Random random = mixed(job->seed ^ mixed((uint64_t)history + 1));
        const Start *start = job->starts + (history - job->all_first);
        double place[3], direction[3], energy = start->energy;
        for (int i = 0; i < 3; i++) place[i] = start->place[i], direction[i] = start->direction[i];
        float weight = (float)start->weight;
        for (int order = 1; order <= MOST_COLLISIONS; order++) {
            const Between at = energy_place(job, energy);
            float mu[MATERIALS], paths[MATERIALS], left;
            int64_t hit = 0;
            for (int a = 0; a < MATERIALS; a++) mu[a] = coefficient(job, TOTAL, a, at);
            walk(job, place, direction, FAR, mu, FAR, paths, &left, &hit);
            const double depth = paths[0] * mu[0] + paths[1] * mu[1], collides = 1 - exponential((float)-depth);
            if (!(depth > 1e-7)) break;
            const double share = order == 1 ? start->collides_at : uniform(&random);
            const float until = (float)(depth_of(1 - collides * share) * (1 - 1e-6));
            const double distance = walk(job, place, direction, FAR, mu, until, paths, &left, &hit);
            if (left > 0) break; // by rounding alone
            for (int i = 0; i < 3; i++) place[i] += distance * direction[i];
            weight *= (float)collides;
            Collision *c = &job->collisions[n++];
            for (int i = 0; i < 3; i++) c->place[i] = place[i], c->direction[i] = direction[i];
            c->energy = energy, c->weight = weight, c->voxel = (int32_t)hit, c->order = order;
            float shares[2 * MATERIALS], scattered = 0, total = 0;
            for (int a = 0; a < MATERIALS; a++) {
                const float density = job->body[MATERIALS * hit + a];
                shares[a] = density * coefficient(job, INCOHERENT, a, at);
                shares[MATERIALS + a] = density * coefficient(job, COHERENT, a, at);
                scattered += shares[a] + shares[MATERIALS + a], total += density * mu[a];
            }
            weight *= scattered / total;
            float sought = (float)uniform(&random) * scattered;
            int kind = 0;
            while (kind < 2 * MATERIALS - 1 && (shares[kind] == 0 || sought >= shares[kind])) sought -= shares[kind++];
            if (kind < MATERIALS) {
                const double cosine = draw_compton(job, energy, kind, &random);
                energy = compton_energy(energy, cosine);
                turn(direction, cosine, &random);
            } else {
                turn(direction, draw_rayleigh(job, energy, kind - MATERIALS, &random), &random);
            }
            if (energy < job->lowest) break;
            if (weight < FAINT) {
                if (uniform(&random) < 0.5) break;
                weight *= 2;
            }
        }
    }
    *job->followed = history, *job->n_collisions = n;
}

// --- what modules and panels see -----------------------------------------------------------------------------------------------

// What a collision scatters towards a direction: numbers by which its weight in an even emission, of 1 photon, is multiplied.
typedef struct {
    double cosine, after; // keV after Compton scattering
    Between loses;
    float compton, rayleigh, mu_after[MATERIALS];
} Sight;

typedef struct {
    Between energy;
    float mu[MATERIALS], total;
} Before;

INLINE Before before_collision(const PhotonJob *job, const Collision *c) {
    Before before = {.energy = energy_place(job, c->energy)};
    for (int a = 0; a < MATERIALS; a++) {
        before.mu[a] = coefficient(job, TOTAL, a, before.energy);
        before.total += job->body[MATERIALS * c->voxel + a] * before.mu[a];
    }
    return before;
}

INLINE Sight towards(const PhotonJob *job, const Collision *c, const double *to) {
    Sight sight = {.cosine = MIN(MAX(dot(to, c->direction), -1.0), 1.0)};
    const double cosine = sight.cosine, after = sight.after = compton_energy(c->energy, cosine);
    const Between x = momentum_place(job, momentum(c->energy, cosine)), loses = sight.loses = energy_place(job, after);
    const float *densities = job->body + MATERIALS * c->voxel;
    float incoherent = 0, coherent = 0;
    for (int a = 0; a < MATERIALS; a++) {
        sight.mu_after[a] = coefficient(job, TOTAL, a, loses);
        incoherent += densities[a] * in(job->incoherent + a * job->momenta, x);
        coherent += densities[a] * in(job->coherent + a * job->momenta, x);
    }
    const double ratio = after / c->energy, square = cosine * cosine;
    sight.compton = incoherent * (float)(ratio * ratio * (ratio + 1 / ratio - 1 + square));
    sight.rayleigh = coherent * (float)(1 + square);
    return sight;
}

// Where a module's number in a window is among those of a collision's cell.
INLINE float *place_of(const PhotonJob *job, const Collision *c, int64_t window, int64_t cell, int64_t m) {
    const int64_t order = MIN(c->order, job->orders) - 1;
    return job->seen + ((order * job->windows + window) * job->cells + cell) * job->modules + m;
}

INLINE void record(const PhotonJob *job, const Collision *c, int64_t m, int64_t cell, double energy, float weight, double passes) {
    const Between at = energy_place(job, energy);
    const float *accepted = job->accepted + m * job->windows * job->energies;
    for (int64_t w = 0; w < job->windows; w++) {
        const float counted = weight * in(accepted + w * job->energies, at);
        *place_of(job, c, w, cell, m) += counted;
        if (job->totals) job->totals[w * job->modules + m] += counted * passes;
    }
    if (job->spectra) job->spectra[m * job->energies + at.first + (at.share > 0.5f)] += weight * passes;
}

// Record the photons of a weight that a collision scatters along a way whose paths through the materials are given, mm.
INLINE void record_sight(const PhotonJob *job, const Collision *c, const Before *before, const Sight *sight, const float *paths,
                         int64_t m, int64_t cell, float weight, double passes) {
    const float after = exponential(-(paths[0] * sight->mu_after[0] + paths[1] * sight->mu_after[1]));
    const float kept = exponential(-(paths[0] * before->mu[0] + paths[1] * before->mu[1]));
    record(job, c, m, cell, sight->after, weight * sight->compton * after, passes);
    record(job, c, m, cell, c->energy, weight * sight->rayleigh * kept, passes);
}

// Modules that look at a collision together, one in each lane.
enum { LANES = 8, GROUPS = 8 };
typedef float F __attribute__((ext_vector_type(LANES)));
typedef double D __attribute__((ext_vector_type(LANES)));
typedef int32_t I __attribute__((ext_vector_type(LANES)));
#define EACH_LANE(i) _Pragma("clang loop unroll(full)") for (int i = 0; i < LANES; i++)
#define AS(type, x) __builtin_convertvector(x, type)
#define ROOT(x) __builtin_elementwise_sqrt(x)

typedef struct {
    D hole[3];
    F u[3], v[3], axis[3], slopes[4], margin, margin_by_height, nearest, area, least, shift;
    const float *worth[LANES];
} Group;

INLINE void assemble(const PhotonJob *job, int64_t first, Group *group) {
    *group = (Group){0}; // lanes without a module see through holes of no area
    EACH_LANE(i) {
        const int64_t m = MIN(first + i, job->last_module - 1);
        const Module *module = &job->holes[m];
        for (int a = 0; a < 3; a++) {
            group->hole[a][i] = module->hole[a], group->axis[a][i] = (float)module->axis[a];
            group->u[a][i] = (float)module->u[a], group->v[a][i] = (float)module->v[a];
        }
        for (int a = 0; a < 4; a++) group->slopes[a][i] = (float)module->slopes[a];
        group->margin[i] = (float)module->margin, group->margin_by_height[i] = (float)module->margin_by_height;
        group->nearest[i] = (float)module->nearest, group->area[i] = first + i == m ? (float)module->area : 0;
        group->least[i] = (float)module->least, group->worth[i] = job->worth + m * job->energies;
        group->shift[i] = (float)((double)m * 0.6180339887498949 - (double)(int64_t)((double)m * 0.6180339887498949));
    }
}

INLINE F at_each(const float *table, I index) {
    F values;
    EACH_LANE(i) values[i] = table[index[i]];
    return values;
}

// About how many photons a collision scatters through each module's hole and into a window, if nothing stops them: by the tables'
// nearest numbers. It is above 0 wherever some are counted.
INLINE F expected(const PhotonJob *job, const Group *group, const Collision *c, const Before *before) {
    F to[3];
    for (int a = 0; a < 3; a++) to[a] = AS(F, group->hole[a] - c->place[a]);
    F height = 0, u = 0, v = 0, along = 0, square = 0;
    for (int a = 0; a < 3; a++) {
        height -= to[a] * group->axis[a], u -= to[a] * group->u[a], v -= to[a] * group->v[a];
        along += to[a] * (float)c->direction[a], square += to[a] * to[a];
    }
    const F *slopes = group->slopes;
    const F beside = MAX(MAX(height * slopes[0] - u, u - height * slopes[1]), MAX(height * slopes[2] - v, v - height * slopes[3]));
    const I sees = (height > group->nearest) & (beside < group->margin + group->margin_by_height * height) & (group->area > 0);
    if (!__builtin_reduce_or(sees)) return 0;
    const F distance = ROOT(MAX(square, (F)1e-12f)), cosine = MIN(MAX(along / distance, (F)-1), (F)1);
    const float energy = (float)c->energy;
    const F ratio = 1 / (1 + energy / (float)ELECTRON * (1 - cosine)), after = energy * ratio;
    const F x = energy * (float)MOMENTUM * ROOT(0.5f * (1 - cosine));
    const I momentum = MIN(AS(I, ROOT(x) * (float)job->momenta_per_root) + 1, (I)(int32_t)(job->momenta - 1));
    const F last = (float)(job->energies - 1);
    const I loses = AS(I, MIN(MAX((after - (float)job->lowest) * (float)job->energies_per_kev, (F)0), last) + 0.5f);
    F incoherent = 0, coherent = 0, worth_after, worth_before;
    for (int a = 0; a < MATERIALS; a++) {
        const float density = job->body[MATERIALS * c->voxel + a];
        if (density == 0) continue;
        incoherent += density * at_each(job->incoherent + a * job->momenta, momentum);
        coherent += density * at_each(job->coherent + a * job->momenta, momentum);
    }
    const int64_t now = before->energy.first + (before->energy.share > 0.5f);
    EACH_LANE(i) worth_after[i] = group->worth[i][loses[i]], worth_before[i] = group->worth[i][now];
    const F compton = incoherent * ratio * ratio * (ratio + 1 / ratio - 1 + cosine * cosine);
    const F passes = group->area * height / (distance * distance * distance);
    const F photons = c->weight * (float)(4 * PI) / before->total * passes;
    return sees ? photons * (compton * worth_after + coherent * (1 + cosine * cosine) * worth_before) : 0;
}

// A module's look at a collision, if it is drawn.
typedef struct {
    const Collision *c;
    Before before;
    Sight sight;
    double to[3], distance, passes; // passes: share of the photons that pass the hole
    int64_t m;
    float weight, chance, drawn; // the look is drawn if `drawn` is below the chance times what remains of the photons on the way
} Look;

// Walk from collisions to modules through the body, until the optical depth is `depth`; see `walk`. Return what is missing of it.
INLINE F walk_together(const PhotonJob *job, const Look *looks, int n, F depth, F *paths) {
    D start[3], speed[3], enter = 0, leave = 0;
    F mu[MATERIALS];
    EACH_LANE(i) {
        const Look *look = &looks[MIN(i, n - 1)];
        leave[i] = look->distance;
        for (int a = 0; a < 3; a++) {
            const double *row = job->index_from_world[a];
            start[a][i] = dot(row, look->c->place) + row[3], speed[a][i] = dot(row, look->to);
        }
        for (int a = 0; a < MATERIALS; a++) mu[a][i] = look->sight.mu_after[a];
    }
    const int64_t strides[3] = {job->n[1] * job->n[2], job->n[2], 1};
    for (int a = 0; a < 3; a++) {
        const D slow = speed[a] == 0 ? (D)1e-30 : speed[a]; // along an axis
        const D first = (0 - start[a]) / slow, last = ((double)job->n[a] - start[a]) / slow;
        enter = MAX(enter, MIN(first, last)), leave = MIN(leave, MAX(first, last));
        speed[a] = slow;
    }
    F next[3], delta[3], t = 0, end = AS(F, leave - enter), left = depth;
    I here = 0, steps[3], room[3];
    for (int a = 0; a < 3; a++) {
        const D entry = MIN(MAX(start[a] + enter * speed[a], (D)0.0), (D)((double)job->n[a] - 0.5));
        const I index = AS(I, entry), ahead = AS(I, speed[a] > 0);
        const F at = AS(F, entry - AS(D, index));
        delta[a] = AS(F, 1 / __builtin_elementwise_abs(speed[a]));
        next[a] = (ahead ? 1 - at : at) * delta[a];
        here += index * (int32_t)strides[a], steps[a] = ahead ? (I)(int32_t)strides[a] : (I)(int32_t)-strides[a];
        room[a] = ahead ? (int32_t)(job->n[a] - 1) - index : index;
    }
    paths[0] = paths[1] = 0;
    I walks = end > 0;
    while (__builtin_reduce_or(walks)) {
        const I x = (next[0] < next[1]) & (next[0] < next[2]), y = ~x & (next[1] < next[2]), z = ~(x | y);
        const F stop = MIN(MIN(MIN(next[0], next[1]), next[2]), end), length = walks ? MAX(stop - t, (F)0) : 0;
        F water, bone;
        EACH_LANE(i) water[i] = job->body[MATERIALS * here[i]], bone[i] = job->body[MATERIALS * here[i] + 1];
        left -= (water * mu[0] + bone * mu[1]) * length;
        paths[0] += water * length, paths[1] += bone * length;
        t = stop;
        room[0] += x, room[1] += y, room[2] += z; // true is -1
        walks &= (t < end) & (left > 0) & ((room[0] | room[1] | room[2]) >= 0);
        next[0] += x ? delta[0] : 0, next[1] += y ? delta[1] : 0, next[2] += z ? delta[2] : 0;
        here += walks & (x ? steps[0] : y ? steps[1] : steps[2]);
    }
    return left;
}

static void look_together(const PhotonJob *job, const Look *looks, int n) {
    F depth = FAR, paths[MATERIALS];
    for (int i = 0; i < n; i++)
        if (looks[i].drawn > 0) depth[i] = (float)depth_of(looks[i].drawn / looks[i].chance);
    const F left = walk_together(job, looks, n, depth, paths);
    for (int i = 0; i < n; i++) {
        const Look *look = &looks[i];
        if (!(left[i] > 0)) continue;
        const float way[MATERIALS] = {paths[0][i], paths[1][i]};
        const float remains = exponential(-(way[0] * look->sight.mu_after[0] + way[1] * look->sight.mu_after[1]));
        const float weight = look->weight / MIN(look->chance * remains, 1.0f);
        record_sight(job, look->c, &look->before, &look->sight, way, look->m, job->cell_of[look->c->voxel], weight, look->passes);
    }
}

INLINE void see_all(const PhotonJob *job, int64_t first, int64_t end) {
    Group groups[GROUPS];
    Look looks[LANES];
    int n_looks = 0;
    const int64_t n = (end - first + LANES - 1) / LANES;
    for (int64_t g = 0; g < n; g++) assemble(job, first + g * LANES, &groups[g]);
    for (const Collision *c = job->collisions; c < job->collisions + *job->n_collisions; c++) {
        const Before before = before_collision(job, c);
        union { double value; uint64_t bits; } place = {c->place[0]};
        Random random = mixed(place.bits);
        const float number = (float)uniform(&random);
        for (int64_t g = 0; g < n; g++) {
            const Group *group = &groups[g];
            const F most = expected(job, group, c, &before);
            F drawn = number + group->shift; // a random number for each module
            drawn = MAX(drawn - AS(F, AS(I, drawn)), (F)1e-7f);
            const I are_drawn = (most > 0) & (drawn * group->least < most); // few photons are not worth the walk every time
            if (!__builtin_reduce_or(are_drawn)) continue;
            for (int i = 0; i < LANES; i++) {
                if (!are_drawn[i]) continue;
                Look *look = &looks[n_looks++];
                const int64_t m = first + g * LANES + i, cell = job->cell_of[c->voxel];
                for (int64_t w = 0; w < job->windows; w++) __builtin_prefetch(place_of(job, c, w, cell, m), 1);
                const int plays = group->least[i] > 0;
                *look = (Look){.c = c, .before = before, .m = m, .weight = c->weight * (float)(4 * PI) / before.total,
                               .chance = plays ? most[i] / group->least[i] : FAR, .drawn = plays ? drawn[i] : 0};
                const Module *module = &job->holes[m];
                for (int a = 0; a < 3; a++) look->to[a] = module->hole[a] - c->place[a];
                const double height = -dot(look->to, module->axis), u = -dot(look->to, module->u), v = -dot(look->to, module->v);
                const double *slopes = module->slopes;
                const int inside = u > height * slopes[0] && u < height * slopes[1] && v > height * slopes[2] && v < height * slopes[3];
                look->distance = __builtin_sqrt(dot(look->to, look->to));
                look->passes = inside ? module->area * height / (look->distance * look->distance * look->distance) : 0;
                for (int a = 0; a < 3; a++) look->to[a] /= look->distance;
                look->sight = towards(job, c, look->to);
                if (n_looks == LANES) look_together(job, looks, n_looks), n_looks = 0;
            }
        }
    }
    if (n_looks) look_together(job, looks, n_looks);
}

void KERNEL(see)(const PhotonJob *job) {
    for (int64_t first = job->first_module; first < job->last_module; first += GROUPS * LANES)
        see_all(job, first, MIN(first + GROUPS * LANES, job->last_module));
}

void KERNEL(see_panel)(const PhotonJob *job) {
    const Panel *panel = job->panel;
    for (const Collision *c = job->collisions; c < job->collisions + *job->n_collisions; c++) {
        const Before before = before_collision(job, c);
        union { double value; uint64_t bits; } place = {c->place[0]};
        Random random = mixed(place.bits);
        double u = uniform(&random), v = uniform(&random);
        for (int64_t p = 0; p < panel->places; p++) {
            u += 0.7548776662466927, v += 0.5698402909980532; // M. Roberts' R2 sequence, shifted at random
            u -= u >= 1, v -= v >= 1;
            double to[3];
            for (int i = 0; i < 3; i++) to[i] = panel->corner[i] + u * panel->u[i] + v * panel->v[i] - c->place[i];
            const double distance = __builtin_sqrt(dot(to, to)), seen = dot(to, panel->area);
            if (!(seen > 0)) continue; // behind the panel
            for (int i = 0; i < 3; i++) to[i] /= distance;
            const Sight sight = towards(job, c, to);
            const double angle = seen / (distance * distance * distance * (double)panel->places);
            const int64_t cell = (int64_t)(v * (double)panel->rows) * panel->columns + (int64_t)(u * (double)panel->columns);
            float paths[MATERIALS], left;
            int64_t voxel;
            walk(job, c->place, to, distance, sight.mu_after, FAR, paths, &left, &voxel);
            record_sight(job, c, &before, &sight, paths, 0, cell, c->weight * (float)angle / before.total, 0);
        }
    }
}
