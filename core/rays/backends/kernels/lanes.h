// Vectors for a tile, several rays at once: a variable of these types has a lane, a number, for each ray. Clang compiles the
// vectors to those of the processor.

#pragma once

#if LEVEL == 2
#define LANES (64 / sizeof(REAL))
#else
#define LANES (32 / sizeof(REAL))
#endif

typedef REAL F __attribute__((ext_vector_type(LANES)));   // numbers of a traversal: float or double
typedef double D __attribute__((ext_vector_type(LANES))); // numbers of its set-up
typedef __typeof__((F)0 < (F)0) I; // whole numbers, and true (-1) or false (0), as wide as F
typedef __typeof__((D)0 < (D)0) B; // as wide as D

#define INLINE static inline __attribute__((always_inline))
#define UNROLLED _Pragma("clang loop unroll(full)")
#define EACH_LANE(i) UNROLLED for (int i = 0; i < (int)LANES; i++)
#define EACH_AXIS(a) UNROLLED for (int a = 0; a < 3; a++)

#define MIN(x, y) ((x) < (y) ? (x) : (y))
#define MAX(x, y) ((x) > (y) ? (x) : (y))
#define ABS(x) __builtin_elementwise_abs(x)
#define AS(type, x) __builtin_convertvector(x, type)
#define ANY(mask) __builtin_reduce_or(mask)

// x rounded down; x from 0 to 2^31 - 1.
INLINE D whole(D x) {
    typedef int Int __attribute__((ext_vector_type(LANES)));
    return AS(D, AS(Int, x));
}

// x rounded to the nearest whole number; numbers too large for a fraction stay as they are.
INLINE D rounded(D x) {
    const D shift = 6755399441055744.0; // 1.5 2^52
    return x + shift - shift;
}

// x + amount where a mask is set. AVX-512 has masked additions; elsewhere adding 0 is the shorter way.
#if LEVEL == 2
#define ADD_WHERE(mask, x, amount) ((mask) ? (x) + (amount) : (x))
#else
#define ADD_WHERE(mask, x, amount) ((x) + (__typeof__(x))((mask) & (I)(amount)))
#endif
