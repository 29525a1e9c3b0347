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
    const float end = (float)(leave - enter);
    float t = 0;
    for (;;) {
        const int64_t here = index[0] * strides[0] + index[1] * strides[1] + index[2];
        const int axis = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
        const float stop = MIN(next[axis], end), length = MAX(stop - t, 0.0f);
        const float *densities = job->body + MATERIALS * here;
        const float rate = densities[0] * mu[0] + densities[1] * mu[1];
        if (rate * length >= *depth_left) {
            const float part = *depth_left / rate;
            paths[0] += densities[0] * part, paths[1] += densities[1] * part;
            *depth_left = 0, *voxel = here;
            return enter + t + part;
        }
        *depth_left -= rate * length;
        paths[0] += densities[0] * length, paths[1] += densities[1] * length;
        t = stop;
        if (!(t < end)) return limit;
        next[axis] += delta[axis];
        index[axis] += slope[axis] > 0 ? 1 : -1;
        if (index[axis] < 0 || index[axis] >= job->n[axis]) return limit;
    }
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

// The largest share of photons of this energy that any window of a module counts.
INLINE float counted(const PhotonJob *job, int64_t m, Between at) {
    float most = job->spectra ? 1 : 0;
    for (int64_t w = 0; w < job->windows; w++) {
        const float share = in(job->accepted + (m * job->windows + w) * job->energies, at);
        most = MAX(most, share);
    }
    return most;
}

INLINE void record(const PhotonJob *job, const Collision *c, int64_t m, int64_t cell, double energy, float weight, double spectral) {
    const Between at = energy_place(job, energy);
    const int64_t orders = job->orders, order = c->order < orders ? c->order - 1 : orders - 1;
    const float *accepted = job->accepted + m * job->windows * job->energies;
    for (int64_t w = 0; w < job->windows; w++) {
        float *sum = job->seen + ((order * job->windows + w) * job->cells + cell) * job->modules + m;
        *sum += weight * in(accepted + w * job->energies, at);
    }
    if (job->spectra) job->spectra[m * job->energies + at.first + (at.share > 0.5f)] += weight * spectral;
}

// Record the photons of a weight that a collision scatters along a way through the body, with the energies they then have.
INLINE void record_sight(const PhotonJob *job, const Collision *c, const Before *before, const Sight *sight, const double *to,
                         double distance, int64_t m, int64_t cell, float weight, double spectral) {
    float paths[MATERIALS], left;
    int64_t voxel;
    walk(job, c->place, to, distance, sight->mu_after, FAR, paths, &left, &voxel);
    const float after = exponential(-(paths[0] * sight->mu_after[0] + paths[1] * sight->mu_after[1]));
    const float kept = exponential(-(paths[0] * before->mu[0] + paths[1] * before->mu[1]));
    record(job, c, m, cell, sight->after, weight * sight->compton * after, spectral);
    record(job, c, m, cell, c->energy, weight * sight->rayleigh * kept, spectral);
}

void KERNEL(see)(const PhotonJob *job) {
    for (const Collision *c = job->collisions; c < job->collisions + *job->n_collisions; c++) {
        const Before before = before_collision(job, c);
        for (int64_t m = job->first_module; m < job->last_module; m++) {
            const Module *module = &job->holes[m];
            double to[3];
            for (int i = 0; i < 3; i++) to[i] = module->hole[i] - c->place[i];
            const double height = -dot(to, module->axis), u = -dot(to, module->u), v = -dot(to, module->v);
            const double margin = module->margin + module->margin_by_height * height;
            const double outside = MAX(MAX(height * module->slopes[0] - u, u - height * module->slopes[1]),
                                       MAX(height * module->slopes[2] - v, v - height * module->slopes[3]));
            if (!(height > module->nearest && outside < margin)) continue;
            const double distance = __builtin_sqrt(dot(to, to));
            for (int i = 0; i < 3; i++) to[i] /= distance;
            const Sight sight = towards(job, c, to);
            float weight = c->weight * (float)(4 * PI) / before.total;
            const double passes = module->area * height / (distance * distance * distance);
            const double most = weight * passes * (sight.compton * counted(job, m, sight.loses) + sight.rayleigh * counted(job, m, before.energy));
            if (most < module->least || most <= 0) { // few photons: not worth the walk every time
                union { double value; uint64_t bits; } place = {c->place[0]};
                Random random = mixed(place.bits ^ mixed((uint64_t)m + 1));
                if (uniform(&random) * module->least >= most) continue;
                weight *= (float)(module->least / most);
            }
            record_sight(job, c, &before, &sight, to, distance, m, job->cell_of[c->voxel], weight, outside < 0 ? passes : 0);
        }
    }
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
            record_sight(job, c, &before, &sight, to, distance, 0, cell, c->weight * (float)angle / before.total, 0);
        }
    }
}
