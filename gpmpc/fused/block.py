"""Problem: eight rows i and eight columns j of a sum over pairs, held in registers from the exponent to the sums.

Loops that LLVM vectorises by itself write each step's numbers to memory and start anew; here a value is a block of
eight vectors of eight numbers, whose instructions are issued side by side: eight independent chains are what two
multiply-adds a cycle with a latency of four ask for. Where a processor has smaller vectors, LLVM splits them.

The functions are for compiled code only and do not look at the lengths of arrays. Where they take numbers of rows,
these stand next to each other in an array, eight of them from ``at`` on; a vector over the columns likewise.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

from gpmpc.fused import exponential as e

EDGE = 8
SIZE = EDGE * EDGE
VECTOR = ir.VectorType(ir.DoubleType(), EDGE)
FUSED = ("contract", "nsz")  # "reassoc" would cancel the constant that rounds


class Block(types.Type):
    """numba's type of eight rows of eight numbers."""

    def __init__(self):
        super().__init__(name="Block")


@register_model(Block)
class _BlockModel(models.PrimitiveModel):
    def __init__(self, manager, block):
        super().__init__(manager, block, ir.ArrayType(VECTOR, EDGE))


BLOCK, ARRAY = Block(), types.Array(types.float64, 1, "C")


def _numbers(context, builder, array):
    return context.make_array(ARRAY)(context, builder, array).data


def _vector(builder, data, at):
    return builder.bitcast(builder.gep(data, [at]), VECTOR.as_pointer())


def _load(builder, data, at, offset=0):
    return builder.load(_vector(builder, data, builder.add(at, at.type(offset))), align=8)


def _spread(builder, number):
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, ir.IntType(32)(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), EDGE), [0] * EDGE))


def _row_number(builder, data, at, row):
    return _spread(builder, builder.load(builder.gep(data, [builder.add(at, at.type(row))])))


def _rows(builder, block):
    return [builder.extract_value(block, row) for row in range(EDGE)]


def _block(builder, rows):
    block = ir.Constant(ir.ArrayType(VECTOR, EDGE), ir.Undefined)
    for place, row in enumerate(rows):
        block = builder.insert_value(block, row, place)
    return block


def _multiply_add(builder, a, b, c):
    return builder.fadd(builder.fmul(a, b, flags=FUSED), c, flags=FUSED)


@intrinsic
def outer_sum(typing_context, rows, at, columns, place):
    """rows_i + columns_j."""

    def generate(context, builder, signature, arguments):
        rows, columns = (_numbers(context, builder, arguments[k]) for k in (0, 2))
        column = _load(builder, columns, arguments[3])
        return _block(
            builder,
            [builder.fadd(_row_number(builder, rows, arguments[1], k), column, flags=FUSED) for k in range(EDGE)],
        )

    return BLOCK(ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def plus_outer(typing_context, block, rows, at, columns, place):
    """block_ij + rows_i columns_j."""

    def generate(context, builder, signature, arguments):
        rows, columns = (_numbers(context, builder, arguments[k]) for k in (1, 3))
        column = _load(builder, columns, arguments[4])
        return _block(
            builder,
            [
                _multiply_add(builder, _row_number(builder, rows, arguments[2], k), column, row)
                for k, row in enumerate(_rows(builder, arguments[0]))
            ],
        )

    return BLOCK(BLOCK, ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def expm1(typing_context, block):
    """exp(x) - 1 for x <= 300 and exp(300) above; the low part of ln 2 is left out, worth a third of x's last digit."""

    def generate(context, builder, signature, arguments):
        def constant(value):
            return ir.Constant(VECTOR, [value] * EDGE)

        def each(operation, *operands):
            return [operation(*row) for row in zip(*operands, strict=True)]

        def capped(x):  # NaN stays NaN
            low, high = constant(e.SATURATED), constant(e.LARGE)
            x = builder.select(builder.fcmp_ordered("<", x, low), low, x)
            return builder.select(builder.fcmp_ordered(">", x, high), high, x)

        def scale_of(rounded):
            integers = ir.VectorType(ir.IntType(64), EDGE)
            bits = builder.shl(builder.bitcast(rounded, integers), ir.Constant(integers, [52] * EDGE))
            return builder.bitcast(bits, VECTOR)

        def add(a, b):
            return builder.fadd(a, b, flags=FUSED)

        def subtract(a, b):
            return builder.fsub(a, b, flags=FUSED)

        def multiply(a, b):
            return builder.fmul(a, b, flags=FUSED)

        x = each(capped, _rows(builder, arguments[0]))
        rounded = each(lambda v: _multiply_add(builder, v, constant(e.PER_LN2), constant(e.BIASED_ROUNDER)), x)
        k = each(lambda v: subtract(v, constant(e.BIASED_ROUNDER)), rounded)
        r = each(lambda v, k: subtract(v, multiply(k, constant(e.LN2_HIGH))), x, k)
        g = each(lambda v: _multiply_add(builder, v, constant(e.G9), constant(e.G8)), r)
        for coefficient in (e.G7, e.G6, e.G5, e.G4, e.G3, e.G2, e.G1, e.G0):
            g = each(lambda g, v, c=coefficient: _multiply_add(builder, g, v, constant(c)), g, r)
        g = each(lambda g, v: _multiply_add(builder, g, multiply(v, v), v), g, r)
        scale = each(scale_of, rounded)
        return _block(builder, each(lambda g, s: _multiply_add(builder, g, s, add(s, constant(-1.0))), g, scale))

    return BLOCK(BLOCK), generate


@intrinsic
def block(typing_context, array, at):
    """The block in ``array`` from ``at`` on."""

    def generate(context, builder, signature, arguments):
        array = _numbers(context, builder, arguments[0])
        return _block(builder, [_load(builder, array, arguments[1], k * EDGE) for k in range(EDGE)])

    return BLOCK(ARRAY, types.intp), generate


@intrinsic
def fetch(typing_context, array, at):
    """Asks for the block in ``array`` from ``at`` on, which may lie behind its end."""

    def generate(context, builder, signature, arguments):
        data = _numbers(context, builder, arguments[0])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        for k in range(EDGE):
            place = builder.gep(data, [builder.add(arguments[1], arguments[1].type(k * EDGE))])
            builder.call(ask, [builder.bitcast(place, byte), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp), generate


@intrinsic
def times(typing_context, block, other):
    """block_ij other_ij."""

    def generate(context, builder, signature, arguments):
        pairs = zip(*(_rows(builder, block) for block in arguments), strict=True)
        return _block(builder, [builder.fmul(a, b, flags=FUSED) for a, b in pairs])

    return BLOCK(BLOCK, BLOCK), generate


@intrinsic
def plus(typing_context, block, other):
    """block_ij + other_ij."""

    def generate(context, builder, signature, arguments):
        pairs = zip(*(_rows(builder, block) for block in arguments), strict=True)
        return _block(builder, [builder.fadd(a, b, flags=FUSED) for a, b in pairs])

    return BLOCK(BLOCK, BLOCK), generate


@intrinsic
def add_to_columns(typing_context, sums, place, block, rows, at):
    """Adds sum_i rows_i block_ij to eight numbers ``sums``."""

    def generate(context, builder, signature, arguments):
        sums, rows = (_numbers(context, builder, arguments[k]) for k in (0, 3))
        total = _load(builder, sums, arguments[1])
        for k, row in enumerate(_rows(builder, arguments[2])):
            total = _multiply_add(builder, _row_number(builder, rows, arguments[4], k), row, total)
        builder.store(total, _vector(builder, sums, arguments[1]), align=8)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, BLOCK, ARRAY, types.intp), generate


@intrinsic
def plus_scaled(typing_context, block, other, columns, place):
    """block_ij + other_ij columns_j."""

    def generate(context, builder, signature, arguments):
        column = _load(builder, _numbers(context, builder, arguments[2]), arguments[3])
        pairs = zip(*(_rows(builder, block) for block in arguments[:2]), strict=True)
        return _block(builder, [_multiply_add(builder, b, column, a) for a, b in pairs])

    return BLOCK(BLOCK, BLOCK, ARRAY, types.intp), generate


@intrinsic
def add_row_sums(typing_context, sums, at, block, rows, first):
    """Adds rows_i sum_j block_ij to eight numbers ``sums``."""

    def generate(context, builder, signature, arguments):
        sums, factors = (_numbers(context, builder, arguments[k]) for k in (0, 3))
        even, odd = (
            ir.Constant(ir.VectorType(ir.IntType(32), EDGE), list(range(start, 2 * EDGE, 2))) for start in (0, 1)
        )
        parts = _rows(builder, arguments[2])
        while len(parts) > 1:  # sums of neighbours, of two vectors at a time
            parts = [
                builder.fadd(builder.shuffle_vector(a, b, even), builder.shuffle_vector(a, b, odd), flags=FUSED)
                for a, b in zip(parts[::2], parts[1::2], strict=True)
            ]
        total = _load(builder, sums, arguments[1])
        total = _multiply_add(builder, _load(builder, factors, arguments[4]), parts[0], total)
        builder.store(total, _vector(builder, sums, arguments[1]), align=8)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, BLOCK, ARRAY, types.intp), generate


@intrinsic
def zeros(typing_context):
    """A block of zeros."""

    def generate(context, builder, signature, arguments):
        return ir.Constant(ir.ArrayType(VECTOR, EDGE), [[0.0] * EDGE] * EDGE)

    return BLOCK(), generate


@intrinsic
def copy(typing_context, target, place, source, at):
    """Copies eight numbers."""

    def generate(context, builder, signature, arguments):
        target, source = (_numbers(context, builder, arguments[k]) for k in (0, 2))
        builder.store(_load(builder, source, arguments[3]), _vector(builder, target, arguments[1]), align=8)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def copy_product(typing_context, target, place, source, at, factors, first):
    """Writes the products of eight numbers and eight factors."""

    def generate(context, builder, signature, arguments):
        target, source, factors = (_numbers(context, builder, arguments[k]) for k in (0, 2, 4))
        pair = _load(builder, source, arguments[3]), _load(builder, factors, arguments[5])
        builder.store(builder.fmul(*pair, flags=FUSED), _vector(builder, target, arguments[1]), align=8)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp, ARRAY, types.intp), generate
