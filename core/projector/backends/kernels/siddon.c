// Siddon's line integrals, and what follows from them, by walking from voxel to voxel as Amanatides and Woo do.
//
// A ray crosses a lattice's planes at alphas that are evenly spaced on each axis. From where it enters, at t_enter,
// each step goes to the nearest of the three next planes and into the voxel behind. Rays are walked a tile at a time,
// all lanes in step; a lane that has arrived takes steps of no length. Everything is set up in double and walked in
// REAL, in a measure of alpha, t, that is 0 where the walk begins and 1 where it ends: rounding is relative to the way
// through the lattice, however far away the source is.
//
// Compiled once for every level of processor and for float and double.

#include "lanes.h"
#include "kernels.h"
#if LEVEL == 2
#include <immintrin.h>
#endif

#define NEVER 1e30 // t of a plane that is never crossed
#define FAR 1e15 // voxels
#define SNAP 1e-9 // as in rays.py: a ray this close to a plane lies in it

// Some tiles take turns of some steps. Tiles side by side then read the same part of the volume at about the same time,
// and a tile's next voxels, sent for a turn ahead, come from memory while the others have their turns.
#define TILES 64
#define TURN 24

enum { FORWARD, BACKPROJECT, BY_ENDS, BY_MU };

// A tile's way through a lattice.
typedef struct {
    F t_first[3], t_step[3]; // plane k of those ahead is crossed at t_first + k t_step
    F k[3]; // number of the plane after the next
    I stride[3], voxel; // what crossing a plane adds to the voxel's index
    F t_enter, t_exit;
    int64_t ahead; // what TURN steps add to the voxel's index
    I into[3], out[3]; // the axis of the face by which rays enter and leave
} Way;

// What changes as a tile walks.
typedef struct {
    F t, sum;
    F left, behind; // of the ray, by attenuation; of the integral, what lies behind t
} State;

// What its derivatives need besides: values of the voxels at t, depth passed, and the sums that `walk` explains.
typedef struct {
    F f, mu, passed, by_length, jumps[3], moments[3], mu_jumps[3], mu_moments[3];
} Jumps;

typedef struct {
    Way way, mu_way;
    State state;
    F value, length; // of the ray; mm of a t of 1
    D begin, span, mm; // alpha where t is 0, and of a t of 1; mm of the whole ray
    int64_t steps, wide; // steps to its end; whether its rays are far apart
    int some; // rays
    Jumps jumps;
} Tile;

typedef struct {
    D start[3], direction[3], mu_start[3], mu_direction[3], mm;
    B real; // not beyond the last ray
} Rays;

// One axis of rays to the points (line, ray) of a fan, which lie in a plane of voxel faces where they nearly do.
INLINE void aim(const double fan[4][3], int a, D line, D ray, D *start, D *direction) {
    const D from = fan[0][a], to = ray * fan[3][a] + (line * fan[2][a] + fan[1][a]), plane = rounded(from);
    const B in_plane = (ABS(from - plane) <= (D)SNAP) & (ABS(to - plane) <= (D)SNAP);
    *start = in_plane ? plane : from;
    *direction = (in_plane | (ABS(to - *start) <= (D)SNAP)) ? (D)0 : to - *start;
}

INLINE void aim_fan(const Fan *fan, D number, const int own, Rays *r) {
    const D line = whole((number + 0.5) * (1.0 / fan->rays)), ray = number - line * fan->rays;
    D squared = 0;
    EACH_AXIS(a) {
        aim(fan->volume, a, line, ray, &r->start[a], &r->direction[a]);
        if (own) aim(fan->mu, a, line, ray, &r->mu_start[a], &r->mu_direction[a]);
        const D mm = ray * fan->world[2][a] + (line * fan->world[1][a] + fan->world[0][a]);
        squared += mm * mm;
    }
    r->mm = __builtin_elementwise_sqrt(squared);
}

INLINE void take_listed(const RayList *list, const int64_t first, const int own, Rays *r) {
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

// Moves rays whose ends are no numbers, or too far away for voxels to be told apart, to where they miss.
INLINE void move_aside(D start[3], D direction[3], D *mm) {
    B sound = *mm < (D)NEVER;
    EACH_AXIS(a) sound &= ABS(start[a]) + ABS(direction[a]) < (D)FAR;
    EACH_AXIS(a) start[a] = sound ? start[a] : (D)-1;
    EACH_AXIS(a) direction[a] = (sound & (ABS(direction[a]) > (D)SNAP)) ? direction[a] : (D)0;
    *mm = sound ? *mm : (D)0;
}

// Alpha where rays enter and leave a lattice, in all and axis by axis. Where they miss it, enter >= leave.
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

// The way from alpha `enter` on, where t is 0 at `begin` and 1 after `span`. Returns how many planes are crossed at
// most.
//
// Why a voxel's index never leaves the lattice: from the first voxel, `room` planes can be crossed. Plane k, counted
// from 0, is crossed at fl(t_first + k t_step), which does not fall with k, for rounding keeps order, and only at a t
// of at most t_exit, which is below fl(t_first + room t_step): so k < room. The margin covers that this may be rounded
// once here, twice there.
INLINE D set_out(Way *way, const Lattice *lattice, const D start[3], const D direction[3], B hits, D enter, D begin,
                 D span) {
    D crossings = 0, crossed[3];
    const D per_span = 1 / span;
    way->voxel = 0;
    way->t_exit = 1;
    int64_t stride = 1;
    UNROLLED for (int a = 2; a >= 0; stride *= lattice->n[a--]) {
        const D last = lattice->n[a] - 1;
        const D voxel = whole(MAX(MIN(enter * direction[a] + start[a], last), (D)0));
        const B up = direction[a] > (D)0, crosses = hits & (direction[a] != (D)0);
        const D inverse = 1 / (crosses ? direction[a] : (D)1), room = up ? last - voxel : voxel;
        const D t_first = ((voxel + (up ? (D)1 : (D)0) - start[a]) * inverse - begin) * per_span;
        const D t_step = ABS(inverse) * per_span;
        crossed[a] = crosses ? whole(MAX(MIN((1 - t_first) / t_step + 1, room), (D)0)) : (D)0;
        crossings += crossed[a];
        way->t_first[a] = AS(F, crosses ? MAX(MIN(t_first, (D)NEVER), (D)-NEVER) : (D)NEVER);
        way->t_step[a] = AS(F, crosses ? MIN(t_step, (D)NEVER) : (D)0);
        way->k[a] = 1;
        way->stride[a] = AS(I, up ? (D)stride : (D)-stride);
        way->voxel += AS(I, voxel) * (I)stride;
        const F t_wall = MIN(way->t_first[a] + AS(F, room) * way->t_step[a], (F)NEVER);
        const F margin = MAX(ABS(t_wall) * (F)(sizeof(REAL) == 8 ? 1e-15 : 3e-7), (F)(1 / NEVER));
        way->t_exit = MIN(way->t_exit, t_wall - margin);
    }
    I idle; // lanes that miss have a voxel each, so that they do not wait for each other
    EACH_LANE(i) idle[i] = i < stride ? i : 0;
    way->voxel = AS(I, hits) ? way->voxel : idle;
    D ahead = 0; // about that of the middle lane for all: it is only sent for
    EACH_AXIS(a) ahead += whole(crossed[a] * (TURN / MAX(crossings, (D)1)) + 0.5) * AS(D, way->stride[a]);
    way->ahead = (int64_t)ahead[LANES / 2];
    return crossings;
}

// 1 for the axis of a face, the first of them at an edge.
INLINE void exclusive(I face[3]) {
    face[1] &= ~face[0];
    face[2] &= ~(face[0] | face[1]);
}

INLINE void find_faces(Way *way, B hits, D enter, D leave, const D in[3], const D out[3]) {
    EACH_AXIS(a) {
        way->into[a] = AS(I, hits & (enter > (D)0) & (in[a] == enter));
        way->out[a] = AS(I, hits & (leave < (D)1) & (out[a] == leave));
    }
    exclusive(way->into);
    exclusive(way->out);
}

// Element i of indices, which are never negative: two at a time, for each way out of a vector register costs.
typedef uint64_t Pairs __attribute__((ext_vector_type(LANES * sizeof(REAL) / 8)));
#define INDEX(pairs, i) (sizeof(REAL) == 8 ? pairs[i] : (i) % 2 ? pairs[(i) / 2] >> 32 : pairs[(i) / 2] & 0xffffffff)

INLINE F gather(const REAL *voxels, I index) {
#if LEVEL == 2 // has an instruction for it that is worth while
    return sizeof(REAL) == 8 ? (F)_mm512_i64gather_pd((__m512i)index, voxels, 8)
                             : (F)_mm512_i32gather_ps((__m512i)index, voxels, 4);
#else
    const Pairs pairs = (Pairs)index;
    F values;
    EACH_LANE(i) values[i] = voxels[INDEX(pairs, i)];
    return values;
#endif
}

// Lane after lane: several may add to the same voxel.
INLINE void scatter_add(REAL *voxels, I index, F values) {
    const Pairs pairs = (Pairs)index;
    EACH_LANE(i) voxels[INDEX(pairs, i)] += values[i];
}

// Send for what is some way ahead of the outer lanes, and of some between where they are far apart.
INLINE void prefetch(const REAL *voxels, I index, const Way *way, int64_t wide, const int writes) {
    const Pairs pairs = (Pairs)index;
    const REAL *later = voxels + way->ahead;
#define FETCH(i) (writes ? __builtin_prefetch(later + INDEX(pairs, i), 1) : __builtin_prefetch(later + INDEX(pairs, i)))
    FETCH(0);
    FETCH(LANES - 1);
    if (wide) UNROLLED for (int i = 5; i < (int)LANES - 1; i += 5) FETCH(i);
}

// What exp(-depth) does over a segment: by series for thin segments, as nearly all are.
#define THIN ((REAL)0.25)
#define TERMS (sizeof(REAL) == 8 ? 12 : 6)

// The mean of exp(-s) for s from 0 to depth, and exp(-depth). Those for twice a depth follow from those for it.
INLINE F mean_left(F depth, F *left) {
    I halved = 0;
    int most = 0;
    for (; ANY(depth > (F)THIN) && most < 1100; most++) {
        const I thick = depth > (F)THIN;
        depth = thick ? depth * (F)0.5 : depth;
        halved -= thick;
    }
    F mean = 1;
    UNROLLED for (int n = TERMS; n > 1; n--) mean = 1 - depth * mean * (F)(1.0 / n);
    *left = 1 - depth * mean;
    for (; most > 0; most--) {
        const I again = halved >= most;
        mean = again ? mean * (1 + *left) * (F)0.5 : mean;
        *left = again ? *left * *left : *left;
    }
    return mean;
}

// The integral of s exp(-s) for s from 0 to depth, by depth^2: 1/2 for a depth of 0. `mean` is that of exp(-s).
INLINE F mean_lag(F depth, F mean) {
    F lag = (F)0.5;
    UNROLLED for (int n = TERMS; n > 0; n--) lag = (F)0.5 - depth * lag * (F)((n + 1.0) / (n * (n + 2.0)));
    return depth > (F)THIN ? (mean - 1 + depth * mean) / depth : lag;
}

INLINE void begin(Tile *tile, const Job *job, const Rays *r, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE;
    Way *way = &tile->way, *mu_way = &tile->mu_way;
    D enter, leave, in[3], out[3], mu_enter, mu_leave, mu_in[3], mu_out[3], crossings;
    clip(&job->volume, r->start, r->direction, &enter, &leave, in, out);
    B hits = (enter < leave) & r->real, hits_mu = hits;
    D begins = hits ? enter : (D)0;
    if (own) {
        clip(&job->mu, r->mu_start, r->mu_direction, &mu_enter, &mu_leave, mu_in, mu_out);
        hits_mu &= (mu_enter < mu_leave) & (mu_enter < leave);
        begins = hits_mu ? MIN(begins, mu_enter) : begins;
    }
    const D span = hits ? leave - begins : (D)1;
    crossings = set_out(way, &job->volume, r->start, r->direction, hits, hits ? enter : (D)0, begins, span);
    const F t_end = MIN(way->t_exit, (F)1);
    hits &= AS(B, t_end > (F)0);
    way->t_exit = AS(I, hits) ? t_end : (F)0;
    EACH_AXIS(a) way->t_first[a] = AS(I, hits) ? way->t_first[a] : (F)NEVER; // no way, no planes
    tile->begin = begins;
    tile->span = hits ? span : (D)0;
    tile->mm = r->mm;
    tile->length = AS(F, tile->span * r->mm);
    tile->state.t = 0;
    if (own) {
        const D from = hits_mu ? mu_enter : (D)0;
        crossings += 4 + set_out(mu_way, &job->mu, r->mu_start, r->mu_direction, hits_mu, from, begins, span);
        way->t_enter = AS(F, hits ? (enter - begins) / span : (D)0);
        mu_way->t_enter = AS(I, hits_mu) ? AS(F, (mu_enter - begins) / span) : (F)NEVER;
        mu_way->t_exit = AS(I, hits_mu) ? MIN(mu_way->t_exit, AS(F, (mu_leave - begins) / span)) : (F)0;
    }
    if (task == BY_ENDS) find_faces(way, hits, enter, leave, in, out);
    if (task == BY_ENDS && own) find_faces(mu_way, hits_mu, mu_enter, mu_leave, mu_in, mu_out);
    const D middle = (enter + leave) * 0.5 * r->direction[2] + r->start[2];
    const double apart = middle[LANES - 1] - middle[0]; // along the axis on which neighbours are neighbours in memory
    tile->wide = apart > 16 || apart < -16;
    const D steps = hits ? crossings + 1 : (D)0;
    tile->steps = (int64_t)__builtin_reduce_max(steps);
}

// The next plane of each axis. Its t is made anew from its number, so that rounding never piles up, and
// ahead of need, so that a step does not wait for it.
#define NEXT_PLANE(way, a) (((way).k[a] - 1) * (way).t_step[a] + (way).t_first[a])

// Cross planes: their axes' next planes and the voxel behind.
INLINE void cross(Way *way, F next[3], const I crossed[3]) {
    EACH_AXIS(a) {
        const F after = way->k[a] * way->t_step[a] + way->t_first[a];
        way->k[a] = ADD_WHERE(crossed[a], way->k[a], (F)1);
        next[a] = crossed[a] ? after : next[a];
        way->voxel = ADD_WHERE(crossed[a], way->voxel, way->stride[a]);
    }
}

// What moving planes does to an integral: each plane by the jump of the value there, times what its t does. Plane k is
// crossed at alpha = (k - s) / d, d the ray from s to its end e: d alpha / ds = (alpha - 1) / d, d alpha / de = -alpha
// / d. Of each axis the sums of its jumps and of jumps times t are therefore all that is needed.
INLINE void add_jump(F jumps[3], F moments[3], I plane[3], F jump, F t) {
    exclusive(plane);
    EACH_AXIS(a) {
        jumps[a] = ADD_WHERE(plane[a], jumps[a], jump);
        moments[a] = ADD_WHERE(plane[a], moments[a], jump * t);
    }
}

// Some steps of a tile. A segment goes from t to t_next through a voxel of the volume, of value f, and one of mu.
INLINE void walk(Tile *tile, const Job *job, int64_t steps, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE, same = attenuation == SAME_LATTICE, attenuated = own || same;
    REAL *const voxels = job->volume.voxels, *const mus = job->mu.voxels, *const gradient = job->gradient;
    const F value = tile->value, length = tile->length;
    Way v = tile->way, m = tile->mu_way;
    State w = tile->state;
    Jumps d;
    if (task == BY_ENDS) d = tile->jumps;
    F next[3], mu_next[3];
    EACH_AXIS(a) next[a] = NEXT_PLANE(v, a);
    if (own) EACH_AXIS(a) mu_next[a] = NEXT_PLANE(m, a);
    for (; steps > 0; steps--) {
        F t_next = MIN(MIN(next[0], next[1]), MIN(next[2], v.t_exit));
        I inside = -1, inside_mu = -1;
        if (own) {
            inside = w.t >= v.t_enter;
            inside_mu = (w.t >= m.t_enter) & (w.t < m.t_exit);
            t_next = inside ? t_next : v.t_enter;
            const F t_mu = MIN(MIN(mu_next[0], mu_next[1]), MIN(mu_next[2], m.t_exit));
            t_next = MIN(t_next, inside_mu ? t_mu : w.t < m.t_enter ? m.t_enter : (F)NEVER);
            t_next = MAX(MIN(t_next, v.t_exit), w.t); // not back: a plane may by rounding lie a hair behind
        }
        const I at = v.voxel, at_mu = own ? m.voxel : at;
        prefetch(voxels, at, &v, tile->wide, task == BACKPROJECT);
        if (attenuated) prefetch(task == BY_MU ? gradient : mus, at_mu, own ? &m : &v, tile->wide, task == BY_MU);
        F f = task == BY_ENDS ? d.f : task == BACKPROJECT ? value : gather(voxels, at);
        if (own) f = inside ? f : (F)0;
        const F part = t_next - w.t; // of the way
        F seen = part, depth = 0, mean = 1, left = 1, mu = 0;
        if (attenuated) {
            mu = task == BY_ENDS ? d.mu : gather(mus, at_mu);
            if (own) mu = inside_mu ? mu : (F)0;
            depth = mu * part * length;
            mean = mean_left(depth, &left);
            seen = part * w.left * mean;
        }
        if (task == FORWARD) w.sum += seen * f;
        if (task == BACKPROJECT) scatter_add(voxels, at, seen * f);
        if (task == BY_MU) { // more mu weakens what lies behind the segment, and half or so of what is in it
            w.behind -= seen * f;
            const F within = f * w.left * part * mean_lag(depth, mean);
            const F change = value * part * (w.behind + within);
            scatter_add(gradient, at_mu, own ? (inside_mu ? change : (F)0) : change);
        }
        if (task == BY_ENDS && attenuated) {
            d.by_length += f * w.left * part * (d.passed * mean + depth * mean_lag(depth, mean));
            d.passed += depth;
            w.behind -= seen * f;
        } else if (task == BY_ENDS) w.sum += seen * f;
        if (attenuated) w.left *= left;
        I crossed[3], mu_crossed[3];
        EACH_AXIS(a) crossed[a] = next[a] <= t_next;
        if (own) EACH_AXIS(a) crossed[a] &= inside, mu_crossed[a] = (mu_next[a] <= t_next) & inside_mu;
        cross(&v, next, crossed);
        if (own) cross(&m, mu_next, mu_crossed);
        if (task == BY_ENDS) {
            I enters = ~inside & (t_next >= v.t_enter), leaves = 0;
            if (own) EACH_AXIS(a) crossed[a] |= enters & v.into[a];
            d.f = gather(voxels, v.voxel);
            if (own) d.f = (inside | enters) ? d.f : (F)0;
            add_jump(d.jumps, d.moments, crossed, attenuated ? w.left * (f - d.f) : f - d.f, t_next);
            if (own) {
                enters = (w.t < m.t_enter) & (t_next >= m.t_enter), leaves = inside_mu & (t_next >= m.t_exit);
                EACH_AXIS(a) mu_crossed[a] |= (enters & m.into[a]) | (leaves & m.out[a]);
            }
            if (attenuated) d.mu = gather(mus, own ? m.voxel : v.voxel);
            if (own) d.mu = ((inside_mu & ~leaves) | enters) ? d.mu : (F)0;
            I *const at_planes = own ? mu_crossed : crossed;
            if (attenuated) add_jump(d.mu_jumps, d.mu_moments, at_planes, w.behind * (mu - d.mu), t_next);
        }
        w.t = t_next;
    }
    tile->state = w;
    EACH_AXIS(a) tile->way.k[a] = v.k[a];
    tile->way.voxel = v.voxel;
    if (own) EACH_AXIS(a) tile->mu_way.k[a] = m.k[a];
    if (own) tile->mu_way.voxel = m.voxel;
    if (task == BY_ENDS) tile->jumps = d;
}

// What is left then: the margin of t_exit, from which no plane is crossed any more.
INLINE void close(Tile *tile) {
    Way *way = &tile->way, *mu_way = &tile->mu_way;
    EACH_AXIS(a) way->t_first[a] = mu_way->t_first[a] = (F)NEVER;
    way->t_exit = tile->length > (F)0 ? (F)1 : (F)0;
    mu_way->t_enter = tile->state.t < mu_way->t_enter ? (F)NEVER : mu_way->t_enter;
    mu_way->t_exit = tile->state.t < mu_way->t_exit ? (F)NEVER : mu_way->t_exit;
}

INLINE F take(const void *numbers, int64_t first, int some) {
    F taken = 0;
    for (int i = 0; i < some; i++) taken[i] = ((const REAL *)numbers)[first + i];
    return taken;
}

// What a tile of `some` rays, `first` and on, begins with at t = 0.
INLINE void start(Tile *tile, const Job *job, int64_t first, int some, const int task, const int attenuation) {
    const int own = attenuation == OWN_LATTICE, attenuated = attenuation != NO_MU;
    tile->state.sum = tile->state.behind = tile->jumps.passed = tile->jumps.by_length = 0;
    tile->state.left = 1;
    if (task == BACKPROJECT || task == BY_MU) {
        tile->value = take(job->values, first, some) * (task == BY_MU ? -tile->length * tile->length : tile->length);
        if (!ANY(tile->value != (F)0)) tile->steps = 0;
    }
    if (task == BY_MU || (task == BY_ENDS && attenuated)) {
        const F integral = take(job->integrals, first, some);
        tile->state.behind = tile->length > (F)0 ? integral / tile->length : (F)0;
    }
    if (task != BY_ENDS) return;
    tile->jumps.f = tile->jumps.mu = 0;
    if (tile->steps) {
        tile->jumps.f = gather(job->volume.voxels, tile->way.voxel);
        if (own) tile->jumps.f = tile->way.t_enter <= (F)0 ? tile->jumps.f : (F)0;
        if (attenuated) tile->jumps.mu = gather(job->mu.voxels, own ? tile->mu_way.voxel : tile->way.voxel);
        if (own) tile->jumps.mu = tile->mu_way.t_enter <= (F)0 ? tile->jumps.mu : (F)0;
    }
    EACH_AXIS(a) {
        const I into_mu = own ? tile->mu_way.into[a] : tile->way.into[a];
        tile->jumps.jumps[a] = tile->way.into[a] ? -tile->jumps.f : (F)0;
        if (attenuated) tile->jumps.mu_jumps[a] = into_mu ? -tile->jumps.mu * tile->state.behind : (F)0;
        tile->jumps.moments[a] = tile->jumps.mu_moments[a] = 0;
    }
}

INLINE void put(double *row, int some, D numbers) {
    for (int i = 0; i < some; i++) row[i] = numbers[i];
}

// Derivatives by start and end of rays, into rows of n numbers.
INLINE void put_by_ends(double *rows, int64_t n, int some, const Tile *t, const F jumps[3], const F moments[3],
                        const D direction[3]) {
    EACH_AXIS(a) {
        const D inverse = direction[a] == (D)0 ? (D)0 : 1 / direction[a];
        const D jump = AS(D, jumps[a]), moment = AS(D, moments[a]) * t->span + jump * t->begin;
        put(rows + a * n, some, (moment - jump) * inverse);
        put(rows + (3 + a) * n, some, -moment * inverse);
    }
}

// Derivatives of a tile of `some` rays, `first` and on, out of n.
INLINE void put_derivatives(Tile *t, const Job *job, const Rays *r, int64_t first, int some, int64_t n,
                            const int attenuation) {
    const int own = attenuation == OWN_LATTICE, attenuated = attenuation != NO_MU;
    double *const rows = job->derivatives + first;
    const D per_mm = t->mm > (D)0 ? 1 / t->mm : (D)0;
    put(rows, some, attenuated ? AS(D, take(job->integrals, first, some)) * per_mm : AS(D, t->state.sum) * t->span);
    const F last = attenuated ? t->state.left * t->jumps.f : t->jumps.f; // the jump at the face by which rays leave
    EACH_AXIS(a) {
        t->jumps.jumps[a] += t->way.out[a] ? last : (F)0;
        t->jumps.moments[a] += t->way.out[a] ? last * t->state.t : (F)0;
    }
    put_by_ends(rows + n, n, some, t, t->jumps.jumps, t->jumps.moments, r->direction);
    if (!attenuated) return;
    EACH_AXIS(a) t->jumps.mu_jumps[a] *= -t->length, t->jumps.mu_moments[a] *= -t->length;
    put_by_ends(rows + 7 * n, n, some, t, t->jumps.mu_jumps, t->jumps.mu_moments, own ? r->mu_direction : r->direction);
    put(rows + 13 * n, some, -AS(D, t->jumps.by_length) * t->span * per_mm);
}

// Lanes of the rays of a fan, or of the list, from number `begin` on.
INLINE void aim_tile(const Job *job, const Fan *fan, int64_t begin, int64_t count, const int own, Rays *r) {
    D number;
    EACH_LANE(i) number[i] = (double)(begin + i);
    if (fan) aim_fan(fan, number, own, r);
    else take_listed(&job->list, begin, own, r);
    r->real = number < (D)count;
    move_aside(r->start, r->direction, &r->mm);
    if (own) move_aside(r->mu_start, r->mu_direction, &r->mm);
}

// The rays of a fan, or of the list, whose first is ray `row` out of n.
INLINE void trace_bundle(const Job *job, const Fan *fan, int64_t count, int64_t row, int64_t n, const int task,
                         const int attenuation) {
    const int own = attenuation == OWN_LATTICE, width = LANES;
    Tile tiles[TILES];
    Rays rays;
    for (int64_t begins = 0; begins < count; begins += TILES * width) {
        const int64_t rest = count - begins, n_tiles = rest < TILES * width ? (rest + width - 1) / width : TILES;
        int64_t longest = 0;
        for (int i = 0; i < n_tiles; i++) {
            const int some = tiles[i].some = rest - i * width < width ? rest - i * width : width;
            aim_tile(job, fan, begins + i * width, count, own, &rays);
            begin(tiles + i, job, &rays, task, attenuation);
            start(tiles + i, job, row + begins + i * width, some, task, attenuation);
            longest = tiles[i].steps > longest ? tiles[i].steps : longest;
        }
        for (int64_t done = 0; done < longest + TURN; done += TURN)
            for (int i = 0; i < n_tiles; i++) {
                const int64_t steps = tiles[i].steps - done;
                if (!tiles[i].steps || steps <= -TURN) continue;
                if (steps <= 0) close(tiles + i);
                walk(tiles + i, job, steps > TURN ? TURN : steps > 0 ? steps : 1, task, attenuation);
            }
        for (int i = 0; i < n_tiles && (task == FORWARD || task == BY_ENDS); i++) {
            const int some = tiles[i].some;
            const int64_t first = row + begins + i * width;
            if (task == FORWARD) {
                const F integral = AS(F, AS(D, tiles[i].state.sum) * tiles[i].span * tiles[i].mm);
                for (int j = 0; j < some; j++) ((REAL *)job->values)[first + j] = integral[j];
            } else {
                aim_tile(job, fan, begins + i * width, count, own, &rays); // anew: to keep them takes longer
                put_derivatives(tiles + i, job, &rays, first, some, n, attenuation);
            }
        }
    }
}

INLINE void trace(const Job *job, const int task, const int attenuation) {
    int64_t n = job->list.count, row = 0;
    for (int64_t f = 0; f < job->n_fans; f++) n += job->fans[f].lines * job->fans[f].rays;
    for (int64_t f = 0; f < (job->n_fans ? job->n_fans : 1); f++) {
        const Fan *fan = job->n_fans ? job->fans + f : 0;
        const int64_t count = fan ? fan->lines * fan->rays : n;
        trace_bundle(job, fan, count, row, n, task, attenuation);
        row += count;
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
