"""Eight numbers at once, for loops that LLVM's vectoriser cuts badly: short, triangular, or with several sums.

A value of this type is a vector register of 512 bits, or two or four smaller ones where the processor has no such. The
functions are for compiled code only. Only ``some_lanes`` looks at the array's length.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic, models, register_model

from gpmpc.compiled import inline_njit

WIDTH = 8
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
WHOLE = ir.VectorType(ir.IntType(64), WIDTH)
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


def _spread(builder, number, kind=VECTOR):
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), number, ir.IntType(32)(0))
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
def some_lanes(typing_context, array, index):
    """The same of an array that may end before; zeros from there on."""

    def generate(context, builder, signature, arguments):
        place = _place(context, builder, signature.args[0], *arguments)
        size = context.make_array(signature.args[0])(context, builder, arguments[0]).nitems
        left = _spread(builder, builder.sub(size, arguments[1]), WHOLE)
        present = builder.icmp_signed("<", ir.Constant(WHOLE, list(range(WIDTH))), left)
        kind = ir.FunctionType(VECTOR, [place.type, ir.IntType(32), present.type, VECTOR])
        load = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8f64.p0v8f64")
        return builder.call(load, [place, ir.IntType(32)(8), present, ir.Constant(VECTOR, [0.0] * WIDTH)])

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
def plus_product(typing_context, values, ones, others):
    """``values + ones others``, entry by entry."""

    def generate(context, builder, signature, arguments):
        product = builder.fmul(arguments[1], arguments[2], flags=FUSED)
        return builder.fadd(arguments[0], product, flags=FUSED)

    return LANES(LANES, LANES, LANES), generate


@inline_njit
def product(values, others):
    """``values others``, entry by entry."""
    return plus_product(no_lanes(), values, others)


@intrinsic
def any_nonzero(typing_context, values):
    """Whether an entry is not zero; NaN is not."""

    def generate(context, builder, signature, arguments):
        nonzero = builder.fcmp_unordered("!=", arguments[0], ir.Constant(VECTOR, [0.0] * WIDTH))
        return builder.icmp_unsigned("!=", builder.bitcast(nonzero, ir.IntType(WIDTH)), ir.IntType(WIDTH)(0))

    return types.boolean(LANES), generate


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


@inline_njit
def total(values):
    """The sum of eight numbers."""
    values = plus(values, 1.0, folded(values, 4))
    values = plus(values, 1.0, folded(values, 2))
    return lane(values, 0) + lane(values, 1)


@inline_njit
def combine(rows, count, factors, start, width, target):
    """``target[start:][:width] = sum_j factors[j] rows[j, start:][:width]`` over ``count`` rows, in whole lanes.

    Rows and target are padded: what lies between ``start + width`` and the next whole lane is written too. Several
    sums at a time hide the latency of one.
    """
    at, end = start, start + width
    while at + 8 < end:
        a = b = c = d = e = f = g = h = no_lanes()
        j = 0
        while j + 4 <= count:
            r0, r1, r2, r3 = rows[j], rows[j + 1], rows[j + 2], rows[j + 3]
            f0, f1, f2, f3 = factors[j], factors[j + 1], factors[j + 2], factors[j + 3]
            a, b = plus(a, f0, lanes(r0, at)), plus(b, f0, lanes(r0, at + 8))
            c, d = plus(c, f1, lanes(r1, at)), plus(d, f1, lanes(r1, at + 8))
            e, f = plus(e, f2, lanes(r2, at)), plus(f, f2, lanes(r2, at + 8))
            g, h = plus(g, f3, lanes(r3, at)), plus(h, f3, lanes(r3, at + 8))
            j += 4
        while j < count:
            row, factor = rows[j], factors[j]
            a, b = plus(a, factor, lanes(row, at)), plus(b, factor, lanes(row, at + 8))
            j += 1
        put(target, at, plus(plus(a, 1.0, c), 1.0, plus(e, 1.0, g)))
        put(target, at + 8, plus(plus(b, 1.0, d), 1.0, plus(f, 1.0, h)))
        at += 16
    if at < end:
        a = b = c = d = no_lanes()
        j = 0
        while j + 4 <= count:
            a, b = plus(a, factors[j], lanes(rows[j], at)), plus(b, factors[j + 1], lanes(rows[j + 1], at))
            c, d = plus(c, factors[j + 2], lanes(rows[j + 2], at)), plus(d, factors[j + 3], lanes(rows[j + 3], at))
            j += 4
        while j < count:
            a = plus(a, factors[j], lanes(rows[j], at))
            j += 1
        put(target, at, plus(plus(a, 1.0, b), 1.0, plus(c, 1.0, d)))
