"""A learned model as a CasADi function, for optimal control problems of one's own.

    mean_a     = offset_a + sum_i beta_ai k_ai (+ x_a)
    variance_a = sf2_a - |L_a^-1 k_a|^2,               k_ai = k_a(x~_i, x~)

is written with a dozen matrix nodes of CasADi's MX, whatever N, from which CasADi
derives exact Jacobians and Hessians (Andersson, Gillis, Horn, Rawlings and Diehl,
2019). Expressions of CasADi become tapes for the compiled kernels (``tape_of``), and
tapes expressions. Importing this file loads CasADi; ``gpmpc.gp`` does not.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi
import numpy as np
import torch

from gpmpc._angles import TURN
from gpmpc._functions import DYNAMICS_RULE, call_dynamics
from gpmpc._kernels import tape as tapes
from gpmpc.exceptions import DataError, SettingError, UnsupportedModel
from gpmpc.gp._posterior import GPPosterior

Array = np.ndarray


class _Prediction(NamedTuple):
    """A prediction as an expression."""

    mean: casadi.MX  #: (k,)
    variance: casadi.MX  #: (k,)


def casadi_function(model: Any, name: str = "gp") -> casadi.Function:
    """Builds ``model.predict`` as a CasADi function (state, input) -> (mean, variance).

    All are in physical units. Over a horizon use ``function.map(H)``, which takes
    columns (n, H) and (m, H).

    Args:
        model: A posterior, or a residual model whose nominal model and effect are
            numbers (``Affine``, a tensor) or written in CasADi (``CasadiFunction``); it
            is evaluated in double precision.
        name: Of the function.

    Returns:
        A function of ``state`` (n,) and ``input`` (m,) that gives ``mean`` (k,) and
        ``variance`` (k,), the diagonal of the predicted covariance, without observation
        noise. The mean is of the next state (a model of differences has added the
        state), or of the value that the model predicts.

    Raises:
        UnsupportedModel: The nominal model or the effect is a Python function, or it is
            another model.
    """
    x = casadi.MX.sym("state", model.state_dim)
    u = casadi.MX.sym("input", model.input_dim)
    if isinstance(model, GPPosterior):
        mean, variance = _predict_gps(model, x, u)
        if model.predicts == "difference":
            mean = mean + x
    else:
        mean, variance = _predict_residual_model(model, x, u)
    return casadi.Function(
        name, [x, u], [mean, variance], ["state", "input"], ["mean", "variance"]
    )


def successor_function(plant: Any) -> casadi.Function:
    """Writes the next state of a plant as a CasADi function of state and input.

    Args:
        plant: Such as a ``System``.

    Raises:
        SettingError: Its dynamics cannot be written in CasADi.
    """
    x = casadi.SX.sym("x", len(plant.dynamics.state_names))
    u = casadi.SX.sym("u", len(plant.dynamics.input_names))
    entries = call_dynamics(plant.successor, x, u)
    function = casadi.Function("successor", [x, u], [casadi.vertcat(*entries)])
    _check_numbers(function)
    return function


def without_turns(function: casadi.Function, angles: Sequence[int]) -> casadi.Function:
    """Writes a next state without the whole turns that lie between it and the state.

    Args:
        function: Of the state (n,) and other vectors, to the next state (n,).
        angles: Indices of the states that are angles [rad].
    """
    try:
        function = function if function.is_a("SXFunction") else function.expand()
        symbol: Any = casadi.SX.sym
    except RuntimeError:  # it calls what is no expression
        symbol = casadi.MX.sym
    arguments: list[Any] = [
        symbol(f"argument{i}", function.size1_in(i)) for i in range(function.n_in())
    ]
    entries: list[Any] = casadi.vertsplit(function(*arguments))
    for i in angles:
        turns = casadi.floor((entries[i] - arguments[0][i]) / TURN + 0.5)
        entries[i] = entries[i] - TURN * turns
    return casadi.Function("counting", arguments, [casadi.vertcat(*entries)])


def _check_numbers(function: casadi.Function) -> None:
    """Raises ``SettingError`` for a NaN: what math makes of a CasADi symbol."""
    instructions = function.n_instructions() if function.is_a("SXFunction") else 0
    for i in range(instructions):
        constant = function.instruction_id(i) == casadi.OP_CONST
        if constant and math.isnan(function.instruction_constant(i)):
            got = "NaN, which math.sin and its like make of a CasADi expression"
            raise SettingError("dynamics", f"{DYNAMICS_RULE}; got {got}")


def _predict_residual_model(model: Any, x: casadi.MX, u: casadi.MX) -> _Prediction:
    """Predicts by a residual model of numbers and of functions written in CasADi."""
    nominal: Any = getattr(model, "nominal", None)
    B: Any = getattr(model, "B", None)
    is_affine = all(hasattr(nominal, part) for part in "ABc")
    nominal_function: Any = getattr(nominal, "function", None)
    effect_function: Any = getattr(B, "function", None)
    residual_known = isinstance(getattr(model, "residual", None), GPPosterior)
    nominal_known = is_affine or nominal_function is not None
    effect_known = isinstance(B, torch.Tensor) or effect_function is not None
    if not (residual_known and nominal_known and effect_known):
        got = type(model).__name__
        if nominal is not None:
            got += f" of a nominal {type(nominal).__name__}"
            got += f" and a {type(model.residual).__name__}"
        raise UnsupportedModel(
            "CasADi can take a GPPosterior, or a ResidualModel of one, Affine, "
            f"CasadiFunction and numbers; got {got}"
        )
    features: list[Any] = []
    for i in model.states:
        if i in model.angles:
            features += [casadi.sin(x[i]), casadi.cos(x[i])]
        else:
            features.append(x[i])
    inputs = [u[i] for i in model.inputs]
    residual = _predict_gps(model.residual, _column(features), _column(inputs))
    effect = _numbers(B) if effect_function is None else effect_function(x)
    if is_affine or nominal_function is None:
        A = _numbers(nominal.A)
        G = _numbers(nominal.B)
        c = _numbers(nominal.c)
        nominal_mean = A @ x + G @ u + c
    else:
        nominal_mean = nominal_function(x, u)
    return _Prediction(
        mean=nominal_mean + effect @ residual.mean,
        variance=effect**2 @ residual.variance,
    )


def _column(entries: list[Any]) -> casadi.MX:
    """Joins entries to a column, which may be empty."""
    return casadi.vertcat(casadi.MX(0, 1), *entries)


def _predict_gps(gp: GPPosterior, x: casadi.MX, u: casadi.MX) -> _Prediction:
    """Predicts the GPs at x and u."""
    size = len(gp)
    points = _numbers(gp.features)
    difference = points - casadi.repmat(casadi.vertcat(x, u).T, size, 1)  # (N, d)
    inverse_squares = _numbers(gp.lengthscales.mT.double() ** -2)
    exponents = difference**2 @ inverse_squares / -2  # (N, k)
    signal = casadi.repmat(_numbers(gp.signal_variance).T, size, 1)
    k = casadi.exp(exponents) * signal
    mean = casadi.sum1(k * _numbers(gp.weights.mT)).T + _numbers(gp.offset)
    variances = []
    lower = casadi.Sparsity.lower(size)
    eye = torch.eye(size, dtype=torch.float64, device="cpu")
    for a, column in enumerate(casadi.horzsplit(k)):
        # The factor's inverse, since CasADi cannot serialise its triangular solve; both
        # lose the same digits.
        factor = gp.cholesky[a].detach().double().cpu()
        inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
        entries = casadi.DM(lower, inverse.numpy().T[np.triu_indices(size)])
        reduction = casadi.sumsqr(entries @ column)
        variances.append(casadi.fmax(0, float(gp.signal_variance[a]) - reduction))
    return _Prediction(mean=mean, variance=casadi.vertcat(*variances))


def _numbers(tensor: torch.Tensor) -> casadi.DM:
    return casadi.DM(tensor.detach().double().cpu().numpy())


def tape_of(function: casadi.Function) -> tapes.Tape | None:
    """Reads the operations of a CasADi function of dense vectors.

    The value is taken column by column, the arguments one after the other. None where
    there are other operations than a tape has.
    """
    try:
        function = function if function.is_a("SXFunction") else function.expand()
    except RuntimeError:  # it calls what is no expression
        return None
    arguments = range(function.n_in())
    if not all(function.sparsity_in(i).is_dense() for i in arguments):
        return None
    sizes = [function.numel_in(i) for i in arguments]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    places = function.sparsity_out(0).find()
    code = np.zeros((function.n_instructions(), 4), dtype=np.int64)
    constants = np.zeros(len(code))
    for k, row in enumerate(code):
        operation = function.instruction_id(k)
        if operation not in tapes.OPERATIONS:
            return None
        operands = function.instruction_input(k)
        results = function.instruction_output(k)
        row[0] = operation
        row[1] = places[results[1]] if operation == tapes.OUTPUT else results[0]
        if operation == tapes.INPUT:
            argument, entry = operands
            row[2] = offsets[argument] + entry
        elif operation == tapes.CONST:
            constants[k] = function.instruction_constant(k)
        else:
            row[2 : 2 + len(operands)] = operands
            row[3] = operands[-1]
    return tapes.Tape(
        code=code,
        constants=constants,
        places=function.sz_w(),
        size=function.numel_out(0),
    )


def function_of_tape(
    code: Array, constants: Array, sizes: Sequence[int], shape: Sequence[int]
) -> casadi.Function:
    """Writes a tape as a CasADi function again: the inverse of ``tape_of``.

    Its arguments and its value are made as large as ``sizes`` and ``shape`` say: who
    has them from a file compares them with something first.

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
    entries = _run_tape(rows, constants.tolist(), casadi.vertcat(*arguments))
    places = sorted(entries)
    count = shape[0] * shape[1]
    if places and places[-1] >= count:
        raise DataError(f"a value of {count} entries has none at {places[-1]}")
    # Made at once: an entry that is added to a sparse vector moves all those behind it.
    sparsity = casadi.Sparsity(count, 1, [0, len(places)], places)
    column = casadi.SX(sparsity, casadi.vertcat(*(entries[place] for place in places)))
    return casadi.Function("function", arguments, [casadi.reshape(column, *shape)])


def _run_tape(
    rows: list[list[int]], constants: list[float], arguments: casadi.SX
) -> dict[int, casadi.SX]:
    """Runs the operations of a tape; returns the entries of its value by their place.

    Raises:
        DataError: An operation is unknown, or takes what there is not.
    """
    elements: Any = arguments.elements()
    work: dict[int, casadi.SX] = {}
    value: dict[int, casadi.SX] = {}
    try:
        for row, constant in zip(rows, constants, strict=True):
            operation, target, first, second = row
            if operation == tapes.OUTPUT:
                value[target] = work[first]
            elif operation == tapes.INPUT:
                work[target] = elements[first]
            elif operation == tapes.CONST:
                work[target] = casadi.SX(constant)
            elif operation in tapes.TWO_OPERANDS:
                work[target] = casadi.SX.binary(operation, work[first], work[second])
            elif operation in tapes.OPERATIONS:
                work[target] = casadi.SX.unary(operation, work[first])
            else:
                raise DataError(f"there is no operation {operation}")
    except (IndexError, KeyError, RuntimeError, ValueError) as error:
        raise DataError(
            f"a function's operations do not follow from each other ({error})"
        ) from error
    return value


def _tape_rows(code: Array, constants: Array) -> list[list[int]]:
    """Reads the rows of a tape's code as whole numbers.

    Raises:
        DataError: They are none.
    """
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


def jacobian_of(function: casadi.Function) -> casadi.Function:
    """Returns the derivatives of a value by all arguments side by side.

    Entries of the value are taken column by column.
    """
    is_tape = function.is_a("SXFunction")
    arguments: list[Any] = function.sx_in() if is_tape else function.mx_in()
    value = casadi.vec(function(*arguments))
    jacobians = [casadi.jacobian(value, argument) for argument in arguments]
    return casadi.Function(
        f"{function.name()}_jacobian", arguments, [casadi.horzcat(*jacobians)]
    )
