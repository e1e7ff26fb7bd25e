#include <float.h>
#if defined(DBL_MANT_DIG) && DBL_MANT_DIG != 53
#error "sums of the GPs need a double of 64 bits"
#endif
/* Digits that are doubled, and tests for numbers that are not finite, do not survive
   sums in another order: inputs were off by the whole range. */
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(_M_FP_FAST)
#error "compile without -ffast-math and the like: sums must stay in their order"
#endif
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "compile without -ffinite-math-only: what is not finite must be seen"
#endif

/* Numbers that depend on the digits. Each is a power of the rounding unit: in float the
   same power of a larger one. */
#if GPMPC_IS_FLOAT
#define REAL(number) number##f
#define SQRT sqrtf
#define EXP expf
#define LOG logf
#define SIN sinf
#define COS cosf
#define TAN tanf
#define ATAN atanf
#define ATAN2 atan2f
#define TANH tanhf
#define POW powf
#define FABS fabsf
#define FMA fmaf
#define ASIN asinf
#define ACOS acosf
#define SINH sinhf
#define COSH coshf
#define ASINH asinhf
#define ACOSH acoshf
#define ATANH atanhf
#define EXPM1 expm1f
#define LOG1P log1pf
#define ERF erff
#define HYPOT hypotf
#define FMOD fmodf
#define COPYSIGN copysignf
#define FLOOR floorf
#define CEIL ceilf
#define ROUND_EVEN rintf
#define LARGEST FLT_MAX
#define TINY REAL(1e-37)
#define UNDEFINED REAL(1e37)
#define TOLERATED REAL(1e-7)
#define NEGLIGIBLE REAL(3e-12)
#define NOISE REAL(9e-7)
#define LATER REAL(1.4e-5)
#define FINE REAL(1e-8)
#define FINEST REAL(1e-10)
#define DOUBT REAL(1.3e-3)
#define ILL REAL(3.5e-2)
#define DEPENDENT_SQUARE REAL(5e-6)
#define DOUBTFUL_SQUARE REAL(1.7e-2)
#define CANDIDATE_PIVOT REAL(1e-4)
#define ROUNDING_OF_BOUNDS REAL(2.3e-7)
#define ROUNDING_OF_SUMS REAL(2e-6)
#define HOPELESS REAL(8e-4)
#define NO_RATE REAL(5e-6)
#define ROUNDING_OF_DATA REAL(5e-7)
#define DEPENDENT_DISTANCES {REAL(5e-7), REAL(1.5e-6), REAL(4e-6), REAL(3e-5)}
#define GUESS_MARGIN REAL(500.0)
#define CONVERGED REAL(1e-9)
#define UNNOTICED REAL(1e-8)
#define ROW_RESIDUAL REAL(1e-4)
#define PIVOT_ROUNDING REAL(1.2e-7)
#define LARGEST_GROWTH REAL(300.0)
#define KEPT REAL(1e-5) /* by how much a bound may be missed that counts as kept */
#else
#define REAL(number) number
#define SQRT sqrt
#define EXP exp
#define LOG log
#define SIN sin
#define COS cos
#define TAN tan
#define ATAN atan
#define ATAN2 atan2
#define TANH tanh
#define POW pow
#define FABS fabs
#define FMA fma
#define ASIN asin
#define ACOS acos
#define SINH sinh
#define COSH cosh
#define ASINH asinh
#define ACOSH acosh
#define ATANH atanh
#define EXPM1 expm1
#define LOG1P log1p
#define ERF erf
#define HYPOT hypot
#define FMOD fmod
#define COPYSIGN copysign
#define FLOOR floor
#define CEIL ceil
#define ROUND_EVEN rint
#define LARGEST DBL_MAX
#define TINY REAL(1e-300)
#define UNDEFINED REAL(1e300)
#define TOLERATED REAL(2e-14)
#define NEGLIGIBLE REAL(1e-26)
#define NOISE REAL(2e-14)
#define LATER REAL(1e-11)
#define FINE REAL(2e-10)
#define FINEST REAL(1e-15)
#define DOUBT REAL(3e-7)
#define ILL REAL(5e-4)
#define DEPENDENT_SQUARE REAL(1e-12)
#define DOUBTFUL_SQUARE REAL(1e-4)
#define CANDIDATE_PIVOT REAL(1e-9)
#define ROUNDING_OF_BOUNDS REAL(1e-15)
#define ROUNDING_OF_SUMS REAL(4e-15)
#define HOPELESS REAL(1e-7)
#define NO_RATE REAL(1e-12)
#define ROUNDING_OF_DATA REAL(1e-14)
#define DEPENDENT_DISTANCES {REAL(1e-14), REAL(1e-13), REAL(1e-12), REAL(1e-10)}
#define GUESS_MARGIN REAL(1e6)
#define CONVERGED REAL(1e-12)
#define UNNOTICED REAL(1e-16)
#define ROW_RESIDUAL REAL(1e-9)
#define PIVOT_ROUNDING REAL(2.3e-16)
#define LARGEST_GROWTH REAL(3e7)
#define KEPT REAL(1e-5)
#endif
#define ABSENT REAL(1e20)  /* a bound of this size or more is none */
#define UNSTABLE_GROWTH REAL(3e7) /* LARGEST_GROWTH of doubles */
#define FEASIBLE REAL(1e-3) /* by how much a suboptimal plan may miss hard bounds */
