"""Evaluates functions that are lists of scalar operations, with derivatives by forward differentiation.

A tape is what is left of an expression of sums, products and elementary functions: one operation after the other on a
few places of work. Compiled loops run it beside GPs, and no function of a user is compiled. Derivatives are carried
along, a row of tangents for every place (Griewank and Walther, 2008, section 3.1).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._compiled import compiled, njit_noalloc

Array = NDArray[np.float64]

# The operations, by CasADi's numbers for them.
ASSIGN, ADD, SUB, MUL, DIV, NEG, EXP, LOG, POW, CONSTPOW, SQRT, SQ, TWICE, SIN, COS, TAN = range(16)
ATAN, FABS, FMIN, FMAX, INV, TANH, ATAN2, CONST, INPUT, OUTPUT = 18, 29, 34, 35, 36, 39, 43, 44, 45, 46
OPERATIONS = frozenset({*range(16), ATAN, FABS, FMIN, FMAX, INV, TANH, ATAN2, CONST, INPUT, OUTPUT})


class Tape(NamedTuple):
    """A function of a vector z (d,)."""

    #: operation, place of the result and places of up to two operands (K, 4). Of an ``INPUT`` the operand is an index
    #: into z, of an ``OUTPUT`` the result is an index into the value
    code: NDArray[np.int64]
    constants: Array  #: of the operations ``CONST``, by row (K,)
    work: int  #: number of places
    size: int  #: entries of the value


NO_TAPE = Tape(np.empty((0, 4), dtype=np.int64), np.empty(0), 0, 0)


@njit_noalloc
def run_tape(tape, z, work, value):
    """Writes the value at z (d,); ``work`` is a vector of as many places as the tape has, or more."""
    value[: tape.size] = 0.0
    for k in range(len(tape.code)):
        code = tape.code[k]
        operation, i = code[0], code[1]
        if operation == OUTPUT:
            value[i] = work[code[2]]
        elif operation == INPUT:
            work[i] = z[code[2]]
        elif operation == CONST:
            work[i] = tape.constants[k]
        else:
            work[i] = _operate(operation, work[code[2]], work[code[3]])[0]


@compiled
def linearize_tape(tape, points, values, jacobians):
    """Writes the values (K, size) at K points z (K, d), and their derivatives (K, size, d)."""
    d = points.shape[1]
    work, tangents = np.empty(tape.work), np.empty((tape.work, d))
    values[:], jacobians[:] = 0.0, 0.0
    for p in range(len(points)):
        for k in range(len(tape.code)):
            code = tape.code[k]
            operation, i, j, last = code[0], code[1], code[2], code[3]
            if operation == OUTPUT:
                values[p, i] = work[j]
                for c in range(d):
                    jacobians[p, i, c] = tangents[j, c]
            elif operation in (INPUT, CONST):
                work[i] = points[p, j] if operation == INPUT else tape.constants[k]
                for c in range(d):
                    tangents[i, c] = 0.0
                if operation == INPUT:
                    tangents[i, j] = 1.0
            else:
                work[i], by_first, by_second = _operate(operation, work[j], work[last])
                if by_second == 0.0:
                    for c in range(d):
                        tangents[i, c] = by_first * tangents[j, c]
                else:
                    for c in range(d):
                        tangents[i, c] = by_first * tangents[j, c] + by_second * tangents[last, c]


@njit_noalloc
def _operate(operation, a, b):
    """The value of an operation on a and b, and its derivatives by them; b is not read where it has one operand."""
    if operation == ADD:
        return a + b, 1.0, 1.0
    if operation == SUB:
        return a - b, 1.0, -1.0
    if operation == MUL:
        return a * b, b, a
    if operation == DIV:
        return a / b, 1.0 / b, -a / (b * b)
    if operation == SQ:
        return a * a, 2.0 * a, 0.0
    if operation == TWICE:
        return 2.0 * a, 2.0, 0.0
    if operation == NEG:
        return -a, -1.0, 0.0
    if operation == SIN:
        return math.sin(a), math.cos(a), 0.0
    if operation == COS:
        return math.cos(a), -math.sin(a), 0.0
    return _operate_rarely(operation, a, b)


@njit_noalloc
def _operate_rarely(operation, a, b):
    """``_operate`` for all other operations."""
    if operation == INV:
        return 1.0 / a, -1.0 / (a * a), 0.0
    if operation == EXP:
        value = math.exp(a)
        return value, value, 0.0
    if operation == LOG:
        return math.log(a) if a > 0.0 else np.nan, 1.0 / a, 0.0
    if operation in (POW, CONSTPOW):
        value = a**b
        return value, b * a ** (b - 1.0), math.log(a) * value if operation == POW and a > 0.0 else 0.0
    if operation == SQRT:
        root = math.sqrt(a) if a >= 0.0 else np.nan
        return root, 0.5 / root, 0.0
    if operation == TAN:
        value = math.tan(a)
        return value, 1.0 + value * value, 0.0
    if operation == ATAN:
        return math.atan(a), 1.0 / (1.0 + a * a), 0.0
    if operation == ATAN2:
        squares = a * a + b * b
        return math.atan2(a, b), b / squares, -a / squares
    if operation == TANH:
        value = math.tanh(a)
        return value, 1.0 - value * value, 0.0
    if operation == FABS:
        return abs(a), 1.0 if a > 0.0 else -1.0 if a < 0.0 else 0.0, 0.0
    if operation == FMIN:
        return min(a, b), 1.0 if a <= b else 0.0, 0.0 if a <= b else 1.0
    if operation == FMAX:
        return max(a, b), 1.0 if a >= b else 0.0, 0.0 if a >= b else 1.0
    return a, 1.0, 0.0  # an assignment
