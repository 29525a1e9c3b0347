// The level of this processor, and calls of the kernels compiled for it.

#include "kernels.h"

// Names of a kernel's versions, level by level, and the thread's mode of floating-point numbers, with denormal numbers as 0.
#ifdef __x86_64__
#define EACH(name) name##_0_float, name##_0_double, name##_1_float, name##_1_double, name##_2_float, name##_2_double
#define EACH_FLOAT(name) name##_0_float, name##_1_float, name##_2_float
static const char *const names[] = {"SSE2", "AVX2", "AVX-512"};
#define MODE() __builtin_ia32_stmxcsr()
#define SET_MODE(mode) __builtin_ia32_ldmxcsr(mode)
#define DENORMALS_ARE_0 0x8040u
#else // arm64
#define EACH(name) name##_0_float, name##_0_double
#define EACH_FLOAT(name) name##_0_float
static const char *const names[] = {"NEON"};
#define MODE() __builtin_arm_rsr64("fpcr")
#define SET_MODE(mode) __builtin_arm_wsr64("fpcr", mode)
#define DENORMALS_ARE_0 (1u << 24)
#endif

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#pragma clang diagnostic ignored "-Wdll-attribute-on-redeclaration"
#else
#define EXPORT __attribute__((visibility("default")))
#endif

// Denormal numbers take a hundred times as long, and volumes that OSEM empties are full of them: they are 0 while a kernel
// runs. Afterwards the thread has its own mode again.
#define DISPATCH_TO(name, Task, number, ...)                  \
    Kernel##Task __VA_ARGS__;                                \
    EXPORT void name(int64_t level, const Task *job) {       \
        static Kernel##Task *const kernels[] = {__VA_ARGS__}; \
        const __typeof__(MODE()) mode = MODE();              \
        SET_MODE(mode | DENORMALS_ARE_0);                    \
        kernels[number](job);                                \
        SET_MODE(mode);                                      \
    }
#define DISPATCH(name, Task) DISPATCH_TO(name, Task, 2 * level + job->is_double, EACH(name))

typedef void KernelJob(const Job *);
typedef void KernelDepthJob(const DepthJob *);
typedef void KernelPlacesJob(const PlacesJob *);
typedef void KernelPhotonJob(const PhotonJob *);

DISPATCH(forward, Job)
DISPATCH(backproject, Job)
DISPATCH(differentiate, Job)
DISPATCH(differentiate_by_mu, Job)
DISPATCH(voxels_to_cells, DepthJob)
DISPATCH(cells_to_voxels, DepthJob)
DISPATCH(cells_to_pixels, DepthJob)
DISPATCH(pixels_to_cells, DepthJob)
DISPATCH(differentiate_places, DepthJob)
DISPATCH(differentiate_taps, DepthJob)
DISPATCH(take_at, PlacesJob)
DISPATCH(give_at, PlacesJob)
DISPATCH_TO(follow, PhotonJob, level, EACH_FLOAT(follow))
DISPATCH_TO(see, PhotonJob, level, EACH_FLOAT(see))
DISPATCH_TO(see_panel, PhotonJob, level, EACH_FLOAT(see_panel))

EXPORT const char *level_name(int64_t level) {
    return level < (int64_t)(sizeof(names) / sizeof(names[0])) ? names[level] : 0;
}

EXPORT void contract(int64_t numbers[6]) {
    numbers[0] = CONTRACT;
    numbers[1] = sizeof(Job);
    numbers[2] = sizeof(Fan);
    numbers[3] = sizeof(DepthJob);
    numbers[4] = sizeof(PlacesJob);
    numbers[5] = sizeof(PhotonJob);
}

#ifdef __x86_64__
#include <cpuid.h>

// The processor is asked directly: the compiler's functions for this need a runtime that not all shared libraries have.
EXPORT int64_t best_level(void) {
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return 0;
    const unsigned fma = 1u << 12, osxsave = 1u << 27, avx = 1u << 28;
    if ((c & (fma | osxsave | avx)) != (fma | osxsave | avx)) return 0;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0)); // which registers the system saves
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (low & 0x6) != 0x6 || !(b & 1u << 5)) return 0;
    const unsigned avx512 = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31; // F, DQ, BW, VL
    return (b & avx512) == avx512 && (low & 0xe6) == 0xe6 ? 2 : 1;
}
#else
EXPORT int64_t best_level(void) { return 0; }
#endif

#ifdef _WIN32
// Windows calls this function when it loads a library; other systems need none.
int DllMainCRTStartup(void) { return 1; }
#endif
