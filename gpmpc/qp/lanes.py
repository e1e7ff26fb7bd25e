"""Eight numbers at once, for loops that LLVM's vectoriser cuts badly: short, triangular, or with several sums.

A value of this type is a vector register of 512 bits, or two or four smaller ones where the processor has no such. The
functions are for compiled code only. None of them looks at the array's length.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic, models, register_model

from gpmpc.compiled import borrowing

WIDTH = 8
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
FUSED = ("contract", "reassoc", "nsz")


class Lanes(types.Type):
    """numba's type of eight numbers."""

    def __init__(self):
        super().__init__(name="Lanes")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, VECTOR)


LANES = Lanes()


def _spread(builder, number):
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, ir.IntType(32)(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH))


def _place(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), VECTOR.as_pointer())


@intrinsic
def no_lanes(typing_context):
    """Eight zeros."""

    def generate(context, builder, signature, arguments):
        return ir.Constant(VECTOR, [0.0] * WIDTH)

    return LANES(), generate


@intrinsic
def lanes(typing_context, array, index):
    """The entries ``array[index : index + 8]`` of a contiguous vector."""

    def generate(context, builder, signature, arguments):
        place = _place(context, builder, signature.args[0], *arguments)
        return builder.load(place, align=8)

    return LANES(array, types.intp), generate


@intrinsic
def put(typing_context, array, index, values):
    """``array[index : index + 8] = values``."""

    def generate(context, builder, signature, arguments):
        place = _place(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], place, align=8)
        return context.get_dummy_value()

    return types.none(array, types.intp, LANES), generate


@intrinsic
def less(typing_context, values, factor, others):
    """``values - factor others``, rounded once where the processor can."""

    def generate(context, builder, signature, arguments):
        product = builder.fmul(_spread(builder, arguments[1]), arguments[2], flags=FUSED)
        return builder.fsub(arguments[0], product, flags=FUSED)

    return LANES(LANES, types.float64, LANES), generate


@intrinsic
def scaled(typing_context, factor, values):
    """``factor values``."""

    def generate(context, builder, signature, arguments):
        return builder.fmul(_spread(builder, arguments[0]), arguments[1], flags=FUSED)

    return LANES(types.float64, LANES), generate


@intrinsic
def plus(typing_context, values, factor, others):
    """``values + factor others``, rounded once where the processor can."""

    def generate(context, builder, signature, arguments):
        product = builder.fmul(_spread(builder, arguments[1]), arguments[2], flags=FUSED)
        return builder.fadd(arguments[0], product, flags=FUSED)

    return LANES(LANES, types.float64, LANES), generate


@intrinsic
def larger(typing_context, values, others):
    """Entry by entry the larger one of ``values`` and ``|others|``; NaN in ``others`` is passed over."""

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(VECTOR, [VECTOR])
        sizes = cgutils.get_or_insert_function(builder.module, kind, "llvm.fabs.v8f64")
        size = builder.call(sizes, [arguments[1]])
        return builder.select(builder.fcmp_ordered(">", size, arguments[0]), size, arguments[0])

    return LANES(LANES, LANES), generate


@intrinsic
def lane(typing_context, values, index):
    """One of the eight numbers."""

    def generate(context, builder, signature, arguments):
        return builder.extract_element(arguments[0], arguments[1])

    return types.float64(LANES, types.intp), generate


@intrinsic
def folded(typing_context, values, distance):
    """The entries rotated by a distance that is known when compiling."""
    if not isinstance(distance, types.IntegerLiteral):
        raise TypingError("the distance must be a literal")
    order = [(i + distance.literal_value) % WIDTH for i in range(WIDTH)]

    def generate(context, builder, signature, arguments):
        mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order)
        return builder.shuffle_vector(arguments[0], arguments[0], mask)

    return LANES(LANES, distance), generate


@borrowing
def largest(values):
    """The largest size among eight numbers."""
    values = larger(values, folded(values, 4))
    values = larger(values, folded(values, 2))
    return max(lane(values, 0), lane(values, 1))


@borrowing
def combine(rows, count, factors, start, width, target):
    """``target[start:][:width] = sum_j factors[j] rows[j, start:][:width]`` over ``count`` rows, in whole lanes.

    Rows and target are padded: what lies between ``start + width`` and the next whole lane is written too.
    """
    at, end = start, start + width
    while at + 24 < end:
        a, b, c, d = no_lanes(), no_lanes(), no_lanes(), no_lanes()
        for j in range(count):
            row, factor = rows[j], factors[j]
            a, b = plus(a, factor, lanes(row, at)), plus(b, factor, lanes(row, at + 8))
            c, d = plus(c, factor, lanes(row, at + 16)), plus(d, factor, lanes(row, at + 24))
        put(target, at, a)
        put(target, at + 8, b)
        put(target, at + 16, c)
        put(target, at + 24, d)
        at += 32
    while at + 8 < end:
        a, b = no_lanes(), no_lanes()
        for j in range(count):
            row, factor = rows[j], factors[j]
            a, b = plus(a, factor, lanes(row, at)), plus(b, factor, lanes(row, at + 8))
        put(target, at, a)
        put(target, at + 8, b)
        at += 16
    while at < end:
        a = no_lanes()
        for j in range(count):
            a = plus(a, factors[j], lanes(rows[j], at))
        put(target, at, a)
        at += 8
