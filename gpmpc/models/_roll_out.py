"""Rollouts of a model's mean, open loop or under a feedback towards plans.

Models that are GPs, an affine part and a tape are rolled out by compiled code.
"""

from collections.abc import Callable

import numpy as np
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import (
    Array,
    DynamicsModel,
    check_next_states,
    linearize,
    to_array,
)
from gpmpc._kernels import GPArrays
from gpmpc._kernels.gp_rollout import (
    COSINE,
    PLAIN,
    SINE,
    AffineGPs,
    Feedback,
    roll_out_gps,
)
from gpmpc._kernels.tape import NO_TAPE, Tape
from gpmpc.exceptions import ShapeError
from gpmpc.gp._backend import check_and_choose_compiled
from gpmpc.gp._posterior import AffineForm
from gpmpc.models._features import Features


def iterate(
    step: Callable[[int, Array], Array],
    start: Array,
    steps: int,
    kept: int | None = None,
) -> Array:
    """Iterates x[k+1] = step(k, x[k]).

    Args:
        step: Maps the stage k and states x[k] (..., n) to x[k+1] (..., n).
        start: x[0] (..., n).
        steps: Number of iterations.
        kept: Number of entries of each state that are returned, the first ones; all by
            default.

    Returns:
        x[0], .., x[steps] (..., steps + 1, kept).
    """
    kept_start = start[..., :kept]
    *batch, n = kept_start.shape
    states = np.empty((*batch, steps + 1, n))
    states[..., 0, :] = kept_start
    state = start
    for k in range(steps):
        state = step(k, state)
        states[..., k + 1, :] = state[..., :kept]
    return states


@explains_arguments
class RollOut:
    """Rollouts of the mean of one model of next states, from any number of starts.

    A model whose ``affine_form`` or ``tape`` is not None takes one compiled call. Any
    other takes one call for each stage: of its ``predict_mean`` where it has that
    method, else of ``linearize``.

    Raises:
        SettingError: The model does not predict as many values as it has states.

    See Also:
        ``gpmpc.propagation.rollout``, which carries a belief along.
    """

    def __init__(self, model: DynamicsModel):
        check_next_states(model)
        self._model = model
        self._compiled_model = _compiled_model(model)

    def __call__(
        self, start: Array, feedback: Feedback, disturbance: Array | None = None
    ) -> tuple[Array, Array]:
        """Rolls the model out under a feedback.

        Args:
            start: x_0 of each of T rollouts (T, n).
            feedback: The plans (T, H, m), gains and bounds.
            disturbance: Added to every next state (n,); zero by default.

        Returns:
            The states (T, H + 1, n) and the inputs (T, H, m).

        Raises:
            ShapeError: They do not belong to the model, or to each other.
        """
        feedback = Feedback(*[_doubles(part) for part in feedback])
        T, H, m = feedback.inputs.shape
        n = self._model.state_dim
        start = _doubles(start)
        disturbance = _doubles(np.zeros(n) if disturbance is None else disturbance)
        self._check_shapes(start, feedback, disturbance)
        if self._compiled_model is None:
            return self._stage_by_stage(start, feedback, disturbance)
        states = np.empty((T, H + 1, n))
        inputs = np.empty((T, H, m))
        roll_out_gps.unchecked(
            model=self._compiled_model,
            feedback=feedback,
            start=start,
            disturbance=disturbance,
            states=states,
            inputs=inputs,
        )
        return states, inputs

    def open_loop(
        self, start: Array, inputs: Array, disturbance: Array | None = None
    ) -> Array:
        """Rolls the model out under fixed inputs, without bounds.

        Args:
            start: x_0 of each of T rollouts (T, n).
            inputs: (T, H, m).
            disturbance: Added to every next state (n,); zero by default.

        Returns:
            The states (T, H + 1, n).

        Raises:
            ShapeError: They do not belong to the model, or to each other.
        """
        inputs = _doubles(inputs)
        if inputs.ndim != 3:
            raise ShapeError(f"inputs must be (T, H, m); got {inputs.shape}")
        T, H, m = inputs.shape
        n = self._model.state_dim
        unbounded = np.full((H, m), np.inf)
        no_feedback = Feedback(
            states=np.zeros((T, H, n)),
            inputs=inputs,
            gains=np.zeros((1, H, m, n)),
            lower=-unbounded,
            upper=unbounded,
            rate_lower=-unbounded,
            rate_upper=unbounded,
            previous_input=np.zeros(m),
        )
        states, _ = self(start, no_feedback, disturbance)
        return states

    def _check_shapes(
        self, start: Array, feedback: Feedback, disturbance: Array
    ) -> None:
        """Raises ``ShapeError`` unless compiled code may read them unchecked."""
        T, H, _ = feedback.inputs.shape
        n = self._model.state_dim
        m = self._model.input_dim
        expected = ((T, n), (T, H, m), (n,))
        got = (start.shape, feedback.inputs.shape, disturbance.shape)
        if got != expected:
            raise ShapeError(
                "start (T, n), inputs (T, H, m) and disturbance (n,) must be "
                f"{', '.join(map(str, expected))}; got {', '.join(map(str, got))}"
            )
        plans, stages, *_ = feedback.states.shape
        bounds = (
            feedback.lower.shape,
            feedback.upper.shape,
            feedback.rate_lower.shape,
            feedback.rate_upper.shape,
        )
        fits = (
            feedback.states.shape == (T, stages, n)
            and plans == T
            and stages >= H
            and feedback.gains.shape in ((1, H, m, n), (T, H, m, n))
            and bounds == ((H, m),) * 4
            and feedback.previous_input.shape == (m,)
        )
        if not fits:
            shapes = {name: part.shape for name, part in feedback._asdict().items()}
            rule = f"a feedback must be of {T} plans of {H} stages, {n} states"
            raise ShapeError(f"{rule} and {m} inputs; got {shapes}")

    def _stage_by_stage(
        self, start: Array, feedback: Feedback, disturbance: Array
    ) -> tuple[Array, Array]:
        """Rolls the model out by one call of it for each stage."""
        T, H, m = feedback.inputs.shape
        inputs = np.empty((T, H, m))

        def step(k: int, states: Array) -> Array:
            previous = inputs[:, k - 1] if k > 0 else feedback.previous_input
            u = _feedback_input(feedback, k, states, previous)
            inputs[:, k] = u
            return self._next_states(states, u) + disturbance

        # States that leave the numbers are returned, not warned of.
        with np.errstate(over="ignore", invalid="ignore"):
            return iterate(step, start, H), inputs

    def _next_states(self, states: Array, inputs: Array) -> Array:
        """Computes the mean of the next states (T, n)."""
        states = np.ascontiguousarray(states)
        predict_mean = getattr(self._model, "predict_mean", None)
        if predict_mean is not None:
            return predict_mean(states, inputs)
        return linearize(self._model, states, inputs, covariance=False).mean


def _doubles(values: Array) -> Array:
    """Returns values as compiled code reads them without a look: one after the other.

    Values that are so already are not copied.
    """
    return np.ascontiguousarray(values, dtype=np.float64)


def _feedback_input(
    feedback: Feedback, k: int, states: Array, previous_input: Array
) -> Array:
    """Computes the inputs (T, m) of a feedback at stage k, within its bounds."""
    T = len(states)
    gains = np.broadcast_to(feedback.gains[:, k], (T, *feedback.gains.shape[2:]))
    deviation = states - feedback.states[:, k]
    u = feedback.inputs[:, k] + (gains @ deviation[..., None])[..., 0]
    u = np.maximum(u, previous_input + feedback.rate_lower[k])
    u = np.minimum(u, previous_input + feedback.rate_upper[k])
    u = np.maximum(u, feedback.lower[k])
    return np.minimum(u, feedback.upper[k])


def _compiled_model(model: DynamicsModel) -> AffineGPs | None:
    """Returns a model's arrays for compiled code; None where it is not of that form."""
    form: AffineForm | None = getattr(model, "affine_form", None)
    if form is not None and check_and_choose_compiled(form.f.on_host):
        return _compiled_form(form, model.state_dim, model.input_dim)
    tape: Tape | None = getattr(model, "tape", None)
    if tape is not None:
        return _compiled_tape(tape, model.state_dim, model.input_dim)
    return None


def _compiled_form(form: AffineForm, n: int, m: int) -> AffineGPs:
    """Returns the arrays of an affine form, with the defaults for all that is None."""
    inputs = list(range(m)) if form.inputs is None else form.inputs
    features = Features(
        states=list(range(n)) if form.states is None else form.states,
        inputs=inputs,
        angles=form.angles,
        state_dim=n,
        input_dim=m,
    )
    kinds = np.full(features.dim, PLAIN)
    kinds[features.sines] = SINE
    kinds[features.sines + 1] = COSINE
    return AffineGPs(
        f=form.f.packed.arrays,
        offset=to_array(form.f.offset),
        A=_array_or_zeros(form.A, (n, n)),
        G=_array_or_zeros(form.G, (n, m)),
        c=_array_or_zeros(form.c, (n,)),
        B=np.eye(n) if form.B is None else to_array(form.B),
        states=features.columns,
        kinds=kinds,
        inputs=np.array(inputs, dtype=np.intp),
        tape=NO_TAPE if form.tape is None else form.tape,
    )


def _array_or_zeros(tensor: Tensor | None, shape: tuple[int, ...]) -> Array:
    """Converts a tensor to an array of a shape; None to zeros."""
    if tensor is None:
        return np.zeros(shape)
    return to_array(tensor.expand(shape).contiguous())


def _compiled_tape(tape: Tape, n: int, m: int) -> AffineGPs:
    """Returns the arrays of a tape alone, without a GP."""
    no_points = np.empty((0, 0))
    no_indices = np.empty(0, dtype=np.intp)
    no_gps = GPArrays(no_points, no_points, np.empty(0), no_points, 0)
    return AffineGPs(
        f=no_gps,
        offset=np.empty(0),
        A=np.zeros((n, n)),
        G=np.zeros((n, m)),
        c=np.zeros(n),
        B=np.empty((n, 0)),
        states=no_indices,
        kinds=no_indices,
        inputs=no_indices,
        tape=tape,
    )
