"""Problem: four rows i and sixteen columns j of a sum over pairs, held in registers from the exponent to the sums.

Loops that LLVM vectorises by itself write each step's numbers to memory and start anew; here a value is a block of
eight vectors of eight numbers, whose instructions are issued side by side: eight independent chains are what two
multiply-adds a cycle with a latency of four ask for. Two loads a cycle are the other limit: four rows by two vectors
load six times for eight multiply-adds, where eight rows by one vector load nine times. Where a processor has smaller
vectors, LLVM splits them.

The functions are for compiled code only and do not look at the lengths of arrays. Where they take numbers of rows,
these stand next to each other in an array, four of them from ``at`` on; those of the columns likewise, sixteen.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

from gpmpc.kernels import exponential as e
from gpmpc.kernels.packed import COLUMNS, LANES, ROWS

SIZE = ROWS * COLUMNS
VECTORS = SIZE // LANES
ACROSS = COLUMNS // LANES  # vectors
VECTOR = ir.VectorType(ir.DoubleType(), LANES)
FUSED = ("contract", "nsz")  # "reassoc" would cancel the constant that rounds


class Block(types.Type):
    """numba's type of such a block: row by row, two vectors each."""

    def __init__(self):
        super().__init__(name="Block")


@register_model(Block)
class _BlockModel(models.PrimitiveModel):
    def __init__(self, manager, block):
        super().__init__(manager, block, ir.ArrayType(VECTOR, VECTORS))


BLOCK, ARRAY = Block(), types.Array(types.float64, 1, "C")


def _numbers(context, builder, array):
    return context.make_array(ARRAY)(context, builder, array).data


def _vector(builder, data, at):
    return builder.bitcast(builder.gep(data, [at]), VECTOR.as_pointer())


def _load(builder, data, at, offset=0):
    return builder.load(_vector(builder, data, builder.add(at, at.type(offset))), align=8)


def _store(builder, vector, data, at, offset=0):
    builder.store(vector, _vector(builder, data, builder.add(at, at.type(offset))), align=8)


def _spread(builder, number):
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, ir.IntType(32)(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _row_numbers(builder, data, at):
    """One for each vector of a block."""
    places = [builder.gep(data, [builder.add(at, at.type(row))]) for row in range(ROWS)]
    numbers = [_spread(builder, builder.load(place)) for place in places]
    return [number for number in numbers for _ in range(ACROSS)]


def _column_numbers(builder, data, at):
    """One for each vector of a block."""
    return [_load(builder, data, at, k * LANES) for k in range(ACROSS)] * ROWS


def _vectors(builder, block):
    return [builder.extract_value(block, k) for k in range(VECTORS)]


def _block(builder, vectors):
    block = ir.Constant(ir.ArrayType(VECTOR, VECTORS), ir.Undefined)
    for place, vector in enumerate(vectors):
        block = builder.insert_value(block, vector, place)
    return block


def _multiply_add(builder, a, b, c):
    return builder.fadd(builder.fmul(a, b, flags=FUSED), c, flags=FUSED)


@intrinsic
def outer_sum(typing_context, rows, at, columns, place):
    """rows_i + columns_j."""

    def generate(context, builder, signature, arguments):
        rows = _row_numbers(builder, _numbers(context, builder, arguments[0]), arguments[1])
        columns = _column_numbers(builder, _numbers(context, builder, arguments[2]), arguments[3])
        return _block(builder, [builder.fadd(*pair, flags=FUSED) for pair in zip(rows, columns, strict=True)])

    return BLOCK(ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def plus_outer(typing_context, block, rows, at, columns, place):
    """block_ij + rows_i columns_j."""

    def generate(context, builder, signature, arguments):
        rows = _row_numbers(builder, _numbers(context, builder, arguments[1]), arguments[2])
        columns = _column_numbers(builder, _numbers(context, builder, arguments[3]), arguments[4])
        factors = zip(rows, columns, _vectors(builder, arguments[0]), strict=True)
        return _block(builder, [_multiply_add(builder, *three) for three in factors])

    return BLOCK(BLOCK, ARRAY, types.intp, ARRAY, types.intp), generate


def _constant(value):
    return ir.Constant(VECTOR, [value] * LANES)


def _each(operation, *operands):
    return [operation(*row) for row in zip(*operands, strict=True)]


def _reduced_expm1(builder, r):
    g = _each(lambda v: _multiply_add(builder, v, _constant(e.G9), _constant(e.G8)), r)
    for coefficient in (e.G7, e.G6, e.G5, e.G4, e.G3, e.G2, e.G1, e.G0):
        g = _each(lambda g, v, c=coefficient: _multiply_add(builder, g, v, _constant(c)), g, r)
    return _each(lambda g, v: _multiply_add(builder, g, builder.fmul(v, v, flags=FUSED), v), g, r)


@intrinsic
def expm1(typing_context, block):
    """exp(x) - 1 for x <= 300 and exp(300) above; the low part of ln 2 is left out, worth a third of x's last digit."""

    def generate(context, builder, signature, arguments):
        def capped(x):  # NaN stays NaN
            low, high = _constant(e.SATURATED), _constant(e.LARGE)
            x = builder.select(builder.fcmp_ordered("<", x, low), low, x)
            return builder.select(builder.fcmp_ordered(">", x, high), high, x)

        def scale_of(rounded):
            integers = ir.VectorType(ir.IntType(64), LANES)
            bits = builder.shl(builder.bitcast(rounded, integers), ir.Constant(integers, [52] * LANES))
            return builder.bitcast(bits, VECTOR)

        def add(a, b):
            return builder.fadd(a, b, flags=FUSED)

        def subtract(a, b):
            return builder.fsub(a, b, flags=FUSED)

        x = _each(capped, _vectors(builder, arguments[0]))
        rounded = _each(lambda v: _multiply_add(builder, v, _constant(e.PER_LN2), _constant(e.BIASED_ROUNDER)), x)
        k = _each(lambda v: subtract(v, _constant(e.BIASED_ROUNDER)), rounded)
        r = _each(lambda v, k: subtract(v, builder.fmul(k, _constant(e.LN2_HIGH), flags=FUSED)), x, k)
        g, scale = _reduced_expm1(builder, r), _each(scale_of, rounded)
        return _block(builder, _each(lambda g, s: _multiply_add(builder, g, s, add(s, _constant(-1.0))), g, scale))

    return BLOCK(BLOCK), generate


@intrinsic
def expm1_near_zero(typing_context, block):
    """The same, to the last bit, where no x is beyond ``exponential.NEAR_ZERO``."""

    def generate(context, builder, signature, arguments):
        return _block(builder, _reduced_expm1(builder, _vectors(builder, arguments[0])))

    return BLOCK(BLOCK), generate


@intrinsic
def block(typing_context, array, at):
    """The block in ``array`` from ``at`` on."""

    def generate(context, builder, signature, arguments):
        array = _numbers(context, builder, arguments[0])
        return _block(builder, [_load(builder, array, arguments[1], k * LANES) for k in range(VECTORS)])

    return BLOCK(ARRAY, types.intp), generate


@intrinsic
def fetch(typing_context, array, at):
    """Asks for the block in ``array`` from ``at`` on, which may lie behind its end."""

    def generate(context, builder, signature, arguments):
        data = _numbers(context, builder, arguments[0])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        for k in range(VECTORS):
            place = builder.gep(data, [builder.add(arguments[1], arguments[1].type(k * LANES))])
            builder.call(ask, [builder.bitcast(place, byte), number(0), number(2), number(1)])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp), generate


@intrinsic
def times(typing_context, block, other):
    """block_ij other_ij."""

    def generate(context, builder, signature, arguments):
        pairs = zip(*(_vectors(builder, block) for block in arguments), strict=True)
        return _block(builder, [builder.fmul(a, b, flags=FUSED) for a, b in pairs])

    return BLOCK(BLOCK, BLOCK), generate


@intrinsic
def plus(typing_context, block, other):
    """block_ij + other_ij."""

    def generate(context, builder, signature, arguments):
        pairs = zip(*(_vectors(builder, block) for block in arguments), strict=True)
        return _block(builder, [builder.fadd(a, b, flags=FUSED) for a, b in pairs])

    return BLOCK(BLOCK, BLOCK), generate


@intrinsic
def add_to_columns(typing_context, sums, place, block, rows, at):
    """Adds sum_i rows_i block_ij to sixteen numbers ``sums``."""

    def generate(context, builder, signature, arguments):
        sums = _numbers(context, builder, arguments[0])
        rows = _row_numbers(builder, _numbers(context, builder, arguments[3]), arguments[4])
        vectors = _vectors(builder, arguments[2])
        for k in range(ACROSS):
            total = _load(builder, sums, arguments[1], k * LANES)
            for row, vector in zip(rows[k::ACROSS], vectors[k::ACROSS], strict=True):
                total = _multiply_add(builder, row, vector, total)
            _store(builder, total, sums, arguments[1], k * LANES)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, BLOCK, ARRAY, types.intp), generate


@intrinsic
def add_to_rows(typing_context, sums, at, block, columns, place):
    """Adds block_ij columns_j to four vectors ``sums``, each of which holds parts of its row's sum over j."""

    def generate(context, builder, signature, arguments):
        sums = _numbers(context, builder, arguments[0])
        columns = _column_numbers(builder, _numbers(context, builder, arguments[3]), arguments[4])
        products = list(zip(_vectors(builder, arguments[2]), columns, strict=True))
        for row in range(ROWS):
            total = _load(builder, sums, arguments[1], row * LANES)
            for vector, column in products[row * ACROSS : (row + 1) * ACROSS]:
                total = _multiply_add(builder, vector, column, total)
            _store(builder, total, sums, arguments[1], row * LANES)
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, BLOCK, ARRAY, types.intp), generate


@intrinsic
def sum_rows(typing_context, target, place, sums, at, factors, first):
    """Writes the sums of four vectors ``sums``, times four factors."""

    def generate(context, builder, signature, arguments):
        target, sums, factors = (_numbers(context, builder, arguments[k]) for k in (0, 2, 4))
        parts = [_load(builder, sums, arguments[3], row * LANES) for row in range(ROWS)]
        for length in (LANES, LANES, ROWS):  # sums of neighbours, of two vectors at a time, the last of one with itself
            kind = ir.VectorType(ir.IntType(32), length)
            even, odd = (ir.Constant(kind, list(range(start, 2 * length, 2))) for start in (0, 1))
            parts = [
                builder.fadd(builder.shuffle_vector(a, b, even), builder.shuffle_vector(a, b, odd), flags=FUSED)
                for a, b in zip(parts[::2], parts[-1::-2][::-1], strict=True)
            ]
        total = builder.fmul(parts[0], _four(builder, factors, arguments[5]), flags=FUSED)
        _store_four(builder, total, target, arguments[1])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp, ARRAY, types.intp), generate


def _four(builder, data, at):
    return builder.load(_quarter(builder, data, at), align=8)


def _store_four(builder, vector, data, at):
    builder.store(vector, _quarter(builder, data, at), align=8)


def _quarter(builder, data, at):
    return builder.bitcast(builder.gep(data, [at]), ir.VectorType(ir.DoubleType(), ROWS).as_pointer())


@intrinsic
def clear(typing_context, target, place):
    """Writes eight zeros."""

    def generate(context, builder, signature, arguments):
        _store(builder, ir.Constant(VECTOR, [0.0] * LANES), _numbers(context, builder, arguments[0]), arguments[1])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp), generate


@intrinsic
def copy(typing_context, target, place, source, at):
    """Copies eight numbers."""

    def generate(context, builder, signature, arguments):
        target, source = (_numbers(context, builder, arguments[k]) for k in (0, 2))
        _store(builder, _load(builder, source, arguments[3]), target, arguments[1])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def copy_four(typing_context, target, place, source, at):
    """Copies four numbers."""

    def generate(context, builder, signature, arguments):
        target, source = (_numbers(context, builder, arguments[k]) for k in (0, 2))
        _store_four(builder, _four(builder, source, arguments[3]), target, arguments[1])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp), generate


@intrinsic
def copy_product(typing_context, target, place, source, at, factors, first):
    """Writes the products of four numbers and four factors."""

    def generate(context, builder, signature, arguments):
        target, source, factors = (_numbers(context, builder, arguments[k]) for k in (0, 2, 4))
        pair = _four(builder, source, arguments[3]), _four(builder, factors, arguments[5])
        _store_four(builder, builder.fmul(*pair, flags=FUSED), target, arguments[1])
        return context.get_dummy_value()

    return types.none(ARRAY, types.intp, ARRAY, types.intp, ARRAY, types.intp), generate
