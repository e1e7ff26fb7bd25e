"""Problem: a controller is asked with what its caller has; what it is asked is checked once, in one place, for all.

A question that does not fit the controller is misuse and raises. A state that is not finite is a bad measurement, which
happens in flight: it is answered by a ``Status`` (``unanswered``).
"""

from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compile_for, compiled, unchecked_entry_point
from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_number, check_numbers
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Decision, Reference, Timing
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.status import Status

NO_PLAN, UNDISTURBED = np.empty((0, 0)), np.empty(0)
SIGNATURE = "i8(f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])"
BELIEF, TARGETS, WANTED, BEFORE = 1, 2, 4, 8  # what may not be finite


class Request(NamedTuple):
    """One step's question, in contiguous float64 arrays.

    Attributes:
        state: Mean of the belief (n,).
        covariance: Of the belief (n, n).
        targets: r_1 .. r_H (H, n).
        wanted: Reference inputs u*_0 .. u*_{H-1} (H, m); zero where there are none.
        last: The input before this step, u_{-1} (m,).
        shifted: The last plan, one step on, its last input repeated (H, m); the last input held where there is no
            plan that may be applied. Within the input bounds.
        finite: Whether the belief can be worked with.
        disturbance: Added to the model's mean at every stage (n,), or nothing (0,).
    """

    state: np.ndarray
    covariance: np.ndarray
    targets: np.ndarray
    wanted: np.ndarray
    last: np.ndarray
    shifted: np.ndarray
    finite: bool
    disturbance: np.ndarray = UNDISTURBED

    @classmethod
    def read(
        cls,
        problem: TrackingProblem,
        horizon: int,
        initial_input: np.ndarray,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
    ) -> "Request":
        """From the arguments of ``Controller.control``.

        Args:
            problem: Says n and m.
            horizon: H.
            initial_input: Taken as the last input where there is no previous decision (m,).
            belief: Of the state.
            reference: Over the horizon.
            previous: The last decision. Of one that is not applicable only ``input`` counts: what was applied.

        Raises:
            ShapeError: Belief or reference have other dimensions than the problem and the horizon.
            DataError: The reference is not finite.
        """
        if not (isinstance(belief, Gaussian) and isinstance(reference, Reference)):
            raise ShapeError(
                "control takes a Gaussian (Gaussian.certain(x) for a measured state) and a Reference(states); "
                f"got {type(belief).__name__} and {type(reference).__name__}"
            )
        n, m = problem.state_dim, problem.input_dim
        state, covariance = _array(belief.mean), _array(belief.covariance)
        targets = _array(reference.states)
        if state.shape != (n,) or targets.shape != (horizon + 1, n):
            raise ShapeError(
                f"state and reference must have shapes ({n},) and ({horizon + 1}, {n}); "
                f"got {state.shape} and {targets.shape}"
            )
        wanted = np.zeros((horizon, m)) if reference.inputs is None else _array(reference.inputs)
        if wanted.shape != (horizon, m):
            raise ShapeError(f"reference inputs must have shape ({horizon}, {m}); got {wanted.shape}")
        last, plan = initial_input if previous is None else _array(previous.input), NO_PLAN
        if previous is not None and previous.applicable:
            plan = _array(previous.inputs)
            plan = plan if plan.shape == (horizon, m) else NO_PLAN
        last, shifted = _array(last), np.empty((horizon, m))
        bounds = problem.input_lower, problem.input_upper
        found = inspect(state, covariance, targets, wanted, last, plan, *bounds, shifted)
        if found & BEFORE:
            last = _array(initial_input)
            found = inspect(state, covariance, targets, wanted, last, plan, *bounds, shifted)
        for part, name, values in ((TARGETS, "states", targets), (WANTED, "inputs", wanted)):
            if found & part:
                raise DataError(f"reference {name} must be finite; got {values[~np.isfinite(values)][0]}")
        return cls(state, covariance, targets[1:], wanted, last, shifted, not found & BELIEF)

    @property
    def held(self) -> np.ndarray:
        """The last input over the whole horizon (H, m)."""
        return np.tile(self.last, (len(self.targets), 1))

    def unanswered(self, status: Status, iterations: int = 0, timing: Timing | None = None) -> Decision:
        """The decision of a step without a usable solve: the shifted plan, and no prediction."""
        H, n = self.targets.shape
        return Decision(
            input=self.shifted[0],
            inputs=self.shifted,
            means=np.full((H + 1, n), np.nan),
            covariances=np.full((H + 1, n, n), np.nan),
            status=status,
            iterations=iterations,
            timing=timing or Timing(0.0, 0.0, 0.0),
        )


def check_dynamics(model: DynamicsModel) -> tuple[int, int]:
    """The numbers of states and inputs of a model that predicts the next state.

    Raises:
        SettingError: It is no model, or predicts something else.
    """
    if not hasattr(model, "predict"):
        raise SettingError("model", f"must be a DynamicsModel, such as GPPosterior; got {type(model).__name__}")
    if model.output_dim != model.state_dim:
        raise SettingError(
            "model", f"must predict the next state; got {model.state_dim} states and {model.output_dim} outputs"
        )
    return model.state_dim, model.input_dim


def check_method(key: str, value: object, method: str, example: str) -> None:
    """Raises ``SettingError`` unless a setting is an object (no class of them) with a method."""
    if isinstance(value, type) or not hasattr(value, method):
        got = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
        raise SettingError(key, f"must be an object with the method {method!r}, such as {example}; got {got}")


def check_controller(
    problem: TrackingProblem, states: int, inputs: int, horizon: int, initial_input: np.ndarray
) -> np.ndarray:
    """The settings that every controller has, held against its model; gives the initial input as an array (m,).

    Raises:
        SettingError: A horizon below 1, weights of another dimension than the model's, or an initial input of the
            wrong length.
    """
    global inspect
    compile_for(look_over, SIGNATURE)
    inspect = unchecked_entry_point(look_over)
    if not isinstance(problem, TrackingProblem):
        raise SettingError("problem", f"must be TrackingProblem(...); got {type(problem).__name__}")
    check_number("horizon", horizon, least=1, whole=True)
    check_numbers("initial_input", initial_input, inputs)
    if (problem.state_dim, problem.input_dim) != (states, inputs):
        raise SettingError(
            "problem",
            f"must weigh {states} states and {inputs} inputs; got {problem.state_dim} and {problem.input_dim}",
        )
    return np.array(initial_input, dtype=float)


def _array(value: object) -> np.ndarray:
    """A tensor or array as contiguous float64 in host memory."""
    if hasattr(value, "detach"):
        try:
            value = value.numpy()
        except (RuntimeError, TypeError):  # on another device, or part of a graph
            value = value.numpy(force=True)
    return np.ascontiguousarray(value, dtype=np.float64)


@compiled(locked=True)
def look_over(state, covariance, targets, wanted, last, plan, lower, upper, shifted):
    """Says which parts are not finite, a sum of ``BELIEF``, ``TARGETS``, ``WANTED``, ``BEFORE``; writes ``shifted``."""
    H, m = shifted.shape
    for k in range(H):
        for j in range(m):
            u = plan[min(k + 1, H - 1), j] if len(plan) > 0 else last[j]
            shifted[k, j] = min(max(u, lower[j]), upper[j])
    found = BELIEF if undefined(state) or undefined(covariance.ravel()) else 0
    found += TARGETS if undefined(targets.ravel()) else 0
    found += WANTED if undefined(wanted.ravel()) else 0
    return found + (BEFORE if undefined(last) else 0)


@compiled
def undefined(values):
    """Whether an entry is infinite or NaN."""
    nothing = 0.0
    for value in values:
        nothing += value * 0.0
    return nothing != 0.0


inspect = look_over  # until it is compiled
