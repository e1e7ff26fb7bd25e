"""Problem: exp and expm1 of whole arrays inside compiled loops, where the library's functions are called one by one.

Cody and Waite (1980): x = k ln 2 + r with |r| <= ln(2)/2, exp(x) = 2^k exp(r); k comes from adding 1.5 * 2^52, which
leaves round(x / ln 2) in the lowest bits, and 2^k from shifting these bits into the exponent. expm1(r) = r + r^2 g(r)
with a polynomial g of degree 9 (interpolation at Chebyshev's points: 4e-17 relative to expm1). No branch, no table:
LLVM turns a loop over a slice into full vectors. Relative errors: below 2e-16 for exp, 3e-16 + 3.4e-17 |x| for the
expm1 of ``gpmpc.kernels.block``, which takes its constants from here.
"""

import contextlib

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from gpmpc.compiled import njit_noalloc

EXACT = frozenset({"contract", "nsz"})  # "reassoc" would cancel the constant that rounds

ROUNDER = 6755399441055744.0  # 1.5 * 2^52
ROUNDER_BITS = 0x4338000000000000
BIASED_ROUNDER = ROUNDER + 1023.0  # with the bias of the exponent
PER_LN2 = 1.4426950408889634
LN2_HIGH, LN2_LOW = 0.6931471805599453, 2.3190468138462996e-17
G0, G1, G2, G3, G4 = (
    0.5000000000000001,
    0.16666666666666669,
    0.041666666666624136,
    0.008333333333330063,
    0.001388888891720967,
)
G5, G6, G7, G8, G9 = (
    0.00019841269863050506,
    2.4801521302241082e-05,
    2.7557268464831627e-06,
    2.7620085455018414e-07,
    2.510038319586702e-08,
)
SATURATED = -60.0  # expm1 is -1 from here on
LARGE = 300.0  # the capped expm1 stays here
NEAR_ZERO = 0.34  # below ln(2)/2: k = 0


@intrinsic
def widest(typing_context):
    """Lets LLVM use vectors of 512 bits in the calling function; left alone it stops at 256 (1.6 times slower here).

    A frame pointer lets it put those that find no register on cache lines of their own.
    """

    def generate(context, builder, signature, arguments):
        with contextlib.suppress(TypeError, AttributeError):  # a preference: do without it where llvmlite changes
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
            set.add(builder.function.attributes, '"frame-pointer"="all"')
        return context.get_dummy_value()

    return types.none(), generate


@intrinsic
def inlined(typing_context):
    """Makes LLVM copy the calling function to where it is called: blocks of vectors then stay in registers."""

    def generate(context, builder, signature, arguments):
        with contextlib.suppress(TypeError, AttributeError):
            set.add(builder.function.attributes, "alwaysinline")
        return context.get_dummy_value()

    return types.none(), generate


@intrinsic
def bits_of(typing_context, number):
    """The 64 bits of a float as an integer."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def float_of(typing_context, bits):
    """The float that has these 64 bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


@njit_noalloc(fastmath=EXACT)
def reduced_expm1(r):
    """expm1(r) for |r| <= ln(2)/2."""
    g = G9 * r + G8
    g = g * r + G7
    g = g * r + G6
    g = g * r + G5
    g = g * r + G4
    g = g * r + G3
    g = g * r + G2
    g = g * r + G1
    g = g * r + G0
    return g * (r * r) + r


@njit_noalloc(fastmath=EXACT)
def exp(x):
    """The exponential of any x; 2^k is applied in two halves, so that results reach down to the subnormal numbers."""
    x = -750.0 if x < -750.0 else x
    x = 720.0 if x > 720.0 else x
    rounded = x * PER_LN2 + ROUNDER
    k = rounded - ROUNDER
    r = (x - k * LN2_HIGH) - k * LN2_LOW
    power = bits_of(rounded) - ROUNDER_BITS
    half = power >> 1
    return (reduced_expm1(r) + 1.0) * float_of((half + 1023) << 52) * float_of((power - half + 1023) << 52)


@njit_noalloc
def exp_all(x):
    """Replaces x by exp(x)."""
    widest()
    for j in range(len(x)):
        x[j] = exp(x[j])
