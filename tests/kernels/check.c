// Runs the kernels without Python: jobs from the file "jobs", what comes of them into the file "results".
//
// A job is its kind, its level, and what the function of that kind reads: numbers and arrays, each padded to 8 bytes.
// test_kernels.py writes and reads the files.

#include "../../core/rays/backends/kernels/kernels.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { RAYS, TAKE, GIVE, PHOTONS };

// Of a bundle of rays. With it come voxels of the volume, voxels of mu if there is mu, the fans or the list's columns, and
// values.
typedef struct {
    int64_t is_double, attenuation, n[3], mu_n[3], n_fans, count;
} Header;

// Arrays of a job. Each ends where memory ends, or begins where it begins, job by job; the address sanitizer and Windows
// get plain ones.
static struct {
    void *base;
    size_t bytes;
} blocks[20];
static int n_blocks, n_jobs;

#if defined(_WIN32) || __has_feature(address_sanitizer)
static void *block(size_t bytes) {
    blocks[n_blocks].base = malloc(bytes + !bytes);
    return memset(blocks[n_blocks++].base, 0, bytes);
}
static void give_back(void) {
    while (n_blocks) free(blocks[--n_blocks].base);
}
#else
#include <sys/mman.h>
static void *block(size_t bytes) {
    const size_t page = 65536, inner = (bytes + page - 1) / page * page;
    char *base = mmap(0, inner + 2 * page, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (base == MAP_FAILED || mprotect(base + page, inner, PROT_READ | PROT_WRITE)) abort();
    blocks[n_blocks].base = base, blocks[n_blocks++].bytes = inner + 2 * page;
    return base + page + (n_jobs % 2 ? 0 : inner - bytes);
}
static void give_back(void) {
    while (n_blocks--) munmap(blocks[n_blocks].base, blocks[n_blocks].bytes);
    n_blocks = 0;
}
#endif

static FILE *jobs, *results;

static void *taken(size_t bytes) {
    char *array = block(bytes), padding[8];
    if (fread(array, 1, bytes, jobs) != bytes) abort();
    fread(padding, 1, -bytes % 8, jobs);
    return array;
}

// Writes what forward, backproject into an empty volume, differentiate and, with mu, differentiate_by_mu give.
static void run_rays(int64_t level) {
    Header header, *h = &header;
    if (!fread(h, sizeof header, 1, jobs)) abort();
    const size_t real = h->is_double ? 8 : 4, voxels = h->n[0] * h->n[1] * h->n[2], count = h->count;
    const size_t mus = h->attenuation ? h->mu_n[0] * h->mu_n[1] * h->mu_n[2] : 0;
    Job job = {.is_double = h->is_double, .attenuation = h->attenuation, .n_fans = h->n_fans};
    memcpy(job.volume.n, h->n, sizeof h->n);
    memcpy(job.mu.n, h->mu_n, sizeof h->mu_n);
    void *const volume = taken(voxels * real), *const empty = block(voxels * real);
    if (mus) job.mu.voxels = taken(mus * real);
    if (h->n_fans) job.fans = taken(h->n_fans * sizeof(Fan));
    else {
        job.list.count = count;
        const double **columns = &job.list.starts;
        for (int i = 0; i < 5; i++)
            if (i < 2 || i == 4 || h->attenuation == OWN_LATTICE) columns[i] = taken((i < 4 ? 3 : 1) * count * 8);
    }
    void *const values = taken(count * real), *const integrals = block(count * real);
    job.volume.voxels = volume, job.values = integrals;
    forward(level, &job);
    fwrite(integrals, real, count, results);
    job.volume.voxels = empty, job.values = values;
    backproject(level, &job);
    fwrite(empty, real, voxels, results);
    const size_t rows = mus ? 14 : 7;
    job.volume.voxels = volume, job.values = 0, job.integrals = integrals, job.derivatives = block(rows * count * 8);
    differentiate(level, &job);
    fwrite(job.derivatives, 8, rows * count, results);
    if (!mus) return;
    job.values = values, job.gradient = block(mus * real);
    differentiate_by_mu(level, &job);
    fwrite(job.gradient, real, mus, results);
}

// With a PlacesJob come the points' numbers, planes, values and matrices; its `seen` and `exponents` are 1 where there shall
// be such arrays. Writes points, values, seen and exponents.
static void run_places(int64_t level, void (*kernel)(int64_t, const PlacesJob *)) {
    PlacesJob job;
    if (!fread(&job, sizeof job, 1, jobs)) abort();
    const size_t real = job.is_double ? 8 : 4, points = job.n[0] * job.n[1] * job.n[2];
    const size_t numbers = job.arrays * job.m[0] * job.m[1] * job.m[2];
    job.points = taken(points * real), job.planes = taken(job.n[2] * real);
    job.values = taken(numbers * real), job.matrices = taken(job.arrays * 160);
    if (job.seen) job.seen = block(points * 4);
    if (job.exponents) job.exponents = block(points * 4);
    kernel(level, &job);
    fwrite(job.points, real, points, results);
    fwrite(job.values, real, numbers, results);
    if (job.seen) fwrite(job.seen, 4, points, results);
    if (job.exponents) fwrite(job.exponents, 4, points, results);
}

// With a PhotonJob come body, tables, photons, modules, shares and cells. Writes the number of collisions, and what is seen.
static void run_photons(int64_t level) {
    PhotonJob job;
    if (!fread(&job, sizeof job, 1, jobs)) abort();
    const size_t voxels = job.n[0] * job.n[1] * job.n[2], tables = MATERIALS * job.energies, momenta = MATERIALS * job.momenta;
    const size_t seen = job.orders * job.windows * job.cells * job.modules, end = job.last;
    job.body = taken(voxels * MATERIALS * 4), job.coefficients = taken(3 * tables * 4);
    job.incoherent = taken(momenta * 4), job.coherent = taken(momenta * 4), job.coherent_until = taken(momenta * 4);
    job.starts = taken((end - job.all_first) * sizeof(Start)), job.holes = taken(job.modules * sizeof(Module));
    job.accepted = taken(job.modules * job.windows * job.energies * 4), job.worth = taken(job.modules * job.energies * 4), job.cell_of = taken(voxels * 4);
    job.collisions = block(job.capacity * sizeof(Collision)), job.seen = block(seen * 4);
    job.followed = block(8), job.n_collisions = block(8);
    if (job.totals) job.totals = block(job.windows * job.modules * 8);
    if (job.spectra) job.spectra = block(job.modules * job.energies * 8);
    int64_t collisions = 0;
    for (job.first = job.all_first; job.first < (int64_t)end; job.first = *job.followed) {
        follow(level, &job), see(level, &job);
        collisions += *job.n_collisions;
    }
    fwrite(&collisions, 8, 1, results);
    fwrite(job.seen, 4, seen, results);
}

static int all(void) {
    int64_t kind_and_level[2];
    jobs = fopen("jobs", "rb"), results = fopen("results", "wb");
    if (!jobs || !results) return 1;
    for (; fread(kind_and_level, sizeof kind_and_level, 1, jobs); n_jobs++) {
        const int64_t level = kind_and_level[1] % (best_level() + 1);
        switch (kind_and_level[0]) {
        case RAYS: run_rays(level); break;
        case TAKE: run_places(level, take_at); break;
        case GIVE: run_places(level, give_at); break;
        default: run_photons(level);
        }
        give_back();
    }
    return fclose(results);
}

#ifdef ENTRY // without the C runtime that calls main, which Zig would have to compile first
void ENTRY(void) { exit(all()); }
#else
int main(void) { return all(); }
#endif
