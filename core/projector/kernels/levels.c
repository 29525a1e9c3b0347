// Which level of processor this is, and the kernels compiled for it.

#include "kernels.h"

#ifdef __x86_64__
#define LEVELS 3
#else
#define LEVELS 1
#endif

#define DECLARE(level)                                                                       \
    void forward_##level##_float(const Job *), forward_##level##_double(const Job *);         \
    void backproject_##level##_float(const Job *), backproject_##level##_double(const Job *); \
    void differentiate_##level##_float(const Job *), differentiate_##level##_double(const Job *); \
    void differentiate_by_mu_##level##_float(const Job *), differentiate_by_mu_##level##_double(const Job *);

typedef void Kernel(const Job *);
#if LEVELS == 3
DECLARE(0) DECLARE(1) DECLARE(2)
#define LEVEL(name, level) {name##_##level##_float, name##_##level##_double}
#define KERNELS(name) {LEVEL(name, 0), LEVEL(name, 1), LEVEL(name, 2)}
static const char *const names[] = {"SSE2", "AVX2", "AVX-512"};
#else
DECLARE(0)
#define KERNELS(name) {{name##_0_float, name##_0_double}}
static const char *const names[] = {"NEON"};
#endif

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#pragma clang diagnostic ignored "-Wdll-attribute-on-redeclaration"
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define DISPATCH(name)                                        \
    EXPORT void name(int64_t level, const Job *job) {         \
        static Kernel *const kernels[LEVELS][2] = KERNELS(name); \
        kernels[level][job->is_double](job);                  \
    }

DISPATCH(forward)
DISPATCH(backproject)
DISPATCH(differentiate)
DISPATCH(differentiate_by_mu)

EXPORT const char *level_name(int64_t level) { return level < LEVELS ? names[level] : 0; }

EXPORT void contract(int64_t numbers[3]) {
    numbers[0] = CONTRACT;
    numbers[1] = sizeof(Job);
    numbers[2] = sizeof(Fan);
}

#if LEVELS == 3
#include <cpuid.h>

// Asked of the processor itself: compilers' own functions for it need a runtime that not all shared libraries have.
EXPORT int64_t best_level(void) {
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d)) return 0;
    const unsigned fma = 1u << 12, osxsave = 1u << 27, avx = 1u << 28;
    if ((c & (fma | osxsave | avx)) != (fma | osxsave | avx)) return 0;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0)); // which registers the system keeps
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (low & 0x6) != 0x6 || !(b & 1u << 5)) return 0;
    const unsigned avx512 = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31; // F, DQ, BW, VL
    return (b & avx512) == avx512 && (low & 0xe6) == 0xe6 ? 2 : 1;
}
#else
EXPORT int64_t best_level(void) { return 0; }
#endif

#ifdef _WIN32
// What Windows calls when it loads a library; elsewhere nothing needs to be there.
int DllMainCRTStartup(void) { return 1; }
#endif
