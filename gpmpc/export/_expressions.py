"""Functions as graphs of scalar operations, their derivatives, and both as C.

A graph holds each operation once. Derivatives are carried forwards, entry by entry, as
operations of the same graph: what is zero is left out, and what value and derivatives
share is computed once (Griewank and Walther, 2008, chapters 3 and 6).
"""

import math
from collections.abc import Callable, Sequence

from gpmpc._kernels import tape as tapes
from gpmpc.export._text import Numbers

_UNARY: dict[int, str] = {
    tapes.ASSIGN: "{a}",
    tapes.NEG: "-{a}",
    tapes.SQ: "{a} * {a}",
    tapes.TWICE: "2 * {a}",
    tapes.INV: "1 / {a}",
    tapes.EXP: "EXP({a})",
    tapes.LOG: "LOG({a})",
    tapes.SQRT: "SQRT({a})",
    tapes.SIN: "SIN({a})",
    tapes.COS: "COS({a})",
    tapes.TAN: "TAN({a})",
    tapes.ATAN: "ATAN({a})",
    tapes.TANH: "TANH({a})",
    tapes.FABS: "FABS({a})",
    tapes.ASIN: "ASIN({a})",
    tapes.ACOS: "ACOS({a})",
    tapes.SINH: "SINH({a})",
    tapes.COSH: "COSH({a})",
    tapes.ASINH: "ASINH({a})",
    tapes.ACOSH: "ACOSH({a})",
    tapes.ATANH: "ATANH({a})",
    tapes.EXPM1: "EXPM1({a})",
    tapes.LOG1P: "LOG1P({a})",
    tapes.ERF: "ERF({a})",
    tapes.FLOOR: "FLOOR({a})",
    tapes.CEIL: "CEIL({a})",
    tapes.SIGN: "({a} > 0 ? 1 : {a} < 0 ? -1 : {a})",
    tapes.NOT: "(real)({a} == 0)",
}
_BINARY: dict[int, str] = {
    tapes.ADD: "{a} + {b}",
    tapes.SUB: "{a} - {b}",
    tapes.MUL: "{a} * {b}",
    tapes.DIV: "{a} / {b}",
    tapes.POW: "POW({a}, {b})",
    tapes.CONSTPOW: "POW({a}, {b})",
    # what is no number limits nothing
    tapes.FMIN: "{a} <= {b} || isnan({b}) ? {a} : {b}",
    tapes.FMAX: "{a} >= {b} || isnan({b}) ? {a} : {b}",
    tapes.ATAN2: "ATAN2({a}, {b})",
    tapes.HYPOT: "HYPOT({a}, {b})",
    tapes.FMOD: "FMOD({a}, {b})",
    tapes.COPYSIGN: "COPYSIGN({a}, {b})",
    tapes.IF_ELSE_ZERO: "{a} != 0 ? {b} : 0",
    tapes.LT: "(real)({a} < {b})",
    tapes.LE: "(real)({a} <= {b})",
    tapes.EQ: "(real)({a} == {b})",
    tapes.NE: "(real)({a} != {b})",
    tapes.AND: "(real)({a} != 0 && {b} != 0)",
    tapes.OR: "(real)({a} != 0 || {b} != 0)",
}
_FUNCTIONS: dict[int, Callable[..., float]] = {
    tapes.ADD: lambda a, b: a + b,
    tapes.SUB: lambda a, b: a - b,
    tapes.MUL: lambda a, b: a * b,
    tapes.NEG: lambda a: -a,
    tapes.SQ: lambda a: a * a,
    tapes.TWICE: lambda a: 2.0 * a,
    tapes.SIN: math.sin,
    tapes.COS: math.cos,
}

_Key = tuple[int, int | float, int]
Derivatives = dict[int, int]  # by the number of an input, where they are not zero


class Graph:
    """Scalar operations; a node is the number of one, in the order of evaluation."""

    def __init__(self) -> None:
        self._nodes: list[_Key] = []
        self._numbers: dict[_Key, int] = {}
        self._derivatives: dict[int, Derivatives] = {}

    def input(self, index: int) -> int:
        """Returns the node of an input."""
        return self._node((tapes.INPUT, index, -1))

    def constant(self, value: float) -> int:
        """Returns the node of a number."""
        return self._node((tapes.CONST, float(value), -1))

    def unary(self, operation: int, a: int) -> int:
        """Returns the node of an operation on one other."""
        if operation == tapes.ASSIGN:
            return a
        value = self._value(a)
        if value is not None and operation in _FUNCTIONS:
            return self.constant(_FUNCTIONS[operation](value))
        return self._node((operation, a, -1))

    def binary(self, operation: int, a: int, b: int) -> int:
        """Returns the node of an operation on two others, simplified."""
        first = self._value(a)
        second = self._value(b)
        if first is not None and second is not None and operation in _FUNCTIONS:
            return self.constant(_FUNCTIONS[operation](first, second))
        if operation == tapes.ADD and first == 0.0:
            return b
        if operation in (tapes.ADD, tapes.SUB) and second == 0.0:
            return a
        if operation == tapes.SUB and first == 0.0:
            return self.unary(tapes.NEG, b)
        if operation == tapes.MUL:
            if first == 0.0 or second == 0.0:
                return self.constant(0.0)
            if first in (1.0, -1.0):
                return b if first > 0 else self.unary(tapes.NEG, b)
            if second in (1.0, -1.0):
                return a if second > 0 else self.unary(tapes.NEG, a)
        if operation == tapes.DIV and second == 1.0:
            return a
        if operation in (tapes.POW, tapes.CONSTPOW) and second is not None:
            return self._power(a, second)
        return self._node((operation, a, b))

    def _power(self, a: int, exponent: float) -> int:
        """Returns the node of a power with a constant exponent."""
        if exponent == 0.0:
            return self.constant(1.0)
        if exponent == 1.0:
            return a
        if exponent == 2.0:
            return self.unary(tapes.SQ, a)
        return self._node((tapes.CONSTPOW, a, self.constant(exponent)))

    def derivatives(self, node: int) -> Derivatives:
        """Returns the nodes of a node's derivatives by the inputs."""
        for earlier in range(node + 1):  # no recursion: graphs are thousands deep
            if earlier not in self._derivatives:
                self._derivatives[earlier] = self._differentiate(earlier)
        return self._derivatives[node]

    def _differentiate(self, node: int) -> Derivatives:
        """Returns the derivatives of a node, given those of its operands."""
        operation, a, b = self._nodes[node]
        if operation == tapes.INPUT:
            return {int(a): self.constant(1.0)}
        if operation == tapes.CONST:
            return {}
        a = int(a)
        if operation == tapes.IF_ELSE_ZERO:
            slopes = self._derivatives.get(b, {}).items()
            return {c: self.binary(operation, a, slope) for c, slope in slopes}
        if operation in _UNARY:
            slopes_by_operand = [(a, self._by_operand(node, operation, a))]
        else:
            slopes_by_operand = [
                (a, self._by_first(node, operation, a, b)),
                (b, self._by_second(node, operation, a, b)),
            ]
        derivatives: Derivatives = {}
        for operand, slope in slopes_by_operand:
            for column, derivative in self._derivatives.get(operand, {}).items():
                term = self.binary(tapes.MUL, slope, derivative)
                if column in derivatives:
                    term = self.binary(tapes.ADD, derivatives[column], term)
                derivatives[column] = term
        zero = self.constant(0.0)
        return {column: d for column, d in derivatives.items() if d != zero}

    def _by_operand(self, node: int, operation: int, a: int) -> int:
        """Returns the derivative of an operation on one operand; of steps it is 0."""
        one = self.constant(1.0)
        if operation in (tapes.SIN, tapes.COS):
            cosine = self.unary(tapes.COS, a)
            minus_sine = self.unary(tapes.NEG, self.unary(tapes.SIN, a))
            return cosine if operation == tapes.SIN else minus_sine
        if operation == tapes.NEG:
            return self.constant(-1.0)
        if operation == tapes.SQ:
            return self.unary(tapes.TWICE, a)
        if operation == tapes.TWICE:
            return self.constant(2.0)
        if operation == tapes.INV:
            return self.unary(tapes.NEG, self.binary(tapes.MUL, node, node))
        if operation == tapes.SQRT:
            return self.binary(tapes.DIV, self.constant(0.5), node)
        if operation == tapes.FABS:
            return self.unary(tapes.SIGN, a)
        if operation in (tapes.EXP, tapes.EXPM1):
            return self.unary(tapes.EXP, a)
        if operation == tapes.LOG:
            return self.unary(tapes.INV, a)
        if operation == tapes.LOG1P:
            return self.unary(tapes.INV, self.binary(tapes.ADD, one, a))
        if operation == tapes.ERF:
            square = self.unary(tapes.SQ, a)
            bell = self.unary(tapes.EXP, self.unary(tapes.NEG, square))
            factor = self.constant(2.0 / math.sqrt(math.pi))
            return self.binary(tapes.MUL, factor, bell)
        return self._by_angle(node, operation, a)

    def _by_angle(self, node: int, operation: int, a: int) -> int:
        """The same for tangents, inverse and hyperbolic functions."""
        one = self.constant(1.0)
        square = self.unary(tapes.SQ, a)
        if operation == tapes.TAN:
            return self.binary(tapes.ADD, one, self.binary(tapes.MUL, node, node))
        if operation == tapes.TANH:
            return self.binary(tapes.SUB, one, self.binary(tapes.MUL, node, node))
        if operation == tapes.SINH:
            return self.unary(tapes.COSH, a)
        if operation == tapes.COSH:
            return self.unary(tapes.SINH, a)
        if operation == tapes.ATAN:
            return self.unary(tapes.INV, self.binary(tapes.ADD, one, square))
        if operation == tapes.ATANH:
            return self.unary(tapes.INV, self.binary(tapes.SUB, one, square))
        radicands = {
            tapes.ASIN: self.binary(tapes.SUB, one, square),
            tapes.ACOS: self.binary(tapes.SUB, one, square),
            tapes.ASINH: self.binary(tapes.ADD, one, square),
            tapes.ACOSH: self.binary(tapes.SUB, square, one),
        }
        if operation not in radicands:
            return self.constant(0.0)
        root = self.unary(tapes.SQRT, radicands[operation])
        slope = self.unary(tapes.INV, root)
        return self.unary(tapes.NEG, slope) if operation == tapes.ACOS else slope

    def _by_first(self, node: int, operation: int, a: int, b: int) -> int:
        """Returns the derivative by the first of two operands; of comparisons 0."""
        one = self.constant(1.0)
        if operation in (tapes.ADD, tapes.SUB, tapes.FMOD):
            return one
        if operation == tapes.MUL:
            return b
        if operation == tapes.DIV:
            return self.binary(tapes.DIV, one, b)
        if operation == tapes.ATAN2:
            return self.binary(tapes.DIV, b, self._sum_of_squares(a, b))
        if operation == tapes.HYPOT:
            return self.binary(tapes.DIV, a, node)
        if operation == tapes.COPYSIGN:  # 1 where the sign stayed, else -1
            stayed = self.binary(tapes.EQ, node, a)
            return self.binary(tapes.SUB, self.unary(tapes.TWICE, stayed), one)
        if operation in (tapes.FMIN, tapes.FMAX):
            return self.binary(tapes.EQ, node, a)
        if operation in (tapes.POW, tapes.CONSTPOW):
            lower = self.binary(tapes.SUB, b, one)
            power = self.binary(operation, a, lower)
            return self.binary(tapes.MUL, b, power)
        return self.constant(0.0)

    def _by_second(self, node: int, operation: int, a: int, b: int) -> int:
        """Returns the derivative by the second of two operands; of comparisons 0."""
        one = self.constant(1.0)
        if operation == tapes.ADD:
            return one
        if operation == tapes.SUB:
            return self.constant(-1.0)
        if operation == tapes.MUL:
            return a
        if operation == tapes.DIV:
            return self.unary(tapes.NEG, self.binary(tapes.DIV, node, b))
        if operation == tapes.ATAN2:
            slope = self.binary(tapes.DIV, a, self._sum_of_squares(a, b))
            return self.unary(tapes.NEG, slope)
        if operation == tapes.HYPOT:
            return self.binary(tapes.DIV, b, node)
        if operation in (tapes.FMIN, tapes.FMAX):
            return self.binary(tapes.SUB, one, self._by_first(node, operation, a, b))
        if operation == tapes.FMOD:  # minus the whole quotient
            multiple = self.binary(tapes.SUB, node, a)
            return self.binary(tapes.DIV, multiple, b)
        if operation == tapes.POW:  # zero where there is no logarithm
            slope = self.binary(tapes.MUL, self.unary(tapes.LOG, a), node)
            is_positive = self.binary(tapes.LT, self.constant(0.0), a)
            return self.binary(tapes.IF_ELSE_ZERO, is_positive, slope)
        return self.constant(0.0)

    def _sum_of_squares(self, a: int, b: int) -> int:
        """Returns the node of a^2 + b^2."""
        squares = [self.unary(tapes.SQ, operand) for operand in (a, b)]
        return self.binary(tapes.ADD, *squares)

    def statements(
        self,
        results: Sequence[tuple[str, int]],
        inputs: Sequence[str],
        numbers: Numbers,
    ) -> list[str]:
        """Returns the lines of C that compute results.

        Args:
            results: Where each goes, such as ``value[0]``, and its node.
            inputs: Names of the inputs, by number.
            numbers: Of the precision.
        """
        needed = self._needed([node for _, node in results])
        names: dict[int, str] = {}
        lines = []
        for node in sorted(needed):
            operation, a, b = self._nodes[node]
            if operation == tapes.INPUT:
                names[node] = inputs[int(a)]
                continue
            if operation == tapes.CONST:
                text = numbers.number(float(a))
                names[node] = f"({text})" if text.startswith("-") else text
                continue
            form = _BINARY.get(operation) or _UNARY[operation]
            text = form.format(a=names[int(a)], b=names.get(b, ""))
            names[node] = f"v{node}"
            lines.append(f"const real v{node} = {text};")
        lines += [f"{place} = {names[node]};" for place, node in results]
        return lines

    def _needed(self, nodes: Sequence[int]) -> set[int]:
        """Returns the nodes that others are computed from, with these."""
        needed: set[int] = set()
        waiting = list(nodes)
        while waiting:
            node = waiting.pop()
            if node in needed:
                continue
            needed.add(node)
            operation, a, b = self._nodes[node]
            if operation not in (tapes.INPUT, tapes.CONST):
                waiting.append(int(a))
                if b >= 0:
                    waiting.append(b)
        return needed

    def _node(self, key: _Key) -> int:
        number = self._numbers.get(key)
        if number is None:
            number = len(self._nodes)
            self._nodes.append(key)
            self._numbers[key] = number
        return number

    def _value(self, node: int) -> float | None:
        operation, value, _ = self._nodes[node]
        return float(value) if operation == tapes.CONST else None


def graph_of_tape(tape: tapes.Tape) -> tuple[Graph, list[int]]:
    """Returns a tape as a graph, and the nodes of its value (size,)."""
    graph = Graph()
    places: dict[int, int] = {}
    value = [graph.constant(0.0)] * tape.size
    for row, constant in zip(tape.code.tolist(), tape.constants, strict=True):
        operation, target, first, second = row
        if operation == tapes.OUTPUT:
            value[target] = places[first]
        elif operation == tapes.INPUT:
            places[target] = graph.input(first)
        elif operation == tapes.CONST:
            places[target] = graph.constant(constant)
        elif operation in tapes.TWO_OPERANDS:
            places[target] = graph.binary(operation, places[first], places[second])
        else:
            places[target] = graph.unary(operation, places[first])
    return graph, value


def value_lines(
    graph: Graph, value: Sequence[int], inputs: Sequence[str], numbers: Numbers
) -> list[str]:
    """Returns the lines that write ``value[i]``."""
    results = [(f"value[{i}]", node) for i, node in enumerate(value)]
    return graph.statements(results, inputs, numbers)


def expansion_lines(
    graph: Graph,
    value: Sequence[int],
    inputs: Sequence[str],
    numbers: Numbers,
    columns: Sequence[int] | None = None,
    width: int | None = None,
) -> list[str]:
    """Returns the lines that write ``value[i]`` and ``jacobian[i * width + column]``.

    Entries of the Jacobian that are always zero are not written.

    Args:
        graph: Of the function.
        value: Nodes of its value.
        inputs: Names of its inputs.
        numbers: Of the precision.
        columns: Of the inputs in the Jacobian; by default their numbers.
        width: Columns of the Jacobian, beyond which none is written; by default the
            number of inputs.
    """
    width = len(inputs) if width is None else width
    columns = range(len(inputs)) if columns is None else columns
    results = [(f"value[{i}]", node) for i, node in enumerate(value)]
    for i, node in enumerate(value):
        for number, derivative in sorted(graph.derivatives(node).items()):
            if columns[number] < width:
                place = i * width + columns[number]
                results.append((f"jacobian[{place}]", derivative))
    return graph.statements(results, inputs, numbers)
