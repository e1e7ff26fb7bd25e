"""Eight numbers at once, for loops that LLVM's vectoriser cuts badly: short, triangular, or with several sums.

A value of this type is a vector register of 512 bits, or two or four smaller ones where the processor has no such. The
functions are for compiled code only. None of them looks at the array's length.
"""

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, register_model

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
