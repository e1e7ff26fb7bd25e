"""Smooth constraints and outputs of the cost as C."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.export._expressions import expansion_lines, graph_of_tape
from gpmpc.export._text import Numbers, function, unused
from gpmpc.models import CasadiFunction
from gpmpc.mpc import GPMPC, Inequality
from gpmpc.mpc._controller import parameters_by_stage
from gpmpc.mpc._cost import by_stage


class FunctionWriter:
    """Writes the functions that a controller linearises along its plans.

    Attributes:
        text: All that was written.

    Raises:
        SettingError: One of them is no CasADi function of elementary operations.
        ShapeError: One takes others of states and inputs, or gives more or fewer
            values than it says; or two take other numbers of parameters.
    """

    def __init__(self, controller: GPMPC, numbers: Numbers):
        self._numbers = numbers
        self._n = controller.prediction.state_dim
        self._m = controller.prediction.input_dim
        self._horizon = controller.horizon
        self._parts: list[str] = []
        self._parameters: int | None = None  # none takes some so far
        if controller.prediction.constraints.smooth:
            self._write_constraints(controller)
        if controller.problem.outputs:
            self._write_outputs(controller.problem.outputs)
        self.text = "\n".join(self._parts)

    @property
    def parameters(self) -> int:
        """How many parameters the functions take, q."""
        return self._parameters or 0

    def _write_constraints(self, controller: GPMPC) -> None:
        """Writes h(x, u, p) of all rows, with their gradients."""
        n = self._n
        m = self._m
        rows = 0
        body = []
        for i, constraint in enumerate(controller.problem.constraints):
            count = len(constraint.rows(self._horizon).F)
            if isinstance(constraint, Inequality):
                name = f"inequality{i}"
                note = f"h(x, u, p) of constraint {i}, and its derivatives by (x, u)"
                self._write_function("h", constraint.h, constraint.count, name, note)
                body += [
                    "{",
                    f"    real value[{count}];",
                    f"    real jacobian[{count * (n + m)}];",
                    "    int i;",
                    f"    {name}(x, u, p, value, jacobian);",
                    f"    for (i = 0; i < {count}; i++) {{",
                    f"        h[{rows} + i] = value[i];",
                    f"        copy(jacobian + i * (n + m), E + ({rows} + i) * n, n);",
                    "        copy(jacobian + i * (n + m) + n,",
                    f"             D + ({rows} + i) * m, m);",
                    "    }",
                    "}",
                ]
            rows += count
        signature = (
            "static void constraints(const real *x, const real *u, const real *p,\n"
            "    real *h, real *E, real *D)"
        )
        self._function(signature, body, "h(x, u, p) <= 0 of all rows, and E, D by x, u")

    def _write_outputs(self, outputs: Sequence[Any]) -> None:
        """Writes the squares Z = [J, e]' W [J, e] of the outputs along a plan."""
        body = [
            "int finite = 1;",
            "int k, i, j, l;",
            "fill(&problem->Z[0][0][0], 0,",
            "     H * GPMPC_AUGMENTED * GPMPC_AUGMENTED);",
            "for (k = 0; k < H; k++) {",
            "    const real *x = problem->states[k + 1];",
            "    const real *u = problem->inputs[k];",
            "    const real *p = reference->parameters[k];",
        ]
        for i, output in enumerate(outputs):
            name = f"output{i}"
            count = output.weight.shape[-1]
            note = f"y(x, u, p) of output {i}, and its derivatives by (x, u)"
            self._write_function("y", output.y, count, name, note)
            weight = by_stage("weight", output.weight, self._horizon, 2)
            centre = by_stage("reference", output.reference, self._horizon, 1)
            table = self._numbers.table
            self._parts.append(table(f"{name}_weight", weight, "W (H, d, d)"))
            self._parts.append(table(f"{name}_reference", centre, "c (H, d)"))
            body += ["    " + line for line in _square_lines(name, count)]
        body += ["}", "return finite;"]
        signature = (
            "static int write_outputs(gpmpc_problem *problem,\n"
            "    const gpmpc_reference *reference)"
        )
        self._function(signature, body, "squares of y(x, u, p) - c along the plan")

    def _write_function(
        self, key: str, smooth: Any, count: int, name: str, note: str
    ) -> None:
        """Writes a function of (x, u, p) with its derivatives by x and u."""
        if not hasattr(smooth, "n_in"):
            rule = "an exported function is one of CasADi"
            raise SettingError(key, f"{rule}; got {type(smooth).__name__}")
        wrapped = CasadiFunction(smooth)
        if wrapped.tape is None:
            rule = "an exported function is made of elementary operations"
            raise SettingError(key, f"{rule}; got {smooth}")
        self._check_sizes(key, wrapped, count)
        inputs: list[str] = []
        columns: list[int] = []
        first_columns = (0, self._n, self._n + self._m)
        # functions of the state alone, or of state and input, are shorter
        arguments = zip("xup", first_columns, wrapped.sizes, strict=False)
        for argument, first, size in arguments:
            inputs += [f"{argument}[{i}]" for i in range(size)]
            columns += range(first, first + size)
        graph, value = graph_of_tape(wrapped.tape)
        lines = expansion_lines(
            graph,
            value,
            inputs,
            self._numbers,
            columns=columns,
            width=self._n + self._m,
        )
        signature = (
            f"static void {name}(const real *x, const real *u, const real *p,\n"
            "    real *value, real *jacobian)"
        )
        size = count * (self._n + self._m)
        self._function(
            signature,
            [*unused("xup", lines), f"fill(jacobian, 0, {size});", *lines],
            note,
        )

    def _check_sizes(self, key: str, function: CasadiFunction, count: int) -> None:
        """Raises ``ShapeError`` unless the arrays of C hold arguments and values."""
        sizes = function.sizes
        if self._parameters is None and len(sizes) == 3:
            self._parameters = sizes[2]
        taken = [self._n, self._m, self._parameters]
        if sizes != taken[: len(sizes)] or function.shape != (count, 1):
            rule = f"{key} must map x ({self._n},), u ({self._m},)"
            if self._parameters is not None:
                rule = f"{rule}, p ({self._parameters},)"
            raise ShapeError(f"{rule} to ({count},); got {function.function}")

    def _function(self, signature: str, body: Sequence[str], note: str) -> None:
        """Writes a function, what it computes above it."""
        self._parts.append(function(signature, body, note))


def parameter_rows(parameters: Any, horizon: int, count: int) -> np.ndarray:
    """Returns parameters by stage (H, q) as the code takes them.

    Args:
        parameters: (q,) or (H, q), or None.
        horizon: H.
        count: q of the controller.

    Raises:
        ShapeError: They are of another number.
        SettingError: There are none where functions take some.
    """
    if parameters is None and count:
        rule = f"must come with every call: the controller's functions take {count}"
        raise SettingError("parameters", f"{rule}; got none")
    if parameters is None:
        return np.zeros((horizon, 0))
    rows = parameters_by_stage(parameters, horizon)
    if rows.shape != (horizon, count):
        rule = f"the controller's functions take {count} parameters a stage"
        raise ShapeError(f"{rule}; got {rows.shape}")
    return rows


def _square_lines(name: str, count: int) -> list[str]:
    """Returns the lines that add the square of one output to Z of stage k."""
    return [
        "{",
        f"    real value[{count}];",
        f"    real jacobian[{count} * (n + m)];",
        f"    real rows[{count} * GPMPC_AUGMENTED];",
        f"    const real *W = {name}_weight + k * {count * count};",
        f"    {name}(x, u, p, value, jacobian);",
        f"    finite = finite && all_finite(value, {count})",
        f"             && all_finite(jacobian, {count} * (n + m));",
        f"    for (i = 0; i < {count}; i++) {{",
        "        real *row = rows + i * GPMPC_AUGMENTED;",
        "        copy(jacobian + i * (n + m), row, n + m);",
        f"        row[n + m] = value[i] - {name}_reference[k * {count} + i]",
        "                     - dot(row, x, n) - dot(row + n, u, m);",
        "    }",
        f"    for (i = 0; i < {count}; i++)",
        f"        for (j = 0; j < {count}; j++)",
        "            for (l = 0; l < GPMPC_AUGMENTED; l++)",
        f"                add_scaled(W[i * {count} + j]",
        "                           * rows[i * GPMPC_AUGMENTED + l],",
        "                           rows + j * GPMPC_AUGMENTED, problem->Z[k][l],",
        "                           GPMPC_AUGMENTED);",
        "}",
    ]
