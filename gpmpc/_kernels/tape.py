"""Evaluates functions that are lists of scalar operations, with derivatives.

A tape is an expression of sums, products and elementary functions as a list: one
operation after the other on a few places of work. Compiled loops run it beside GPs, at
eight points at once, and no function of a user is compiled. Derivatives are carried
along forwards, tangents for every place (Griewank and Walther, 2008, section 3.1).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._compiled import compiled, inline_njit, njit_noalloc
from gpmpc._kernels._simd import cosine, load, sine, store, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows

Array = NDArray[np.float64]

# The operations, by CasADi's numbers for them. A new one has four places: its number
# here, ``OPERATIONS``, ``TWO_OPERANDS`` if it has two, and ``_operate`` (eight points
# at once) or ``_operate_on_scalars`` (one after the other).
(
    ASSIGN,
    ADD,
    SUB,
    MUL,
    DIV,
    NEG,
    EXP,
    LOG,
    POW,
    CONSTPOW,
    SQRT,
    SQ,
    TWICE,
    SIN,
    COS,
    TAN,
    ASIN,
    ACOS,
    ATAN,
    LT,
    LE,
    EQ,
    NE,
    NOT,
    AND,
    OR,
    FLOOR,
    CEIL,
    FMOD,
    FABS,
    SIGN,
    COPYSIGN,
    IF_ELSE_ZERO,
    ERF,
    FMIN,
    FMAX,
    INV,
    SINH,
    COSH,
    TANH,
    ASINH,
    ACOSH,
    ATANH,
    ATAN2,
    CONST,
    INPUT,
    OUTPUT,
) = range(47)
LOG1P = 93
EXPM1 = 94
HYPOT = 95
COMPARISONS = (LT, LE, EQ, NE, AND, OR)
TWO_OPERANDS = (
    *(ADD, SUB, MUL, DIV, POW, CONSTPOW, FMOD, COPYSIGN, IF_ELSE_ZERO),
    *(FMIN, FMAX, ATAN2, HYPOT),
    *COMPARISONS,
)
OPERATIONS = frozenset({*range(47), LOG1P, EXPM1, HYPOT})


# rows that ``_operate`` works in, beyond those of the tape's places
SPARE_PLACES = 5


class Tape(NamedTuple):
    """A function of a vector z (d,)."""

    #: operation, place of the result (an index into the value of an ``OUTPUT``) and
    #: places of up to two operands (an index into z of an ``INPUT``) (K, 4)
    code: NDArray[np.int64]
    constants: Array  #: of the operations ``CONST``, by row (K,)
    places: int  #: number of places that its operations work on
    size: int  #: entries of the value


NO_TAPE = Tape(
    code=np.empty((0, 4), dtype=np.int64), constants=np.empty(0), places=0, size=0
)


class Tangents(NamedTuple):
    """Derivatives by z at eight points, as ``run_tape`` writes them."""

    value: Array  #: of the value (size, d, 8), flat
    places: Array  #: of the places, lent to work in (places, d, 8), flat


@njit_noalloc
def run_tape(tape, z, work, value, tangents):
    """Writes the values (size, 8) at eight points z (d, 8).

    ``work`` (places + SPARE_PLACES, 8) is lent to work in. ``tangents`` are
    ``Tangents`` to be written, or None.
    """
    use_widest_registers()
    d = len(z)
    z = z.reshape(-1)
    work = work.reshape(-1)
    value = value.reshape(-1)
    for i in range(tape.size):
        store(value, 8 * i, zeros())
    for k in range(len(tape.code)):
        operation = tape.code[k, 0]
        i = 8 * tape.code[k, 1]
        j = 8 * tape.code[k, 2]
        second = 8 * tape.code[k, 3]
        if operation == OUTPUT:
            store(value, i, load(work, j))
            if tangents is not None:
                for c in range(0, 8 * d, 8):
                    tangent = load(tangents.places, j * d + c)
                    store(tangents.value, i * d + c, tangent)
        elif operation == IF_ELSE_ZERO:
            _choose(tape, k, work, tangents, d)
        elif operation in (INPUT, CONST):
            store(
                work,
                i,
                load(z, j) if operation == INPUT else zeros() + tape.constants[k],
            )
            if tangents is not None:
                for c in range(0, 8 * d, 8):
                    slope = 1.0 if operation == INPUT and c == j else 0.0
                    store(tangents.places, i * d + c, zeros() + slope)
        else:
            result, by_first, by_second = _operate(
                operation, load(work, j), load(work, second), work, 8 * tape.places
            )
            store(work, i, result)
            if tangents is not None:
                both = operation in TWO_OPERANDS
                for c in range(0, 8 * d, 8):
                    tangent = by_first * load(tangents.places, j * d + c)
                    if both:
                        second_tangent = load(tangents.places, second * d + c)
                        tangent = tangent + by_second * second_tangent
                    store(tangents.places, i * d + c, tangent)


@njit_noalloc
def _choose(tape, k, work, tangents, d):
    """Runs operation k, which takes its second operand where the first is not zero.

    Elsewhere all is zero: what is not chosen need not be finite, nor have a slope.
    """
    target = 8 * tape.code[k, 1]
    condition = 8 * tape.code[k, 2]
    choice = 8 * tape.code[k, 3]
    chosen = 8 * tape.places
    for lane in range(8):
        work[chosen + lane] = work[condition + lane]
    for lane in range(8):
        is_chosen = work[chosen + lane] != 0.0
        work[target + lane] = work[choice + lane] if is_chosen else 0.0
        if tangents is not None:
            for c in range(lane, 8 * d + lane, 8):
                tangent = tangents.places[choice * d + c] if is_chosen else 0.0
                tangents.places[target * d + c] = tangent


@compiled
def linearize_tape(tape, points, values, jacobians):
    """Writes values (H, size) and derivatives (H, size, d) at H points z (H, d)."""
    use_widest_registers()
    H, d = points.shape
    size = tape.size
    z = aligned_rows(d, 8)
    work = aligned_rows(tape.places + SPARE_PLACES, 8)
    value = aligned_rows(size, 8)
    derivative = aligned_rows(size * d, 8)
    tangent_rows = aligned_rows(tape.places * d, 8)
    derivative[:] = 0.0
    tangents = Tangents(value=derivative.reshape(-1), places=tangent_rows.reshape(-1))
    for first in range(0, H, 8):
        for lane in range(8):
            for c in range(d):
                z[c, lane] = points[min(first + lane, H - 1), c]
        run_tape(tape=tape, z=z, work=work, value=value, tangents=tangents)
        for lane in range(min(8, H - first)):
            for i in range(size):
                values[first + lane, i] = value[i, lane]
                for c in range(d):
                    jacobians[first + lane, i, c] = derivative[i * d + c, lane]


@inline_njit
def _operate(operation, a, b, work, free):
    """Returns the values of an operation on a and b, and its derivatives by them.

    b is not read where it has one operand. ``SPARE_PLACES`` rows of eight of ``work``
    are written to, from entry ``free`` on.
    """
    if operation == ADD:
        return a + b, zeros() + 1.0, zeros() + 1.0
    if operation == SUB:
        return a - b, zeros() + 1.0, zeros() - 1.0
    if operation == MUL:
        return a * b, b, a
    if operation == DIV:
        return a / b, 1.0 / b, a / b * (-1.0 / b)
    if operation == SQ:
        return a * a, a * 2.0, zeros()
    if operation == TWICE:
        return a * 2.0, zeros() + 2.0, zeros()
    if operation == NEG:
        return a * -1.0, zeros() - 1.0, zeros()
    if operation == SIN:
        return sine(a), cosine(a), zeros()
    if operation == COS:
        return cosine(a), sine(a) * -1.0, zeros()
    store(work, free, a)
    store(work, free + 8, b)
    for lane in range(free, free + 8):
        value, by_first, by_second = _operate_on_scalars(
            operation, work[lane], work[lane + 8]
        )
        work[lane + 16] = value
        work[lane + 24] = by_first
        work[lane + 32] = by_second
    return load(work, free + 16), load(work, free + 24), load(work, free + 32)


@njit_noalloc
def _over(a, b):
    """Returns a / b, infinite or NaN for b = 0, where Python raises an error."""
    return a / b if b != 0.0 else a * np.inf


@njit_noalloc
def _operate_on_scalars(operation, a, b):
    """Does what ``_operate`` does for all other operations, on two numbers."""
    if operation == INV:
        return _over(1.0, a), _over(-1.0, a * a), 0.0
    if operation in (POW, CONSTPOW):
        value = a**b
        by_exponent = math.log(a) * value if operation == POW and a > 0.0 else 0.0
        return value, b * a ** (b - 1.0), by_exponent
    if operation == SQRT:
        root = math.sqrt(a) if a >= 0.0 else np.nan
        return root, _over(0.5, root), 0.0
    if operation == ASSIGN:
        return a, 1.0, 0.0
    if operation in (EXP, EXPM1, LOG, LOG1P, ERF):
        return _operate_exponential(operation, a)
    if operation in (TAN, ASIN, ACOS, ATAN):
        return _operate_trigonometric(operation, a)
    if operation in (SINH, COSH, TANH, ASINH, ACOSH, ATANH):
        return _operate_hyperbolic(operation, a)
    if operation in (FABS, SIGN, FLOOR, CEIL, NOT):
        return _operate_piecewise(operation, a)
    if operation in COMPARISONS:
        return _compare(operation, a, b), 0.0, 0.0
    return _operate_on_pair(operation, a, b)


@njit_noalloc
def _operate_exponential(operation, a):
    """Does what ``_operate_on_scalars`` does, for exponentials and logarithms."""
    if operation == EXP:
        value = math.exp(a)
        return value, value, 0.0
    if operation == EXPM1:
        return math.expm1(a), math.exp(a), 0.0
    if operation == LOG:
        return np.log(a), _over(1.0, a), 0.0
    if operation == LOG1P:
        return np.log1p(a), _over(1.0, 1.0 + a), 0.0
    return math.erf(a), 2.0 / math.sqrt(math.pi) * math.exp(-a * a), 0.0


@njit_noalloc
def _operate_trigonometric(operation, a):
    """Does what ``_operate_on_scalars`` does, for the tangent and inverse functions."""
    if operation == TAN:
        value = math.tan(a)
        return value, 1.0 + value * value, 0.0
    if operation == ATAN:
        return math.atan(a), 1.0 / (1.0 + a * a), 0.0
    if not abs(a) <= 1.0:
        return np.nan, np.nan, 0.0
    slope = _over(1.0, math.sqrt(1.0 - a * a))
    if operation == ASIN:
        return math.asin(a), slope, 0.0
    return math.acos(a), -slope, 0.0


@njit_noalloc
def _operate_hyperbolic(operation, a):
    """Does what ``_operate_on_scalars`` does, for hyperbolic and inverse functions."""
    if operation == TANH:
        value = math.tanh(a)
        return value, 1.0 - value * value, 0.0
    if operation == SINH:
        return math.sinh(a), math.cosh(a), 0.0
    if operation == COSH:
        return math.cosh(a), math.sinh(a), 0.0
    if operation == ASINH:
        return math.asinh(a), 1.0 / math.sqrt(1.0 + a * a), 0.0
    if operation == ACOSH:
        if not a >= 1.0:
            return np.nan, np.nan, 0.0
        return math.acosh(a), _over(1.0, math.sqrt(a * a - 1.0)), 0.0
    return np.arctanh(a), _over(1.0, 1.0 - a * a), 0.0


@njit_noalloc
def _operate_piecewise(operation, a):
    """Does what ``_operate_on_scalars`` does, for functions of steps and kinks."""
    sign = a  # of zero, and of what is no number
    if a > 0.0:
        sign = 1.0
    if a < 0.0:
        sign = -1.0
    if operation == FABS:
        return abs(a), sign, 0.0
    if operation == SIGN:
        return sign, 0.0, 0.0
    if operation == FLOOR:
        return np.floor(a), 0.0, 0.0
    if operation == CEIL:
        return np.ceil(a), 0.0, 0.0
    return 1.0 if a == 0.0 else 0.0, 0.0, 0.0


@njit_noalloc
def _compare(operation, a, b):
    """Returns one where a comparison of two numbers holds, zero elsewhere."""
    holds = a != 0.0 or b != 0.0
    if operation == LT:
        holds = a < b
    elif operation == LE:
        holds = a <= b
    elif operation == EQ:
        holds = a == b
    elif operation == NE:
        holds = a != b
    elif operation == AND:
        holds = a != 0.0 and b != 0.0
    return 1.0 if holds else 0.0


@njit_noalloc
def _operate_on_pair(operation, a, b):
    """Does what ``_operate_on_scalars`` does, for further functions of two numbers."""
    if operation == ATAN2:
        squares = a * a + b * b
        return math.atan2(a, b), _over(b, squares), _over(-a, squares)
    if operation == HYPOT:
        root = math.hypot(a, b)
        return root, _over(a, root), _over(b, root)
    if operation in (FMIN, FMAX):
        takes_first = a <= b if operation == FMIN else a >= b
        if takes_first or np.isnan(b):  # what is no number limits nothing
            return a, 1.0, 0.0
        return b, 0.0, 1.0
    if operation == FMOD:
        value = np.fmod(a, b) if b != 0.0 else np.nan
        return value, 1.0, -np.trunc(_over(a, b))
    if operation == COPYSIGN:
        value = math.copysign(a, b)
        return value, 1.0 if value == a else -1.0, 0.0
    return np.nan, np.nan, np.nan  # none of ``OPERATIONS``
