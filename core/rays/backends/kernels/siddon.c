// Siddon's row integrals and their gradients, by traversing the voxels as Amanatides and Woo do.
//
// A ray crosses a lattice's planes at alphas that are evenly spaced on each axis. From t_enter on, each step goes to the
// nearest of the next three planes, at t_next, and into the voxel beyond it. Rays are traversed a tile at a time, all
// lanes in step; a lane that has arrived takes steps of length 0. A traversal is set up in double and computed in REAL,
// with t, which is alpha scaled so that the traversal starts at 0 and ends at 1: rounding is relative to the chord in the
// lattice, however far away the source is.
//
// Compiled once for every level of processor and for float and double.

#include "lanes.h"
#include "kernels.h"
#if LEVEL == 2
#include <immintrin.h>
#endif

#define NEVER 1e30 // t of a plane that is never crossed
#define FAR 1e15 // voxels
#define SNAP 1e-9 // as in ray_geometry.py: a ray this close to a plane lies in it

// Tiles take turns of TURN steps. Neighbouring tiles then read the same part of the volume at about the same time, and a
// tile's next voxels, prefetched a turn ahead, come from memory while the other tiles have their turns.
#define TILES 64
#define TURN 24

enum { FORWARD, BACKPROJECT, BY_ENDS, BY_MU };

// The traversal of a lattice by a tile.
typedef struct {
    F t_first[3], t_delta[3]; // the k-th plane ahead is crossed at t_first + k t_delta
    F k[3]; // number of the plane after the next one
    I stride[3], voxel; // change of the voxel's index with a plane crossed, and the index
    F t_enter, t_exit;
    int64_t ahead; // approximate change of the index in TURN steps
    I entry_face[3], exit_face[3]; // -1 for the axis of the face through which rays enter and leave
} Traversal;

// State of a traversal that changes from step to step.
typedef struct {
    F t, sum;
    F transmittance; // from the source to t
    F beyond;        // the part of the integral beyond t
} State;

// Further state for derivatives by the ends: the voxels' values at t, the optical depth from the source to t, and the
// sums that `add_jump` explains.
typedef struct {
    F f, mu, depth_before, by_length, jumps[3], moments[3], mu_jumps[3], mu_moments[3];
} Jumps;

typedef struct {
    Traversal traversal, mu_traversal;
    State state;
    F value, length; // value of the ray to be back-projected; mm from t = 0 to t = 1
    D alpha_start, alpha_span, mm; // alpha where t is 0; alpha from t = 0 to t = 1; mm of the whole ray
    int64_t steps, apart; // number of steps to the end; whether neighbouring rays are far apart in memory
    int n_rays;
    Jumps jumps;
} Tile;

typedef struct {
    D start[3], direction[3], mu_start[3], mu_direction[3], mm;
    B real; // whether a lane has a ray: not beyond the last one
} Rays;

// One axis of the rays to the points (row, column) of a fan; rays that nearly lie in a plane of voxel faces are snapped to it.
INLINE void fan_ray(const double fan[4][3], double parallel, int a, D row, D column, D *start, D *direction) {
    const D to = column * fan[3][a] + (row * fan[2][a] + fan[1][a]);
    const D from = fan[0][a] + parallel * (to - fan[1][a]), plane = rounded(from);
    const B in_plane = (ABS(from - plane) <= (D)SNAP) & (ABS(to - plane) <= (D)SNAP);
    *start = in_plane ? plane : from;
    *direction = (in_plane | (ABS(to - *start) <= (D)SNAP)) ? (D)0 : to - *start;
}

INLINE void fan_rays(const Fan *fan, D number, const int own, Rays *r) {
    const D row = whole((number + 0.5) * (1.0 / fan->columns)), column = number - row * fan->columns;
    D squared = 0;
    EACH_AXIS(a) {
        fan_ray(fan->volume, fan->parallel, a, row, column, &r->start[a], &r->direction[a]);
        if (own) fan_ray(fan->mu, fan->parallel, a, row, column, &r->mu_start[a], &r->mu_direction[a]);
        const D mm = column * fan->world[2][a] + (row * fan->world[1][a] + fan->world[0][a]);
        squared += mm * mm;
    }
    r->mm = __builtin_elementwise_sqrt(squared);
}

INLINE void listed_rays(const RayList *list, const int64_t first, const int own, Rays *r) {
    EACH_LANE(i) {
        const int64_t n = first + i < list->count ? first + i : list->count - 1;
        EACH_AXIS(a) {
            const int64_t at = a * list->count + n;
            r->start[a][i] = list->starts[at], r->direction[a][i] = list->directions[at];
            if (own) r->mu_start[a][i] = list->mu_starts[at], r->mu_direction[a][i] = list->mu_directions[at];
        }
        r->mm[i] = list->lengths[n];
    }
}

// Rays whose ends are not numbers, or so far away that voxels cannot be distinguished, are made to miss.
INLINE void make_miss(D start[3], D direction[3], D *mm) {
    B sound = *mm < (D)NEVER;
    EACH_AXIS(a) sound &= ABS(start[a]) + ABS(direction[a]) < (D)FAR;
    EACH_AXIS(a) start[a] = sound ? start[a] : (D)-1;
    EACH_AXIS(a) direction[a] = (sound & (ABS(direction[a]) > (D)SNAP)) ? direction[a] : (D)0;
    *mm = sound ? *mm : (D)0;
}

// Alpha where rays enter and leave a lattice, overall and for each axis. Where they miss it, enter >= leave.
INLINE void clip(const Lattice *lattice, const D start[3], const D direction[3], D *enter, D *leave, D in[3],
                 D out[3]) {
    *enter = 0, *leave = 1;
    EACH_AXIS(a) {
        const D n = lattice->n[a];
        const B parallel = direction[a] == (D)0, within = (start[a] >= (D)0) & (start[a] < n);
        const D inverse = 1 / (parallel ? (D)1 : direction[a]), low = -start[a] * inverse,
                high = (n - start[a]) * inverse;
        in[a] = parallel ? (within ? (D)-NEVER : (D)NEVER) : MIN(low, high);
        out[a] = parallel ? (within ? (D)NEVER : (D)-NEVER) : MAX(low, high);
        *enter = MAX(*enter, in[a]);
        *leave = MIN(*leave, out[a]);
    }
}

// Set up the traversal from alpha `enter` on, with t = 0 at alpha `begin` and t = 1 after `span`. Return the largest possible
// number of planes crossed.
//
// Why a voxel's index never leaves the lattice: from the first voxel, `room` planes can be crossed. Plane k, counted
// from 0, is crossed at fl(t_first + k t_delta), which does not decrease with k, since rounding is monotonic, and only
// at a t of at most t_exit, which is below fl(t_first + room t_delta): so k < room. The margin allows for the
// expression being rounded once in one place and twice in another.
INLINE D set_up_traversal(Traversal *traversal, const Lattice *lattice, const D start[3], const D direction[3], B hits,
                          D enter, D begin, D span) {
    D crossings = 0, crossed[3];
    const D per_span = 1 / span;
    traversal->voxel = 0;
    traversal->t_exit = 1;
    int64_t stride = 1;
    UNROLLED for (int a = 2; a >= 0; stride *= lattice->n[a--]) {
        const D last = lattice->n[a] - 1;
        const D voxel = whole(MAX(MIN(enter * direction[a] + start[a], last), (D)0));
        const B up = direction[a] > (D)0, crosses = hits & (direction[a] != (D)0);
        const D inverse = 1 / (crosses ? direction[a] : (D)1), room = up ? last - voxel : voxel;
        const D t_first = ((voxel + (up ? (D)1 : (D)0) - start[a]) * inverse - begin) * per_span;
        const D t_delta = ABS(inverse) * per_span;
        crossed[a] = crosses ? whole(MAX(MIN((1 - t_first) / t_delta + 1, room), (D)0)) : (D)0;
        crossings += crossed[a];
        traversal->t_first[a] = AS(F, crosses ? MAX(MIN(t_first, (D)NEVER), (D)-NEVER) : (D)NEVER);
        traversal->t_delta[a] = AS(F, crosses ? MIN(t_delta, (D)NEVER) : (D)0);
        traversal->k[a] = 1;
        traversal->stride[a] = AS(I, up ? (D)stride : (D)-stride);
        traversal->voxel += AS(I, voxel) * (I)stride;
        const F t_face = MIN(traversal->t_first[a] + AS(F, room) * traversal->t_delta[a], (F)NEVER);
        const F margin = MAX(ABS(t_face) * (F)(sizeof(REAL) == 8 ? 1e-15 : 3e-7), (F)(1 / NEVER));
        traversal->t_exit = MIN(traversal->t_exit, t_face - margin);
    }
    I idle; // lanes that miss get a voxel each, so that they do not wait for each other's memory
    EACH_LANE(i) idle[i] = i < stride ? i : 0;
    traversal->voxel = AS(I, hits) ? traversal->voxel : idle;
    D ahead = 0; // that of the middle lane is used for all: it only determines the prefetch
    EACH_AXIS(a) ahead += whole(crossed[a] * (TURN / MAX(crossings, (D)1)) + 0.5) * AS(D, traversal->stride[a]);
    traversal->ahead = (int64_t)ahead[LANES / 2];
    return crossings;
}

// At an edge or a corner, where several faces meet, only the first axis stays set.
INLINE void exclusive(I face[3]) {
    face[1] &= ~face[0];
    face[2] &= ~(face[0] | face[1]);
}

INLINE void find_faces(Traversal *traversal, B hits, D enter, D leave, const D in[3], const D out[3]) {
    EACH_AXIS(a) {
        traversal->entry_face[a] = AS(I, hits & (enter > (D)0) & (in[a] == enter));
        traversal->exit_face[a] = AS(I, hits & (leave < (D)1) & (out[a] == leave));
    }
    exclusive(traversal->entry_face);
    exclusive(traversal->exit_face);
}

// Element i of indices, which are never negative. They leave the vector register two at a time: each extraction takes time.
typedef uint64_t Pairs __attribute__((ext_vector_type(LANES * sizeof(REAL) / 8)));
#define INDEX(pairs, i) (sizeof(REAL) == 8 ? pairs[i] : (i) % 2 ? pairs[(i) / 2] >> 32 : pairs[(i) / 2] & 0xffffffff)

INLINE F gather(const REAL *voxels, I index) {
#if LEVEL == 2 // has a gather instruction that is worth using
    return sizeof(REAL) == 8 ? (F)_mm512_i64gather_pd((__m512i)index, voxels, 8)
                             : (F)_mm512_i32gather_ps((__m512i)index, voxels, 4);
#else
    const Pairs pairs = (Pairs)index;
    F values;
    EACH_LANE(i) values[i] = voxels[INDEX(pairs, i)];
    return values;
#endif
}

// Lanes are added one after the other, since several may add to the same voxel.
INLINE void scatter_add(REAL *voxels, I index, F values) {
    const Pairs pairs = (Pairs)index;
    EACH_LANE(i) voxels[INDEX(pairs, i)] += values[i];
}

// Prefetch ahead of the outer lanes, and of some between them where they are far apart.
INLINE void prefetch(const REAL *voxels, I index, const Traversal *traversal, int64_t apart, const int writes) {
    const Pairs pairs = (Pairs)index;
    const REAL *later = voxels + traversal->ahead;
#define FETCH(i) (writes ? __builtin_prefetch(later + INDEX(pairs, i), 1) : __builtin_prefetch(later + INDEX(pairs, i)))
    FETCH(0);
    FETCH(LANES - 1);
    if (apart) UNROLLED for (int i = 5; i < (int)LANES - 1; i += 5) FETCH(i);
}

// Attenuation over a segment is computed by a series if the segment is thin, as nearly all are.
#define THIN ((REAL)0.25)
#define TERMS (sizeof(REAL) == 8 ? 12 : 6)

// The mean of exp(-s) for s from 0 to depth, and exp(-depth). Thick segments are halved, and doubled back by formulas.
INLINE F mean_transmittance(F depth, F *transmittance) {
    I halved = 0;
    int most = 0;
    for (; ANY(depth > (F)THIN) && most < 1100; most++) {
        const I thick = depth > (F)THIN;
        depth = thick ? depth * (F)0.5 : depth;
        halved -= thick;
    }
    F mean = 1;
    UNROLLED for (int n = TERMS; n > 1; n--) mean = 1 - depth * mean * (F)(1.0 / n);
    *transmittance = 1 - depth * mean;
    for (; most > 0; most--) {
        const I again = halved >= most;
        mean = again ? mean * (1 + *transmittance) * (F)0.5 : mean;
        *transmittance = again ? *transmittance * *transmittance : *transmittance;
    }
    return mean;
}

// The integral of s exp(-s) for s from 0 to depth, by depth^2: 1/2 for a depth of 0. `mean` is that of exp(-s).
INLINE F first_moment(F depth, F mean) {
    F moment = (F)0.5;
    UNROLLED for (int n = TERMS; n > 0; n--) moment = (F)0.5 - depth * moment * (F)((n + 1.0) / (n * (n + 2.0)));
    return depth > (F)THIN ? (mean - 1 + depth * mean) / depth : moment;
}

INLINE void set_up_tile(Tile *tile, const Job *job, const Rays *r, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE;
    Traversal *traversal = &tile->traversal, *mu_traversal = &tile->mu_traversal;
    D enter, leave, in[3], out[3], mu_enter, mu_leave, mu_in[3], mu_out[3], crossings;
    clip(&job->volume, r->start, r->direction, &enter, &leave, in, out);
    B hits = (enter < leave) & r->real, hits_mu = hits;
    D starts_at = hits ? enter : (D)0;
    if (own) {
        clip(&job->mu, r->mu_start, r->mu_direction, &mu_enter, &mu_leave, mu_in, mu_out);
        hits_mu &= (mu_enter < mu_leave) & (mu_enter < leave);
        starts_at = hits_mu ? MIN(starts_at, mu_enter) : starts_at;
    }
    const D span = hits ? leave - starts_at : (D)1;
    const D from = hits ? enter : (D)0;
    crossings = set_up_traversal(traversal, &job->volume, r->start, r->direction, hits, from, starts_at, span);
    const F t_end = MIN(traversal->t_exit, (F)1);
    hits &= AS(B, t_end > (F)0);
    traversal->t_exit = AS(I, hits) ? t_end : (F)0;
    EACH_AXIS(a) traversal->t_first[a] = AS(I, hits) ? traversal->t_first[a] : (F)NEVER; // nothing to cross
    tile->alpha_start = starts_at;
    tile->alpha_span = hits ? span : (D)0;
    tile->mm = r->mm;
    tile->length = AS(F, tile->alpha_span * r->mm);
    tile->state.t = 0;
    if (own) {
        const D mu_from = hits_mu ? mu_enter : (D)0;
        crossings += 4 + set_up_traversal(mu_traversal, &job->mu, r->mu_start, r->mu_direction, hits_mu, mu_from, starts_at,
                                          span);
        traversal->t_enter = AS(F, hits ? (enter - starts_at) / span : (D)0);
        mu_traversal->t_enter = AS(I, hits_mu) ? AS(F, (mu_enter - starts_at) / span) : (F)NEVER;
        mu_traversal->t_exit = AS(I, hits_mu) ? MIN(mu_traversal->t_exit, AS(F, (mu_leave - starts_at) / span)) : (F)0;
    }
    if (task == BY_ENDS) find_faces(traversal, hits, enter, leave, in, out);
    if (task == BY_ENDS && own) find_faces(mu_traversal, hits_mu, mu_enter, mu_leave, mu_in, mu_out);
    const D middle = (enter + leave) * 0.5 * r->direction[2] + r->start[2];
    const double apart = middle[LANES - 1] - middle[0]; // along the axis that is contiguous in memory
    tile->apart = apart > 16 || apart < -16;
    const D steps = hits ? crossings + 1 : (D)0;
    tile->steps = (int64_t)__builtin_reduce_max(steps);
}

// t of the next plane of each axis. It is computed from the plane's number, so that rounding does not accumulate, and one step
// early, so that no step waits for it.
#define NEXT_PLANE(traversal, a) (((traversal).k[a] - 1) * (traversal).t_delta[a] + (traversal).t_first[a])

// Cross planes: move on to the next planes of their axes and to the voxel beyond.
INLINE void cross(Traversal *traversal, F t_next[3], const I crossed[3]) {
    EACH_AXIS(a) {
        const F after = traversal->k[a] * traversal->t_delta[a] + traversal->t_first[a];
        traversal->k[a] = ADD_WHERE(crossed[a], traversal->k[a], (F)1);
        t_next[a] = crossed[a] ? after : t_next[a];
        traversal->voxel = ADD_WHERE(crossed[a], traversal->voxel, traversal->stride[a]);
    }
}

// Sums for the change of an integral when planes move: each plane contributes the jump of the value there times the change of
// its t. Plane k is crossed at alpha = (k - s) / d, d the ray from s to its end e: d alpha / ds = (alpha - 1) / d,
// d alpha / de = -alpha / d. So the sums of jumps, and of jumps times t, of each axis are all that is needed.
INLINE void add_jump(F jumps[3], F moments[3], I plane[3], F jump, F t) {
    exclusive(plane);
    EACH_AXIS(a) {
        jumps[a] = ADD_WHERE(plane[a], jumps[a], jump);
        moments[a] = ADD_WHERE(plane[a], moments[a], jump * t);
    }
}

// Steps of a tile. A segment goes from t to t_end through a voxel of the volume, of value f, and one of mu.
INLINE void traverse(Tile *tile, const Job *job, int64_t steps, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE, same = attenuation == SAME_LATTICE, attenuated = own || same;
    REAL *const voxels = job->volume.voxels, *const mus = job->mu.voxels, *const gradient = job->gradient;
    const F value = tile->value, length = tile->length;
    Traversal v = tile->traversal, m = tile->mu_traversal;
    State w = tile->state;
    Jumps d;
    if (task == BY_ENDS) d = tile->jumps;
    F t_next[3], mu_t_next[3];
    EACH_AXIS(a) t_next[a] = NEXT_PLANE(v, a);
    if (own) EACH_AXIS(a) mu_t_next[a] = NEXT_PLANE(m, a);
    for (; steps > 0; steps--) {
        F t_end = MIN(MIN(t_next[0], t_next[1]), MIN(t_next[2], v.t_exit));
        I inside = -1, inside_mu = -1;
        if (own) {
            inside = w.t >= v.t_enter;
            inside_mu = (w.t >= m.t_enter) & (w.t < m.t_exit);
            t_end = inside ? t_end : v.t_enter;
            const F t_mu = MIN(MIN(mu_t_next[0], mu_t_next[1]), MIN(mu_t_next[2], m.t_exit));
            t_end = MIN(t_end, inside_mu ? t_mu : w.t < m.t_enter ? m.t_enter : (F)NEVER);
            t_end = MAX(MIN(t_end, v.t_exit), w.t); // never backwards: rounding may put a plane just before t
        }
        const I at = v.voxel, at_mu = own ? m.voxel : at;
        prefetch(voxels, at, &v, tile->apart, task == BACKPROJECT);
        if (attenuated) prefetch(task == BY_MU ? gradient : mus, at_mu, own ? &m : &v, tile->apart, task == BY_MU);
        F f = task == BY_ENDS ? d.f : task == BACKPROJECT ? value : gather(voxels, at);
        if (own) f = inside ? f : (F)0;
        const F dt = t_end - w.t;
        F weight = dt, depth = 0, mean = 1, transmittance = 1, mu = 0;
        if (attenuated) {
            mu = task == BY_ENDS ? d.mu : gather(mus, at_mu);
            if (own) mu = inside_mu ? mu : (F)0;
            depth = mu * dt * length;
            mean = mean_transmittance(depth, &transmittance);
            weight = dt * w.transmittance * mean;
        }
        if (task == FORWARD) w.sum += weight * f;
        if (task == BACKPROJECT) scatter_add(voxels, at, weight * f);
        if (task == BY_MU) { // more mu attenuates photons from beyond the segment, and about half of those from within
            w.beyond -= weight * f;
            const F within = f * w.transmittance * dt * first_moment(depth, mean);
            const F change = value * dt * (w.beyond + within);
            scatter_add(gradient, at_mu, own ? (inside_mu ? change : (F)0) : change);
        }
        if (task == BY_ENDS && attenuated) {
            d.by_length += f * w.transmittance * dt * (d.depth_before * mean + depth * first_moment(depth, mean));
            d.depth_before += depth;
            w.beyond -= weight * f;
        } else if (task == BY_ENDS) w.sum += weight * f;
        if (attenuated) w.transmittance *= transmittance;
        I crossed[3], mu_crossed[3];
        EACH_AXIS(a) crossed[a] = t_next[a] <= t_end;
        if (own) EACH_AXIS(a) crossed[a] &= inside, mu_crossed[a] = (mu_t_next[a] <= t_end) & inside_mu;
        cross(&v, t_next, crossed);
        if (own) cross(&m, mu_t_next, mu_crossed);
        if (task == BY_ENDS) {
            I enters = ~inside & (t_end >= v.t_enter), leaves = 0;
            if (own) EACH_AXIS(a) crossed[a] |= enters & v.entry_face[a];
            d.f = gather(voxels, v.voxel);
            if (own) d.f = (inside | enters) ? d.f : (F)0;
            add_jump(d.jumps, d.moments, crossed, attenuated ? w.transmittance * (f - d.f) : f - d.f, t_end);
            if (own) {
                enters = (w.t < m.t_enter) & (t_end >= m.t_enter), leaves = inside_mu & (t_end >= m.t_exit);
                EACH_AXIS(a) mu_crossed[a] |= (enters & m.entry_face[a]) | (leaves & m.exit_face[a]);
            }
            if (attenuated) d.mu = gather(mus, own ? m.voxel : v.voxel);
            if (own) d.mu = ((inside_mu & ~leaves) | enters) ? d.mu : (F)0;
            I *const at_planes = own ? mu_crossed : crossed;
            if (attenuated) add_jump(d.mu_jumps, d.mu_moments, at_planes, w.beyond * (mu - d.mu), t_end);
        }
        w.t = t_end;
    }
    tile->state = w;
    EACH_AXIS(a) tile->traversal.k[a] = v.k[a];
    tile->traversal.voxel = v.voxel;
    if (own) EACH_AXIS(a) tile->mu_traversal.k[a] = m.k[a];
    if (own) tile->mu_traversal.voxel = m.voxel;
    if (task == BY_ENDS) tile->jumps = d;
}

// Set up the last step over the rest of the chord, the margin of t_exit, in which no plane is crossed.
INLINE void reach_exit(Tile *tile) {
    Traversal *traversal = &tile->traversal, *mu_traversal = &tile->mu_traversal;
    EACH_AXIS(a) traversal->t_first[a] = mu_traversal->t_first[a] = (F)NEVER;
    traversal->t_exit = tile->length > (F)0 ? (F)1 : (F)0;
    mu_traversal->t_enter = tile->state.t < mu_traversal->t_enter ? (F)NEVER : mu_traversal->t_enter;
    mu_traversal->t_exit = tile->state.t < mu_traversal->t_exit ? (F)NEVER : mu_traversal->t_exit;
}

INLINE F load(const void *numbers, int64_t first, int n_rays) {
    F taken = 0;
    for (int i = 0; i < n_rays; i++) taken[i] = ((const REAL *)numbers)[first + i];
    return taken;
}

// Set the state at t = 0 of a tile of `n_rays` rays from `first` on.
INLINE void set_up_task(Tile *tile, const Job *job, int64_t first, int n_rays, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE, attenuated = attenuation != NO_MU;
    tile->state.sum = tile->state.beyond = tile->jumps.depth_before = tile->jumps.by_length = 0;
    tile->state.transmittance = 1;
    if (task == BACKPROJECT || task == BY_MU) {
        tile->value = load(job->values, first, n_rays) * (task == BY_MU ? -tile->length * tile->length : tile->length);
        if (!ANY(tile->value != (F)0)) tile->steps = 0;
    }
    if (task == BY_MU || (task == BY_ENDS && attenuated)) {
        const F integral = load(job->integrals, first, n_rays);
        tile->state.beyond = tile->length > (F)0 ? integral / tile->length : (F)0;
    }
    if (task != BY_ENDS) return;
    tile->jumps.f = tile->jumps.mu = 0;
    if (tile->steps) {
        tile->jumps.f = gather(job->volume.voxels, tile->traversal.voxel);
        if (own) tile->jumps.f = tile->traversal.t_enter <= (F)0 ? tile->jumps.f : (F)0;
        if (attenuated) tile->jumps.mu = gather(job->mu.voxels, own ? tile->mu_traversal.voxel : tile->traversal.voxel);
        if (own) tile->jumps.mu = tile->mu_traversal.t_enter <= (F)0 ? tile->jumps.mu : (F)0;
    }
    EACH_AXIS(a) {
        const I into_mu = own ? tile->mu_traversal.entry_face[a] : tile->traversal.entry_face[a];
        tile->jumps.jumps[a] = tile->traversal.entry_face[a] ? -tile->jumps.f : (F)0;
        if (attenuated) tile->jumps.mu_jumps[a] = into_mu ? -tile->jumps.mu * tile->state.beyond : (F)0;
        tile->jumps.moments[a] = tile->jumps.mu_moments[a] = 0;
    }
}

INLINE void store(double *row, int n_rays, D numbers) {
    for (int i = 0; i < n_rays; i++) row[i] = numbers[i];
}

// Store derivatives by start and end of rays in rows of n numbers.
INLINE void store_by_ends(double *rows, int64_t n, int n_rays, const Tile *t, const F jumps[3], const F moments[3],
                        const D direction[3]) {
    EACH_AXIS(a) {
        const D inverse = direction[a] == (D)0 ? (D)0 : 1 / direction[a];
        const D jump = AS(D, jumps[a]), moment = AS(D, moments[a]) * t->alpha_span + jump * t->alpha_start;
        store(rows + a * n, n_rays, (moment - jump) * inverse);
        store(rows + (3 + a) * n, n_rays, -moment * inverse);
    }
}

// Store the derivatives of a tile of `n_rays` rays from `first` on, out of n.
INLINE void store_derivatives(Tile *t, const Job *job, const Rays *r, int64_t first, int n_rays, int64_t n,
                            const int attenuation) {
    const int own = attenuation == OWN_LATTICE, attenuated = attenuation != NO_MU;
    double *const rows = job->derivatives + first;
    const D per_mm = t->mm > (D)0 ? 1 / t->mm : (D)0;
    const D integral = AS(D, load(job->integrals, first, attenuated ? n_rays : 0));
    store(rows, n_rays, attenuated ? integral * per_mm : AS(D, t->state.sum) * t->alpha_span);
    // Add the jump at the face through which rays leave.
    const F last = attenuated ? t->state.transmittance * t->jumps.f : t->jumps.f;
    EACH_AXIS(a) {
        t->jumps.jumps[a] += t->traversal.exit_face[a] ? last : (F)0;
        t->jumps.moments[a] += t->traversal.exit_face[a] ? last * t->state.t : (F)0;
    }
    store_by_ends(rows + n, n, n_rays, t, t->jumps.jumps, t->jumps.moments, r->direction);
    if (!attenuated) return;
    EACH_AXIS(a) t->jumps.mu_jumps[a] *= -t->length, t->jumps.mu_moments[a] *= -t->length;
    store_by_ends(rows + 7 * n, n, n_rays, t, t->jumps.mu_jumps, t->jumps.mu_moments,
                  own ? r->mu_direction : r->direction);
    store(rows + 13 * n, n_rays, -AS(D, t->jumps.by_length) * t->alpha_span * per_mm);
}

// Set up the rays of a tile, of a fan or of the list, from number `begin` on.
INLINE void tile_rays(const Job *job, const Fan *fan, int64_t begin, int64_t count, const int own, Rays *r) {
    D number;
    EACH_LANE(i) number[i] = (double)(begin + i);
    if (fan) fan_rays(fan, number, own, r);
    else listed_rays(&job->list, begin, own, r);
    r->real = number < (D)count;
    make_miss(r->start, r->direction, &r->mm);
    if (own) make_miss(r->mu_start, r->mu_direction, &r->mm);
}

// Trace the rays of a fan, or of the list, the first of which is ray `offset` out of n.
INLINE void trace_bundle(const Job *job, const Fan *fan, int64_t count, int64_t offset, int64_t n, const int task,
                         const int attenuation) {
    const int own = attenuation == OWN_LATTICE, width = LANES;
    Tile tiles[TILES];
    Rays rays;
    for (int64_t starts_at = 0; starts_at < count; starts_at += TILES * width) {
        const int64_t rest = count - starts_at, n_tiles = rest < TILES * width ? (rest + width - 1) / width : TILES;
        int64_t longest = 0;
        for (int i = 0; i < n_tiles; i++) {
            const int n_rays = tiles[i].n_rays = rest - i * width < width ? rest - i * width : width;
            tile_rays(job, fan, starts_at + i * width, count, own, &rays);
            set_up_tile(tiles + i, job, &rays, task, attenuation);
            set_up_task(tiles + i, job, offset + starts_at + i * width, n_rays, task, attenuation);
            longest = tiles[i].steps > longest ? tiles[i].steps : longest;
        }
        for (int64_t done = 0; done < longest + TURN; done += TURN)
            for (int i = 0; i < n_tiles; i++) {
                const int64_t steps = tiles[i].steps - done;
                if (!tiles[i].steps || steps <= -TURN) continue;
                if (steps <= 0) reach_exit(tiles + i);
                traverse(tiles + i, job, steps > TURN ? TURN : steps > 0 ? steps : 1, task, attenuation);
            }
        for (int i = 0; i < n_tiles && (task == FORWARD || task == BY_ENDS); i++) {
            const int n_rays = tiles[i].n_rays;
            const int64_t first = offset + starts_at + i * width;
            if (task == FORWARD) {
                const F integral = AS(F, AS(D, tiles[i].state.sum) * tiles[i].alpha_span * tiles[i].mm);
                for (int j = 0; j < n_rays; j++) ((REAL *)job->values)[first + j] = integral[j];
            } else {
                // The rays are computed again: to store them takes longer.
                tile_rays(job, fan, starts_at + i * width, count, own, &rays);
                store_derivatives(tiles + i, job, &rays, first, n_rays, n, attenuation);
            }
        }
    }
}

INLINE void trace(const Job *job, const int task, const int attenuation) {
    int64_t n = job->list.count, offset = 0;
    for (int64_t f = 0; f < job->n_fans; f++) n += job->fans[f].rows * job->fans[f].columns;
    for (int64_t f = 0; f < (job->n_fans ? job->n_fans : 1); f++) {
        const Fan *fan = job->n_fans ? job->fans + f : 0;
        const int64_t count = fan ? fan->rows * fan->columns : n;
        trace_bundle(job, fan, count, offset, n, task, attenuation);
        offset += count;
    }
}

#define NAME(task) JOINED(task, LEVEL, REAL)
#define JOINED(task, level, real) JOINED_(task, level, real)
#define JOINED_(task, level, real) task##_##level##_##real
#define KERNEL(name, task)                                                     \
    void NAME(name)(const Job *job) {                                          \
        if (job->attenuation == OWN_LATTICE) trace(job, task, OWN_LATTICE);    \
        else if (job->attenuation == SAME_LATTICE) trace(job, task, SAME_LATTICE); \
        else trace(job, task, NO_MU);                                          \
    }

KERNEL(forward, FORWARD)
KERNEL(backproject, BACKPROJECT)
KERNEL(differentiate, BY_ENDS)
KERNEL(differentiate_by_mu, BY_MU)
