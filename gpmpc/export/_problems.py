"""A controller's dimensions, settings, weights and bounds as C."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gpmpc.export._filter import Estimator, filter_definitions
from gpmpc.export._functions import FunctionWriter
from gpmpc.export._text import Numbers, comment, integers
from gpmpc.mpc import GPMPC, _elastic

Array = np.ndarray

# The tolerance of a solver in float, the power of the rounding unit that 1e-9 is.
_FLOAT_TOLERANCE = 1e-4


_COMMENTS = {
    "GPMPC_STATES": "n",
    "GPMPC_INPUTS": "m",
    "GPMPC_FILTERS": "whether a step filters what it measures",
    "GPMPC_MEASURED": "numbers that a step measures, p",
    "GPMPC_HORIZON": "H, the number of predicted states",
    "GPMPC_STAGES": "stage models: H, or one that is held",
    "GPMPC_ROWS": "rows of the states' constraints at a stage, r",
    "GPMPC_PARAMETERS": "of outputs and inequalities, q",
    "GPMPC_ITERATIONS": "changes of the working set; 0: 100 + 10 per constraint",
    "GPMPC_POINTS": "of the GPs",
    "GPMPC_DIFFERENCES": "of a state from the points, d features of each",
    "GPMPC_KERNELS": "of a state that are kept for variances, k of each point",
    "GPMPC_GP_OUTPUTS": "k",
    "GPMPC_PENALIZED": "what R weighs: 0 inputs, 1 deviations, 2 increments",
    "GPMPC_TOLERANCE": "of a solution, as a share of its size",
    "GPMPC_LARGEST_WEIGHT": "of the cost",
    "GPMPC_WORTH": "of elastic rows, in costs of a plan without them",
    "GPMPC_SHARE": "of such a cost that a plan may cost more",
    "GPMPC_TRIALS": "prices of elastic rows that are tried",
    "GPMPC_NO_PRICE": "of an elastic row that does not count, over its exact one",
    "GPMPC_LOWEST": "price that is tried, over the safe one",
    "GPMPC_NO_MOMENT": "share of its terms below which a sum is rounding",
    "GPMPC_NO_WEIGHT": "share of the largest weight below which there is none",
    "GPMPC_DISTURBANCE_GAIN": "of the estimate of a constant error",
    "GPMPC_STATE_WEIGHTS": "weights Q: one, or one for each stage",
    "GPMPC_INPUT_WEIGHTS": "weights R, likewise",
    "GPMPC_COST_ANGLE_COUNT": "states whose error counts modulo 2 pi",
    "GPMPC_STATE_ANGLE_COUNT": "states that are angles to the cost or the model",
    "GPMPC_MEASURED_ANGLE_COUNT": "measured entries that count modulo 2 pi",
    "GPMPC_IS_FLOAT": "whether numbers are float",
    "GPMPC_HAS_RATES": "whether increments of inputs are bounded",
    "GPMPC_SOFT": "whether rows may be violated at a price",
    "GPMPC_ELASTIC": "whether rows give way where no plan keeps them",
    "GPMPC_SMOOTH": "whether rows are functions that are linearised",
    "GPMPC_OUTPUTS": "whether functions of state and input are weighed",
    "GPMPC_TUBES": "whether covariances tighten rows",
    "GPMPC_FEEDBACK": "whether covariances and roll-outs know a feedback",
    "GPMPC_ROLLS_OUT": "whether plans are rolled out by the model",
    "GPMPC_HELD": "whether one linearisation is held over the horizon",
    "GPMPC_KNOWS_RANGES": "whether the ranges of the data are known",
    "GPMPC_ESTIMATES": "whether a constant error of the model is estimated",
    "GPMPC_HOLDS": "whether a failed step keeps the last input",
}


class Definitions(NamedTuple):
    """The settings that the code is compiled with, by the names in C."""

    values: dict[str, str]
    comments: dict[str, str]
    flags: dict[str, int]  #: that decide which parts of the code there are

    def text(self) -> str:
        """Returns them as lines of a header."""
        lines = [
            "/* What this controller is: other numbers do not make another one. */"
        ]
        for name, value in self.values.items():
            note = self.comments.get(name)
            lines.append(
                f"#define {name} {value}" + (f" /* {comment(note)} */" if note else "")
            )
        return "\n".join(lines)


def tightens(controller: GPMPC) -> bool:
    """Returns whether covariances move a row: else none is computed."""
    return controller.prediction.settings.covariance == "zero_order" and bool(
        _kappas(controller).any()
    )


def needs_means_alone(controller: GPMPC) -> bool:
    """Returns whether the model is asked for a mean without its derivatives, too.

    The code that writes both is then also called where A is NULL, and leaves these out.
    It is where plans are rolled out, and where a disturbance is estimated.
    """
    prediction = controller.prediction
    if prediction.rolls_out or prediction.constraints.any_elastic:
        return True
    return prediction.settings.disturbance_gain > 0


def _kappas(controller: GPMPC) -> Array:
    """Returns the deviations between means and sides (r,)."""
    return controller.prediction.constraints.kappas[0]


def definitions(
    controller: GPMPC,
    numbers: Numbers,
    functions: FunctionWriter,
    model_sizes: Mapping[str, int],
    on_failure: str,
    estimator: Estimator | None = None,
) -> Definitions:
    """Returns the dimensions and settings of a controller."""
    prediction = controller.prediction
    settings = prediction.settings
    constraints = prediction.constraints
    cost = prediction.costs.quadratic
    solver = controller.solver
    gain = settings.disturbance_gain
    tolerance = float(getattr(solver, "tolerance", 1e-9))
    if numbers.precision == "float":
        tolerance = max(tolerance, _FLOAT_TOLERANCE)
    angles = list(controller.problem.cost.angle_indices)
    values = {
        "GPMPC_STATES": str(prediction.state_dim),
        "GPMPC_INPUTS": str(prediction.input_dim),
        "GPMPC_HORIZON": str(prediction.horizon),
        "GPMPC_STAGES": str(prediction.stage_count),
        "GPMPC_ROWS": str(constraints.per_stage),
        "GPMPC_PARAMETERS": str(functions.parameters),
        "GPMPC_ITERATIONS": str(getattr(solver, "iteration_limit", None) or 0),
        "GPMPC_PENALIZED": str(cost.penalized),
        "GPMPC_STATE_WEIGHTS": str(len(cost.state)),
        "GPMPC_INPUT_WEIGHTS": str(len(cost.input)),
        "GPMPC_COST_ANGLE_COUNT": str(len(angles)),
        "GPMPC_STATE_ANGLE_COUNT": str(len(prediction.angles)),
        "GPMPC_TOLERANCE": f"(gpmpc_real){tolerance!r}",
        "GPMPC_LARGEST_WEIGHT": f"(gpmpc_real){controller.problem.largest_weight!r}",
        "GPMPC_DISTURBANCE_GAIN": f"(gpmpc_real){float(gain)!r}",
    }
    values |= {f"GPMPC_{name}": str(size) for name, size in model_sizes.items()}
    if constraints.any_elastic:
        values |= _elastic_numbers()
    values |= filter_definitions(estimator, prediction.state_dim)
    flags = _flags(controller, numbers, on_failure)
    flags["GPMPC_FILTERS"] = estimator is not None
    values |= {name: str(int(flag)) for name, flag in flags.items()}
    conditions = {name: int(flag) for name, flag in flags.items()}
    conditions["GPMPC_KERNELS"] = model_sizes["KERNELS"]
    return Definitions(values, _COMMENTS, conditions)


def _elastic_numbers() -> dict[str, str]:
    """Returns the numbers of the rule that prices elastic rows."""
    numbers = {
        "GPMPC_WORTH": _elastic.WORTH,
        "GPMPC_SHARE": _elastic.SHARE,
        "GPMPC_NO_PRICE": _elastic.NO_PRICE,
        "GPMPC_LOWEST": _elastic.LOWEST,
        "GPMPC_NO_MOMENT": _elastic.NO_MOMENT,
        "GPMPC_NO_WEIGHT": _elastic.NO_WEIGHT,
    }
    values = {name: f"(gpmpc_real){number!r}" for name, number in numbers.items()}
    return {**values, "GPMPC_TRIALS": str(_elastic.TRIALS)}


def _flags(controller: GPMPC, numbers: Numbers, on_failure: str) -> dict[str, bool]:
    """Returns which parts of the code are compiled."""
    settings = controller.prediction.settings
    constraints = controller.prediction.constraints
    return {
        "GPMPC_IS_FLOAT": numbers.precision == "float",
        "GPMPC_HAS_RATES": controller.problem.input_rates.finite,
        "GPMPC_SOFT": constraints.soft,
        "GPMPC_ELASTIC": constraints.any_elastic,
        "GPMPC_SMOOTH": constraints.smooth,
        "GPMPC_OUTPUTS": bool(controller.problem.outputs),
        "GPMPC_TUBES": tightens(controller),
        "GPMPC_FEEDBACK": settings.feedback,
        "GPMPC_ROLLS_OUT": controller.prediction.rolls_out,
        "GPMPC_HELD": settings.is_held,
        "GPMPC_KNOWS_RANGES": controller.data_scales is not None,
        "GPMPC_ESTIMATES": settings.disturbance_gain > 0,
        "GPMPC_HOLDS": on_failure == "hold",
    }


def tables(controller: GPMPC, numbers: Numbers) -> str:
    """Returns weights, bounds and rows as constant arrays."""
    prediction = controller.prediction
    problem = controller.problem
    cost = prediction.costs.quadratic
    limits = prediction.roll_out_bounds
    rows = prediction.constraints.linear
    table = numbers.table
    parts = [
        table("state_weights", cost.state[:, 0], "Q of s_1 .. (n, n)"),
        table("terminal_weight", cost.terminal[0], "of s_H (n, n)"),
        table("input_weights", cost.input, "R (m, m)"),
        table("initial_input", prediction.initial_input, "before the first step"),
        table("input_lower", limits.lower, "bounds of u_k (H, m)"),
        table("input_upper", limits.upper),
        table("rate_lower", limits.rate_lower, "bounds of u_k - u_{k-1} (H, m)"),
        table("rate_upper", limits.rate_upper),
        table("row_gradients", rows.F, "of the states' rows by the state (r, n)"),
        table("row_lower", rows.lower, "bounds of the rows (H, r)"),
        table("row_upper", rows.upper),
        table("row_prices", prediction.constraints.prices, "of violations (r,)"),
        integers("cost_angles", problem.cost.angle_indices, "errors modulo 2 pi"),
        integers("state_angles", prediction.angles, "angles of the cost or the model"),
    ]
    return "\n".join([*parts, *_optional_tables(controller, numbers)])


def _optional_tables(controller: GPMPC, numbers: Numbers) -> list[str]:
    """Returns the tables of data and of special rows, where there are any."""
    prediction = controller.prediction
    constraints = prediction.constraints
    parts = []
    scales = controller.data_scales
    if scales is not None:
        note = "of the states in the data (n,)"
        parts.append(numbers.table("data_ranges", scales.ranges, note))
    if constraints.any_elastic:
        elastic = constraints.elastic.tolist()
        parts.append(integers("row_is_elastic", elastic, "rows that give way"))
    if constraints.smooth:
        smooth = np.zeros(constraints.per_stage, dtype=int)
        for part in constraints.smooth_rows:
            smooth[part.columns] = 1
        parts.append(integers("row_is_smooth", smooth.tolist(), "linearised rows"))
    if tightens(controller):
        kappas = _kappas(controller)
        noise = prediction.linearizer.noise_covariance
        if noise is None:
            noise = np.zeros((prediction.state_dim, prediction.state_dim))
        note = "added to the covariance of a stage (n, n)"
        parts.append(numbers.table("row_kappas", kappas, "deviations to a side"))
        parts.append(numbers.table("process_noise", noise, note))
    return parts
