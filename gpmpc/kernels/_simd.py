"""Eight float64 numbers at once, for loops that LLVM's vectoriser cuts badly: short, triangular, or with several sums.

A value of type ``Lanes`` is a vector register of 512 bits, or two or four smaller ones where the processor has no such.
``+``, ``-`` and ``*`` work entry by entry, also with a float. A product that is added to something is rounded once
where the processor can. Everything here is for compiled code only; arrays are contiguous and float64, and only
``load_some`` looks at their length.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from gpmpc.compiled import inline_njit

_WIDTH = 8

_VECTOR = ir.VectorType(ir.DoubleType(), _WIDTH)
_INTEGERS = ir.VectorType(ir.IntType(64), _WIDTH)
_FLAGS = ("contract", "nsz")  # not "reassoc": it would cancel the constant that rounds in ``exp``


class Lanes(types.Type):
    """numba's type of eight numbers."""

    def __init__(self):
        super().__init__(name="Lanes")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, _VECTOR)


LANES = Lanes()


def _define(function: Callable[..., Any]) -> Any:
    """Makes an intrinsic, which compiled code calls without the first argument."""
    return intrinsic(function)


def _constant(value, kind=_VECTOR):
    return ir.Constant(kind, [value] * _WIDTH)


def _spread(builder, value, kind=_VECTOR):
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), [0] * _WIDTH))


def _pointer(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _call(builder, name, *vectors):
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(vectors))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), vectors)


def _define_operator(function, instruction):
    """Defines a Python operator between Lanes, and between Lanes and a float."""

    @type_callable(function)
    def type_operator(context):
        def typer(left, right):
            operands = {left, right}
            return LANES if LANES in operands and operands <= {LANES, types.float64} else None

        return typer

    def generate(context, builder, signature, arguments):
        pairs = zip(arguments, signature.args, strict=True)
        operands = [value if kind == LANES else _spread(builder, value) for value, kind in pairs]
        return getattr(builder, instruction)(*operands, flags=_FLAGS)

    for kinds in ((LANES, LANES), (LANES, types.float64), (types.float64, LANES)):
        lower_builtin(function, *kinds)(generate)


_define_operator(operator.add, "fadd")
_define_operator(operator.sub, "fsub")
_define_operator(operator.mul, "fmul")


@_define
def zeros(typing_context):
    """Eight zeros."""

    def generate(context, builder, signature, arguments):
        return _constant(0.0)

    return LANES(), generate


@_define
def load(typing_context, array, index):
    """The entries ``array[index : index + 8]``."""

    def generate(context, builder, signature, arguments):
        return builder.load(_pointer(context, builder, signature.args[0], *arguments), align=8)

    return LANES(array, types.intp), generate


@_define
def load_some(typing_context, array, index):
    """The entries ``array[index : index + 8]``; zeros where the array has ended."""

    def generate(context, builder, signature, arguments):
        place = _pointer(context, builder, signature.args[0], *arguments)
        size = context.make_array(signature.args[0])(context, builder, arguments[0]).nitems
        left = _spread(builder, builder.sub(size, arguments[1]), _INTEGERS)
        present = builder.icmp_signed("<", ir.Constant(_INTEGERS, list(range(_WIDTH))), left)
        kind = ir.FunctionType(_VECTOR, [place.type, ir.IntType(32), present.type, _VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8f64.p0v8f64")
        return builder.call(function, [place, ir.IntType(32)(8), present, _constant(0.0)])

    return LANES(array, types.intp), generate


@_define
def store(typing_context, array, index, values):
    """``array[index : index + 8] = values``."""

    def generate(context, builder, signature, arguments):
        builder.store(arguments[2], _pointer(context, builder, signature.args[0], *arguments[:2]), align=8)
        return context.get_dummy_value()

    return types.none(array, types.intp, LANES), generate


@_define
def lane(typing_context, values, index):
    """One of the eight numbers."""

    def generate(context, builder, signature, arguments):
        return builder.extract_element(arguments[0], arguments[1])

    return types.float64(LANES, types.intp), generate


@_define
def rotate(typing_context, values, distance):
    """The entries rotated by a distance that is known when compiling."""
    if not isinstance(distance, types.IntegerLiteral):
        raise TypingError("the distance must be a literal")
    order = [(i + distance.literal_value) % _WIDTH for i in range(_WIDTH)]

    def generate(context, builder, signature, arguments):
        mask = ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), order)
        return builder.shuffle_vector(arguments[0], arguments[0], mask)

    return LANES(LANES, distance), generate


@_define
def larger(typing_context, values, others):
    """Entry by entry the larger one of ``values`` and ``|others|``; NaN in ``others`` is passed over."""

    def generate(context, builder, signature, arguments):
        size = _call(builder, "llvm.fabs.v8f64", arguments[1])
        return builder.select(builder.fcmp_ordered(">", size, arguments[0]), size, arguments[0])

    return LANES(LANES, LANES), generate


@_define
def clip(typing_context, values, low, high):
    """The entries, not below ``low`` and not above ``high``; NaN stays."""

    def generate(context, builder, signature, arguments):
        x, low, high = arguments[0], _spread(builder, arguments[1]), _spread(builder, arguments[2])
        x = builder.select(builder.fcmp_ordered("<", x, low), low, x)
        return builder.select(builder.fcmp_ordered(">", x, high), high, x)

    return LANES(LANES, types.float64, types.float64), generate


@_define
def any_nonzero(typing_context, values):
    """Whether an entry is not zero, as NaN is not."""

    def generate(context, builder, signature, arguments):
        nonzero = builder.fcmp_unordered("!=", arguments[0], _constant(0.0))
        return builder.icmp_unsigned("!=", builder.bitcast(nonzero, ir.IntType(_WIDTH)), ir.IntType(_WIDTH)(0))

    return types.boolean(LANES), generate


@_define
def power_of_two(typing_context, shifted):
    """2^k for whole numbers k from -1022 to 1023, given as k + ``_SHIFT``."""

    def generate(context, builder, signature, arguments):
        bits = builder.shl(builder.bitcast(arguments[0], _INTEGERS), _constant(52, _INTEGERS))
        return builder.bitcast(bits, _VECTOR)

    return LANES(LANES), generate


@_define
def use_widest_registers(typing_context):
    """Lets LLVM use registers of 512 bits in the calling function; left alone it stops at 256 (1.6 times slower here).

    A frame pointer lets it put vectors that find no register on cache lines of their own. llvmlite knows neither
    attribute by name, hence ``set.add``; ``tests/kernels`` looks whether they arrive.
    """

    def generate(context, builder, signature, arguments):
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        set.add(builder.function.attributes, '"frame-pointer"="all"')
        return context.get_dummy_value()

    return types.none(), generate


@inline_njit
def total(values):
    """The sum of eight numbers."""
    values = values + rotate(values, 4)
    values = values + rotate(values, 2)
    return lane(values, 0) + lane(values, 1)


@inline_njit
def largest(values):
    """The largest size among eight numbers."""
    values = larger(values, rotate(values, 4))
    values = larger(values, rotate(values, 2))
    return max(lane(values, 0), lane(values, 1))


# exp (Cody and Waite, 1980): x = k ln 2 + r with |r| <= ln(2)/2, exp(x) = 2^k exp(r). Adding _SHIFT leaves k in the
# lowest bits, biased as an exponent is. expm1(r) = r + r^2 g(r) with a polynomial g of degree 9, interpolated at the
# points of Chebyshev: 4e-17 relative to expm1. No branch and no table.

_SHIFT = 6755399441055744.0 + 1023.0  # 1.5 * 2^52, and the bias of the exponent
_PER_LN2 = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.6931471805599453, 2.3190468138462996e-17
NEAR_ZERO = 0.34  # below ln(2)/2: k = 0


@inline_njit
def expm1_near_zero(x):
    """The exponential less one for |x| <= ln(2)/2, to 2e-16; also of a single float."""
    g = x * 2.510038319586702e-08 + 2.7620085455018414e-07
    g = g * x + 2.7557268464831627e-06
    g = g * x + 2.4801521302241082e-05
    g = g * x + 0.00019841269863050506
    g = g * x + 0.001388888891720967
    g = g * x + 0.008333333333330063
    g = g * x + 0.041666666666624136
    g = g * x + 0.16666666666666669
    g = g * x + 0.5000000000000001
    return g * (x * x) + x


@inline_njit
def expm1(x):
    """The exponential less one to 3e-16 + 3.4e-17 |x|, without the low part of ln 2; constant from x = 300 on."""
    x = clip(x, -60.0, 300.0)
    shifted = x * _PER_LN2 + _SHIFT
    r = x - (shifted - _SHIFT) * _LN2_HIGH
    scale = power_of_two(shifted)
    return expm1_near_zero(r) * scale + (scale - 1.0)


@inline_njit
def exp(x):
    """The exponential to 3e-16; 2^k is applied in two halves, so that results reach down to the subnormal numbers."""
    x = clip(x, -750.0, 720.0)
    k = (x * _PER_LN2 + _SHIFT) - _SHIFT
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    shifted = k * 0.5 + _SHIFT
    rest = (k - (shifted - _SHIFT)) + _SHIFT
    return (expm1_near_zero(r) + 1.0) * power_of_two(shifted) * power_of_two(rest)
