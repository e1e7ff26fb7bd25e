"""A Kalman filter as C, before the controller that decides for what it believes."""

from typing import Any, NamedTuple

from gpmpc._dynamics import to_array
from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import SettingError, ShapeError, check_kind
from gpmpc.export._expressions import expansion_lines, graph_of_tape
from gpmpc.export._models import ModelWriter
from gpmpc.export._text import Numbers, function, integers
from gpmpc.gaussian import Gaussian
from gpmpc.models import CasadiFunction
from gpmpc.models._tensors import check_like
from gpmpc.mpc import GPMPC
from gpmpc.propagation import Linearization
from gpmpc.signals import signals_of

_SIGNATURE = "static void measurement(const real *x, real *value, real *jacobian)"


class Estimator(NamedTuple):
    """A filter, and where it begins."""

    filter: KalmanFilter  #: of the states that the controller is given
    belief: Gaussian  #: before the first measurement: mean (n,), covariance (n, n)


def check_estimator(controller: GPMPC, estimator: Any) -> None:
    """Raises an error of the first part of a filter that C cannot hold.

    Raises:
        SettingError: A part of another kind, or of other states or inputs.
        ShapeError: A belief or a measurement of other sizes.
    """
    check_kind("estimator", estimator, Estimator, "Estimator(filter, belief)")
    kalman = estimator.filter
    if type(kalman) is not KalmanFilter:
        rule = "an exported one is a KalmanFilter of measurements that come in time"
        raise SettingError("filter", f"{rule}; got {type(kalman).__name__}")
    for key in ("propagator", "observer"):
        part = getattr(kalman, key)
        if type(part) is not Linearization:
            rule = "an exported filter is linearised: Linearization()"
            raise SettingError(f"filter.{key}", f"{rule}; got {type(part).__name__}")
    n = controller.prediction.state_dim
    if kalman.model.state_dim != n:
        rule = f"must estimate the {n} states of the controller"
        raise SettingError("filter.model", f"{rule}; got {kalman.model.state_dim}")
    m = controller.prediction.input_dim
    if kalman.model.input_dim != m:
        rule = f"must take the {m} inputs of the controller"
        raise SettingError("filter.model", f"{rule}; got {kalman.model.input_dim}")
    check_kind("belief", estimator.belief, Gaussian, "a Gaussian")
    if estimator.belief.mean.shape != (n,):
        got = tuple(estimator.belief.mean.shape)
        raise ShapeError(f"the estimator's belief must be of {n} states; got {got}")
    check_like("belief", estimator.belief.mean, kalman.model)
    if kalman.measurement.measured_states is None:
        _check_function(kalman.measurement)


class FilterWriter:
    """Writes the tables of a filter, its model and its measurement.

    Attributes:
        text: All that was written but the model, which goes to ``model``.
    """

    def __init__(
        self,
        controller: GPMPC,
        estimator: Estimator,
        numbers: Numbers,
        model: ModelWriter,
    ):
        kalman = estimator.filter
        pieces = []
        if kalman.model is controller.prediction.model:
            pieces += [
                "/* the controller's own */",
                "#define filter_model model",
                "#define filter_model_variances model_variances",
                "#define filter_model_covariance model_covariance\n",
            ]
        else:
            model.variances = True
            model.write(kalman.model, "filter_model")
        measurement = kalman.measurement
        belief = estimator.belief.in_order(signals_of(kalman.model).state_names)
        table = numbers.table
        noise = to_array(kalman.model.noise_covariance)
        sensor_noise = to_array(measurement.noise_covariance)
        covariance = to_array(belief.covariance)
        angles = list(measurement.angles)
        pieces += [
            table("filter_noise", noise, "of the process (n, n)"),
            table("measurement_noise", sensor_noise, "R (p, p)"),
            integers("measured_angles", angles, "entries of y modulo 2 pi"),
            table("first_mean", to_array(belief.mean), "before any measurement (n,)"),
            table("first_covariance", covariance, "(n, n)"),
            _measurement_function(measurement, numbers),
        ]
        self.text = "\n".join(pieces)


def _check_function(measurement: Measurement) -> None:
    """Raises an error unless C can compute what a measurement shows of the state.

    Raises:
        SettingError: It is no CasADi function of elementary operations.
        ShapeError: It takes, or gives, another number of entries.
    """
    function = measurement.function
    if not isinstance(function, CasadiFunction) or function.tape is None:
        raise SettingError(
            "measurement.function",
            "an exported one is Measurement.of_states, or a CasadiFunction of "
            f"elementary operations; got {type(function).__name__}",
        )
    n = measurement.state_dim
    p = measurement.output_dim
    if function.sizes != [n] or function.shape != (p, 1):
        rule = f"the function of a measurement must map ({n},) to ({p},)"
        raise ShapeError(f"{rule}; got {function.function}")


def _measurement_function(measurement: Measurement, numbers: Numbers) -> str:
    """Returns h(x) and its derivatives as C."""
    n = measurement.state_dim
    size = measurement.output_dim * n
    body = [f"fill(jacobian, 0, {size});"]
    if measurement.measured_states is not None:
        for i, state in enumerate(measurement.measured_states):
            body.append(f"value[{i}] = x[{state}];")
            body.append(f"jacobian[{i * n + state}] = 1;")
    else:
        function_of_state: Any = measurement.function
        graph, value = graph_of_tape(function_of_state.tape)
        names = [f"x[{i}]" for i in range(n)]
        body += expansion_lines(graph, value, names, numbers)
    return function(_SIGNATURE, body, "h(x): what the sensors show")


def filter_definitions(estimator: Estimator | None, state_dim: int) -> dict[str, str]:
    """Returns what is measured at a step, as settings of the code."""
    if estimator is None:
        return {
            "GPMPC_MEASURED": str(state_dim),
            "GPMPC_MEASURED_ANGLE_COUNT": "0",
        }
    measurement = estimator.filter.measurement
    return {
        "GPMPC_MEASURED": str(measurement.output_dim),
        "GPMPC_MEASURED_ANGLE_COUNT": str(len(measurement.angles)),
    }
