"""Eight float64 numbers at once, for loops that LLVM's vectoriser cuts badly.

These are loops that are short, triangular, or have several sums. A value of numba's
type ``Lanes`` is a vector register of 512 bits, or two or four smaller ones where the
processor has no such. ``+``, ``-``, ``*`` and ``/`` work entry by entry, also with a
float; a product that is added to something is rounded once where the processor can.

    for j in range(0, len(x), 8):
        store(y, j, exp(load(x, j) * 2.0) + load(y, j))

The file goes from numba's type over the operators and the functions that are a few
instructions each, written in LLVM's language (``@_define``), to exponentials, sine and
cosine, which are made of these. Everything here is for compiled code only; arrays are
contiguous and float64, and only ``load_some`` looks at their length.
"""

import inspect
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import (
    intrinsic,
    lower_builtin,
    models,
    register_model,
    type_callable,
)

from gpmpc._compiled import inline_njit

_WIDTH = 8

_VECTOR = ir.VectorType(ir.DoubleType(), _WIDTH)
_INTEGERS = ir.VectorType(ir.IntType(64), _WIDTH)
# not "reassoc": it would cancel the constant that rounds in ``exp``
_FLAGS = ("contract", "nsz")


class Lanes(types.Type):
    """numba's type of eight numbers."""

    def __init__(self):
        super().__init__(name="Lanes")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, _VECTOR)


LANES = Lanes()


def _define(result: types.Type, *operands: Any) -> Callable[[Callable], Any]:
    """Makes a function of compiled code from one that writes LLVM's instructions.

    The written function takes the builder and the operands' values; compiled code calls
    it without the builder, with operands of the given types, and gets a ``result``.
    ``types.Array`` stands for any array.
    """

    def make(write: Callable) -> Any:
        def typed(typing_context, *argument_types):
            operand_types = [
                argument if operand is types.Array else operand
                for operand, argument in zip(operands, argument_types, strict=True)
            ]

            def generate(context, builder, signature, arguments):
                values = []
                for kind, argument in zip(operand_types, arguments, strict=True):
                    if isinstance(kind, types.Array):
                        argument = context.make_array(kind)(context, builder, argument)
                    values.append(argument)
                value = write(builder, *values)
                return context.get_dummy_value() if value is None else value

            return result(*operand_types), generate

        typed.__name__ = write.__name__
        typed.__doc__ = write.__doc__
        function: Any = typed
        # numba reads from it the names of the arguments after the first
        function.__signature__ = inspect.signature(write)
        return intrinsic(function)

    return make


def _constant(value, kind=_VECTOR):
    return ir.Constant(kind, [value] * _WIDTH)


def _spread(builder, value, kind=_VECTOR):
    first = builder.insert_element(
        ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0)
    )
    return builder.shuffle_vector(
        first, first, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), [0] * _WIDTH)
    )


def _rotate(builder, values, distance):
    order = [(i + distance) % _WIDTH for i in range(_WIDTH)]
    return builder.shuffle_vector(
        values, values, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), order)
    )


def _pointer(builder, array, index):
    return builder.bitcast(builder.gep(array.data, [index]), _VECTOR.as_pointer())


def _larger(builder, values, others):
    kind = ir.FunctionType(_VECTOR, [_VECTOR])
    size = builder.call(
        cgutils.get_or_insert_function(builder.module, kind, "llvm.fabs.v8f64"),
        [others],
    )
    return builder.select(builder.fcmp_ordered(">", size, values), size, values)


def _first_two(builder, values):
    return [builder.extract_element(values, ir.IntType(64)(i)) for i in range(2)]


def _define_operator(function, instruction):
    """Defines a Python operator between Lanes, and between Lanes and a float."""

    @type_callable(function)
    def type_operator(context):
        def typer(left, right):
            operands = {left, right}
            if LANES in operands and operands <= {LANES, types.float64}:
                return LANES
            return None

        return typer

    def generate(context, builder, signature, arguments):
        pairs = zip(arguments, signature.args, strict=True)
        operands = [
            value if kind == LANES else _spread(builder, value) for value, kind in pairs
        ]
        return getattr(builder, instruction)(*operands, flags=_FLAGS)

    for kinds in ((LANES, LANES), (LANES, types.float64), (types.float64, LANES)):
        lower_builtin(function, *kinds)(generate)


_define_operator(operator.add, "fadd")
_define_operator(operator.sub, "fsub")
_define_operator(operator.mul, "fmul")
_define_operator(operator.truediv, "fdiv")


@_define(LANES)
def zeros(builder):
    """Returns eight zeros."""
    return _constant(0.0)


@_define(LANES, types.Array, types.intp)
def load(builder, array, index):
    """Returns ``array[index : index + 8]``."""
    return builder.load(_pointer(builder, array, index), align=8)


@_define(LANES, types.Array, types.intp)
def load_some(builder, array, index):
    """Returns ``array[index : index + 8]``, and zeros where the array has ended."""
    place = _pointer(builder, array, index)
    count = _spread(builder, builder.sub(array.nitems, index), _INTEGERS)
    lanes = ir.Constant(_INTEGERS, list(range(_WIDTH)))
    present = builder.icmp_signed("<", lanes, count)
    kind = ir.FunctionType(_VECTOR, [place.type, ir.IntType(32), present.type, _VECTOR])
    function = cgutils.get_or_insert_function(
        builder.module, kind, "llvm.masked.load.v8f64.p0v8f64"
    )
    return builder.call(function, [place, ir.IntType(32)(8), present, _constant(0.0)])


@_define(types.none, types.Array, types.intp, LANES)
def store(builder, array, index, values):
    """Writes ``array[index : index + 8] = values``."""
    builder.store(values, _pointer(builder, array, index), align=8)


@_define(LANES, LANES, LANES)
def larger_magnitude(builder, values, others):
    """Returns the larger ones of ``values`` and ``|others|``, entry by entry.

    The magnitude is that of ``others`` alone: ``values`` are a largest magnitude so
    far, or zeros. NaN in ``others`` is passed over.
    """
    return _larger(builder, values, others)


@_define(LANES, LANES, types.float64, types.float64)
def clip(builder, values, low, high):
    """Returns the entries, not below ``low`` and not above ``high``; NaN stays."""
    low = _spread(builder, low)
    high = _spread(builder, high)
    values = builder.select(builder.fcmp_ordered("<", values, low), low, values)
    return builder.select(builder.fcmp_ordered(">", values, high), high, values)


@_define(types.boolean, LANES)
def any_nonzero(builder, values):
    """Returns whether an entry is not zero, as NaN is not."""
    nonzero = builder.fcmp_unordered("!=", values, _constant(0.0))
    return builder.icmp_unsigned(
        "!=", builder.bitcast(nonzero, ir.IntType(_WIDTH)), ir.IntType(_WIDTH)(0)
    )


@_define(LANES, LANES)
def power_of_two(builder, shifted):
    """Returns 2^k of whole numbers k from -1022 to 1023, given as k + ``_SHIFT``."""
    bits = builder.shl(builder.bitcast(shifted, _INTEGERS), _constant(52, _INTEGERS))
    return builder.bitcast(bits, _VECTOR)


@_define(types.none)
def use_widest_registers(builder):
    """Lets LLVM use registers of 512 bits in the calling function.

    Left alone it stops at 256, which is 1.6 times slower here. A frame pointer lets it
    put vectors that find no register on cache lines of their own. llvmlite knows
    neither attribute by name, hence ``set.add``; ``tests/kernels`` looks whether they
    arrive.
    """
    set.add(builder.function.attributes, '"prefer-vector-width"="512"')
    set.add(builder.function.attributes, '"frame-pointer"="all"')


@_define(types.float64, LANES)
def total(builder, values):
    """Returns the sum of eight numbers."""
    for distance in (4, 2):
        values = builder.fadd(values, _rotate(builder, values, distance), flags=_FLAGS)
    return builder.fadd(*_first_two(builder, values), flags=("reassoc", *_FLAGS))


@_define(types.float64, LANES)
def largest(builder, values):
    """Returns the largest of eight numbers >= 0, as ``larger_magnitude`` gives them."""
    for distance in (4, 2):
        values = _larger(builder, values, _rotate(builder, values, distance))
    first, second = _first_two(builder, values)
    return builder.select(builder.fcmp_ordered(">", first, second), first, second)


# exp (Cody and Waite, 1980): x = k ln 2 + r with |r| <= ln(2)/2, exp(x) = 2^k exp(r).
# Adding _SHIFT leaves k in the lowest bits, biased as an exponent is. expm1(r) = r +
# r^2 g(r) with a polynomial g of degree 9, interpolated at the points of Chebyshev:
# 4e-17 relative to expm1. No branch and no table.

_SHIFT = 6755399441055744.0 + 1023.0  # 1.5 * 2^52, and the bias of the exponent
_PER_LN2 = 1.4426950408889634
_LN2_HIGH = 0.6931471805599453
_LN2_LOW = 2.3190468138462996e-17
NEAR_ZERO = 0.34  # below ln(2)/2: k = 0


@inline_njit
def expm1_near_zero(x):
    """Returns exp(x) - 1 for |x| <= ln(2)/2, to 2e-16; also of a single float."""
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
    """Returns exp(x) - 1 to 3e-16 + 3.4e-17 |x|, without the low part of ln 2.

    It is constant from x = 300 on.
    """
    x = clip(x, -60.0, 300.0)
    shifted = x * _PER_LN2 + _SHIFT
    r = x - (shifted - _SHIFT) * _LN2_HIGH
    scale = power_of_two(shifted)
    return expm1_near_zero(r) * scale + (scale - 1.0)


@inline_njit
def exp(x):
    """Returns the exponential to 3e-16.

    2^k is applied in two halves, so that results reach down to the subnormal numbers.
    """
    x = clip(x, -750.0, 720.0)
    k = (x * _PER_LN2 + _SHIFT) - _SHIFT
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    first_half = k * 0.5 + _SHIFT
    second_half = (k - (first_half - _SHIFT)) + _SHIFT
    scaled = (expm1_near_zero(r) + 1.0) * power_of_two(first_half)
    return scaled * power_of_two(second_half)


# sin and cos (Cody and Waite, 1980): x = n pi/2 + r with |r| <= pi/4 and pi/2 in three
# parts. sin(r) = r + r^3 s(r^2), cos(r) = 1 - r^2/2 + r^4 c(r^2) with polynomials of
# degree 6 through the points of Chebyshev, 1e-20 off.

_ROUND = 6755399441055744.0  # 1.5 * 2^52
_QUARTER = 1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21


@inline_njit
def sine(x, quarters=0.0):
    """Returns the sine some quarters of a turn later, within [-1, 1] or NaN.

    It is exact to 2e-16, for large x to 2e-16 of the argument's round-off.
    """
    n = (x * 0.6366197723675814 + _ROUND) - _ROUND
    r = clip(((x - n * _QUARTER[0]) - n * _QUARTER[1]) - n * _QUARTER[2], -0.79, 0.79)
    z = r * r
    s = z * -7.58549250782124e-13 + 1.605851097953535e-10
    s = s * z + -2.5052106100926675e-08
    s = s * z + 2.755731921895673e-06
    s = s * z + -0.0001984126984126457
    s = s * z + 0.008333333333333331
    s = (s * z + -0.16666666666666666) * (z * r) + r
    c = z * 4.745202155702359e-14 + -1.147044941240971e-11
    c = c * z + 2.0876755717957296e-09
    c = c * z + -2.75573192211902e-07
    c = c * z + 2.480158730158437e-05
    c = c * z + -0.0013888888888888887
    c = (c * z + 0.041666666666666664) * (z * z) + (1.0 - z * 0.5)
    n = n + quarters
    # an odd n takes the cosine of r, and an odd half of it is negative
    half = _floor_of_half(n)
    odd = n - half * 2.0
    negative = half - _floor_of_half(half) * 2.0
    return clip((s * (1.0 - odd) + c * odd) * (1.0 - negative * 2.0), -1.0, 1.0)


@inline_njit
def cosine(x):
    """Returns the cosine to 2e-16; see ``sine``."""
    return sine(x, 1.0)


@inline_njit
def _floor_of_half(n):
    return ((n * 0.5 - 0.25) + _ROUND) - _ROUND
