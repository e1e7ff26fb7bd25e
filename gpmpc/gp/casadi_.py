"""A learned model as a CasADi function, for users with an optimal control problem and IPOPT of their own.

    mean_a = offset_a + sum_i beta_ai k_ai (+ x_a),   variance_a = sf2_a - |L_a^-1 k_a|^2,   k_ai = k_a(x~_i, x~)

is written with a dozen matrix nodes of CasADi's MX, whatever N, from which CasADi derives exact Jacobians and Hessians
(Andersson, Gillis, Horn, Rawlings and Diehl, 2019). Importing this file loads CasADi; ``gpmpc.gp`` does not.
"""

import math
from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np
import torch

from gpmpc._functions import DYNAMICS_RULE, call_dynamics
from gpmpc._kernels import tape as tapes
from gpmpc.exceptions import DataError, SettingError, UnsupportedModel
from gpmpc.gp._posterior import GPPosterior

Array = np.ndarray


def casadi_function(model: Any, name: str = "gp") -> casadi.Function:
    """Builds ``model.predict`` as a CasADi function (state, input) -> (mean, variance), in physical units.

    Over a horizon use ``function.map(H)``, which takes columns (n, H) and (m, H).

    Args:
        model: A posterior, or a residual model whose nominal model and effect are numbers (``Affine``, a tensor) or
            written in CasADi (``CasadiFunction``); it is evaluated in double precision.
        name: Of the function.

    Returns:
        A function of ``state`` (n,) and ``input`` (m,) that gives ``mean`` (k,) and ``variance`` (k,), the diagonal of
        the predicted covariance, without observation noise. The mean is of the next state (a model of differences
        has added the state), or of the value that the model predicts.

    Raises:
        UnsupportedModel: The nominal model or the effect is a Python function, or it is another model.
    """
    x = casadi.MX.sym("state", model.state_dim)
    u = casadi.MX.sym("input", model.input_dim)
    if isinstance(model, GPPosterior):
        mean, variance = _moments(model, x, u)
        mean = mean + x if model.predicts == "difference" else mean
    else:
        mean, variance = _residual(model, x, u)
    return casadi.Function(
        name, [x, u], [mean, variance], ["state", "input"], ["mean", "variance"]
    )


def successor_function(plant: Any) -> casadi.Function:
    """Writes the next state of a plant, such as a ``System``, as a CasADi function of state (n,) and input (m,)."""
    x = casadi.SX.sym("x", len(plant.dynamics.state_names))
    u = casadi.SX.sym("u", len(plant.dynamics.input_names))
    entries = call_dynamics(plant.successor, x, u)
    function = casadi.Function("successor", [x, u], [casadi.vertcat(*entries)])
    _check_numbers(function)
    return function


def _check_numbers(function: casadi.Function) -> None:
    """Raises ``SettingError`` for a NaN: what math makes of a CasADi symbol."""
    instructions = function.n_instructions() if function.is_a("SXFunction") else 0
    for i in range(instructions):
        constant = function.instruction_id(i) == casadi.OP_CONST
        if constant and math.isnan(function.instruction_constant(i)):
            got = "NaN, which math.sin and its like make of a CasADi expression"
            raise SettingError("dynamics", f"{DYNAMICS_RULE}; got {got}")


def _residual(model: Any, x: casadi.MX, u: casadi.MX) -> tuple[casadi.MX, casadi.MX]:
    """Mean and variance (n,) of a residual model whose functions are numbers or written in CasADi."""
    nominal: Any = getattr(model, "nominal", None)
    B: Any = getattr(model, "B", None)
    known: Any = getattr(nominal, "function", None)
    effect: Any = getattr(B, "function", None)
    affine = all(hasattr(nominal, part) for part in "ABc")
    if not (known is not None or affine) or not (
        effect is not None or isinstance(B, torch.Tensor)
    ):
        got = type(model).__name__ + (
            f" of a nominal {type(nominal).__name__}" if nominal is not None else ""
        )
        raise UnsupportedModel(
            f"CasADi can take a GPPosterior, or a ResidualModel of Affine, CasadiFunction and numbers; got {got}"
        )
    seen: list[Any] = []  # angles as sine and cosine
    for i in model.states:
        seen += [casadi.sin(x[i]), casadi.cos(x[i])] if i in model.angles else [x[i]]
    features, selected = (
        casadi.vertcat(casadi.MX(0, 1), *some)
        for some in (seen, [u[i] for i in model.inputs])
    )
    mean, variance = _moments(model.residual, features, selected)
    matrix = _numbers(B) if effect is None else effect(x)
    if affine:
        A, G, c = (_numbers(getattr(nominal, part)) for part in "ABc")
        moved = A @ x + G @ u + c
    else:
        moved = nominal.function(x, u)
    return moved + matrix @ mean, matrix**2 @ variance


def _moments(
    gp: GPPosterior, x: casadi.MX, u: casadi.MX
) -> tuple[casadi.MX, casadi.MX]:
    """Mean (k,) and variance (k,) of the GPs at x and u."""
    points = _numbers(gp.features)
    size = len(gp)
    difference = points - casadi.repmat(casadi.vertcat(x, u).T, size, 1)  # (N, d)
    exponents = (
        difference**2 @ _numbers(gp.lengthscales.mT.double() ** -2) / -2
    )  # (N, k)
    k = casadi.exp(exponents) * casadi.repmat(_numbers(gp.signal_variance).T, size, 1)
    mean = casadi.sum1(k * _numbers(gp.weights.mT)).T + _numbers(gp.offset)
    variance = []
    lower = casadi.Sparsity.lower(size)
    for a, column in enumerate(casadi.horzsplit(k)):
        # The factor's inverse, since CasADi cannot serialise its triangular solve; both lose the same digits.
        eye = torch.eye(size, dtype=torch.float64)
        inverse = torch.linalg.solve_triangular(
            gp.cholesky[a].detach().double().cpu(), eye, upper=False
        )
        entries = casadi.DM(lower, inverse.numpy().T[np.triu_indices(size)])
        variance.append(
            casadi.fmax(
                0, float(gp.signal_variance[a]) - casadi.sumsqr(entries @ column)
            )
        )
    return mean, casadi.vertcat(*variance)


def _numbers(tensor: torch.Tensor) -> casadi.DM:
    return casadi.DM(tensor.detach().double().cpu().numpy())


def tape_of(function: casadi.Function) -> tapes.Tape | None:
    """Reads the operations of a CasADi function of dense vectors; None where there are others than a tape has.

    The value is taken column by column, the arguments one after the other.
    """
    try:
        function = function if function.is_a("SXFunction") else function.expand()
    except RuntimeError:  # it calls what is no expression
        return None
    if not all(function.sparsity_in(i).is_dense() for i in range(function.n_in())):
        return None
    sizes = [function.numel_in(i) for i in range(function.n_in())]
    first = np.concatenate([[0], np.cumsum(sizes)])
    places = function.sparsity_out(0).find()
    code = np.zeros((function.n_instructions(), 4), dtype=np.int64)
    constants = np.zeros(len(code))
    for k, row in enumerate(code):
        row[0] = function.instruction_id(k)
        inputs = function.instruction_input(k)
        outputs = function.instruction_output(k)
        if row[0] not in tapes.OPERATIONS:
            return None
        row[1] = places[outputs[1]] if row[0] == tapes.OUTPUT else outputs[0]
        if row[0] == tapes.INPUT:
            row[2] = first[inputs[0]] + inputs[1]
        elif row[0] == tapes.CONST:
            constants[k] = function.instruction_constant(k)
        else:
            row[2 : 2 + len(inputs)] = inputs
            row[3] = inputs[-1]
    return tapes.Tape(code, constants, function.sz_w(), function.numel_out(0))


def function_of_tape(
    code: Array, constants: Array, sizes: Sequence[int], shape: Sequence[int]
) -> casadi.Function:
    """Writes a tape as a CasADi function again: the inverse of ``tape_of``.

    Its arguments and its value are made as large as ``sizes`` and ``shape`` say: who has
    them from a file compares them with something first.

    Raises:
        DataError: Code (K, 4) and constants (K,) are no tape's, or a size is none.
    """
    rows = _tape_rows(code, constants)
    for size in (*sizes, *shape):
        if type(size) is not int or size < 0:
            raise DataError(
                f"a size must be a whole number, zero or more; got {size!r}"
            )
    arguments = [casadi.SX.sym(f"argument{i}", size) for i, size in enumerate(sizes)]
    entries: Any = casadi.vertcat(*arguments).elements()
    count = shape[0] * shape[1]
    work: dict[int, casadi.SX] = {}
    value: dict[int, casadi.SX] = {}
    try:
        for (operation, to, first, last), constant in zip(
            rows, constants.tolist(), strict=True
        ):
            if operation == tapes.OUTPUT:
                value[to] = work[first]
            elif operation == tapes.INPUT:
                work[to] = entries[first]
            elif operation == tapes.CONST:
                work[to] = casadi.SX(constant)
            elif operation in tapes.TWO_OPERANDS:
                work[to] = casadi.SX.binary(operation, work[first], work[last])
            elif operation in tapes.OPERATIONS:
                work[to] = casadi.SX.unary(operation, work[first])
            else:
                raise DataError(f"there is no operation {operation}")
    except (IndexError, KeyError, RuntimeError, ValueError) as error:
        raise DataError(
            f"a function's operations do not follow from each other ({error})"
        ) from error
    places = sorted(value)
    if places and places[-1] >= count:
        raise DataError(f"a value of {count} entries has none at {places[-1]}")
    # Made at once: an entry that is added to a sparse vector moves all those behind it.
    sparsity = casadi.Sparsity(count, 1, [0, len(places)], places)
    column = casadi.SX(sparsity, casadi.vertcat(*(value[place] for place in places)))
    return casadi.Function("function", arguments, [casadi.reshape(column, *shape)])


def _tape_rows(code: Array, constants: Array) -> list[list[int]]:
    """The rows of a tape's code as whole numbers; ``DataError`` where they are none."""
    if code.ndim != 2 or code.shape[1] != 4 or constants.shape != code.shape[:1]:
        raise DataError(
            f"code (K, 4) and constants (K,) must be of equal length; "
            f"got {code.shape} and {constants.shape}"
        )
    whole = (code >= 0) & (code < 2**31) & (code == np.floor(code))
    if not whole.all():
        raise DataError(
            f"code must be whole numbers, zero or more; got {code[~whole][0]}"
        )
    return code.astype(np.int64).tolist()
