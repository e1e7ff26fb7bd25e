"""Functions as graphs of scalar operations, their derivatives, and both as C.

A graph holds each operation once. Derivatives are carried forwards, entry by entry, as
operations of the same graph: what is zero is left out, and what value and derivatives
share is computed once (Griewank and Walther, 2008, chapters 3 and 6).
"""

import math
from collections.abc import Callable, Sequence

from gpmpc._kernels import tape as tapes
from gpmpc.export._text import Numbers

#: operations that only derivatives have: 1 where a <= b, and where a < b, else 0
_AT_MOST = 100
_BELOW = 101

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
}
_BINARY: dict[int, str] = {
    tapes.ADD: "{a} + {b}",
    tapes.SUB: "{a} - {b}",
    tapes.MUL: "{a} * {b}",
    tapes.DIV: "{a} / {b}",
    tapes.POW: "POW({a}, {b})",
    tapes.CONSTPOW: "POW({a}, {b})",
    tapes.FMIN: "smaller({a}, {b})",
    tapes.FMAX: "larger({a}, {b})",
    tapes.ATAN2: "ATAN2({a}, {b})",
    _AT_MOST: "(real)({a} <= {b})",
    _BELOW: "(real)({a} < {b})",
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
            if first == 1.0:
                return b
            if second == 1.0:
                return a
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
        partials = [(a, self._by_first)]
        if operation in _BINARY:
            partials.append((b, self._by_second))
        derivatives: Derivatives = {}
        for operand, partial in partials:
            inner = self._derivatives.get(operand, {})
            if not inner:
                continue
            slope = partial(node, operation, a, b)
            for column, derivative in inner.items():
                term = self.binary(tapes.MUL, slope, derivative)
                if column in derivatives:
                    term = self.binary(tapes.ADD, derivatives[column], term)
                derivatives[column] = term
        zero = self.constant(0.0)
        return {column: d for column, d in derivatives.items() if d != zero}

    def _by_first(self, node: int, operation: int, a: int, b: int) -> int:
        """Returns the derivative of an operation by its first operand."""
        one = self.constant(1.0)
        square = self.unary(tapes.SQ, a)
        if operation in (tapes.ADD, tapes.SUB):
            return one
        if operation == tapes.MUL:
            return b
        if operation == tapes.DIV:
            return self.binary(tapes.DIV, one, b)
        if operation == tapes.NEG:
            return self.constant(-1.0)
        if operation == tapes.SQ:
            return self.unary(tapes.TWICE, a)
        if operation == tapes.TWICE:
            return self.constant(2.0)
        if operation == tapes.INV:
            return self.unary(tapes.NEG, self.binary(tapes.MUL, node, node))
        if operation == tapes.EXP:
            return node
        if operation == tapes.LOG:
            return self.unary(tapes.INV, a)
        if operation == tapes.SQRT:
            return self.binary(tapes.DIV, self.constant(0.5), node)
        if operation == tapes.SIN:
            return self.unary(tapes.COS, a)
        if operation == tapes.COS:
            return self.unary(tapes.NEG, self.unary(tapes.SIN, a))
        if operation == tapes.TAN:
            return self.binary(tapes.ADD, one, self.binary(tapes.MUL, node, node))
        if operation == tapes.ATAN:
            return self.unary(tapes.INV, self.binary(tapes.ADD, one, square))
        if operation == tapes.TANH:
            return self.binary(tapes.SUB, one, self.binary(tapes.MUL, node, node))
        if operation == tapes.ATAN2:
            squares = self.binary(tapes.ADD, square, self.unary(tapes.SQ, b))
            return self.binary(tapes.DIV, b, squares)
        if operation == tapes.FABS:
            zero = self.constant(0.0)
            return self.binary(
                tapes.SUB,
                self.binary(_BELOW, zero, a),
                self.binary(_BELOW, a, zero),
            )
        if operation == tapes.FMIN:
            return self.binary(_AT_MOST, a, b)
        if operation == tapes.FMAX:
            return self.binary(_AT_MOST, b, a)
        if operation in (tapes.POW, tapes.CONSTPOW):
            lower = self.binary(tapes.SUB, b, one)
            power = self.binary(operation, a, lower)
            return self.binary(tapes.MUL, b, power)
        return self.constant(0.0)  # of a comparison

    def _by_second(self, node: int, operation: int, a: int, b: int) -> int:
        """Returns the derivative of an operation by its second operand."""
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
            squares = self.binary(
                tapes.ADD, self.unary(tapes.SQ, a), self.unary(tapes.SQ, b)
            )
            return self.unary(tapes.NEG, self.binary(tapes.DIV, a, squares))
        if operation in (tapes.FMIN, tapes.FMAX):
            return self.binary(tapes.SUB, one, self._by_first(node, operation, a, b))
        if operation == tapes.POW:
            return self.binary(tapes.MUL, self.unary(tapes.LOG, a), node)
        return self.constant(0.0)

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
        operation, target, first, last = row
        if operation == tapes.OUTPUT:
            value[target] = places[first]
        elif operation == tapes.INPUT:
            places[target] = graph.input(first)
        elif operation == tapes.CONST:
            places[target] = graph.constant(constant)
        elif operation in tapes.TWO_OPERANDS:
            places[target] = graph.binary(operation, places[first], places[last])
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
