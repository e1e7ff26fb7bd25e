"""Rolls a model's mean out under a feedback towards plans: compiled where it is GPs, an affine part and a tape."""

from typing import Any

import numpy as np
import torch

from gpmpc._dynamics import Array, DynamicsModel, linearize, to_array
from gpmpc._kernels import GPArrays
from gpmpc._kernels.gp_rollout import (
    COSINE,
    PLAIN,
    SINE,
    AffineGPs,
    Feedback,
    roll_out_gps,
)
from gpmpc._kernels.tape import NO_TAPE
from gpmpc.gp._backend import host_arrays
from gpmpc.gp._posterior import AffineForm
from gpmpc.models._features import Features


class RollOut:
    """Rolls out the mean of one model of next states, from any number of starts in one call.

    A model whose ``affine_form`` or ``tape`` is not None takes one compiled call; any other one call for each stage,
    of its ``predict_mean`` where it has that method, else of ``linearize``.
    """

    def __init__(self, model: DynamicsModel):
        self._model = model
        self._gps = None
        form: AffineForm | None = getattr(model, "affine_form", None)
        if form is not None and host_arrays(form.f.weights) is not None:
            self._gps = _compiled_form(form, model.state_dim, model.input_dim)
        elif getattr(model, "tape", None) is not None:
            self._gps = _known_form(model)

    def __call__(
        self, start: Array, feedback: Feedback, disturbance: Array | None = None
    ) -> tuple[Array, Array]:
        """Returns states (T, H + 1, n) and inputs (T, H, m) from x_0 (T, n) on; a disturbance (n,) is added at each."""
        (T, H, m), n = feedback.inputs.shape, start.shape[1]
        states = np.empty((T, H + 1, n))
        inputs = np.empty((T, H, m))
        start = np.ascontiguousarray(start, dtype=float)
        added = (
            np.zeros(n)
            if disturbance is None
            else np.ascontiguousarray(disturbance, dtype=float)
        )
        if self._gps is not None:
            roll_out_gps.unchecked(self._gps, feedback, start, added, states, inputs)
            return states, inputs
        gains = np.broadcast_to(feedback.gains, (T, *feedback.gains.shape[1:]))
        states[:, 0] = start
        last = feedback.previous_input
        for k in range(H):
            u = (
                feedback.inputs[:, k]
                + (gains[:, k] @ (states[:, k] - feedback.states[:, k])[..., None])[
                    ..., 0
                ]
            )
            u = np.minimum(
                np.maximum(u, last + feedback.rate_lower[k]),
                last + feedback.rate_upper[k],
            )
            last = inputs[:, k] = np.minimum(
                np.maximum(u, feedback.lower[k]), feedback.upper[k]
            )
            states[:, k + 1] = (
                self._mean(np.ascontiguousarray(states[:, k]), last) + added
            )
        return states, inputs

    def open_loop(
        self, start: Array, inputs: Array, disturbance: Array | None = None
    ) -> Array:
        """Returns the states (T, H + 1, n) that inputs (T, H, m) lead to from x_0 (T, n), without bounds."""
        (T, H, m), n = inputs.shape, start.shape[1]
        gains = np.zeros((1, H, m, n))
        free = np.full((H, m), np.inf)
        planned = np.zeros((T, H, n))
        inputs = np.ascontiguousarray(inputs, dtype=float)
        law = Feedback(planned, inputs, gains, -free, free, -free, free, np.zeros(m))
        return self(start, law, disturbance)[0]

    def _mean(self, states: Array, inputs: Array) -> Array:
        if (method := getattr(self._model, "predict_mean", None)) is not None:
            return method(states, inputs)
        return linearize(self._model, states, inputs, covariance=False).mean


def _compiled_form(form: AffineForm, n: int, m: int) -> AffineGPs:
    """The arrays of an affine form, with everything that None stands for."""
    states = list(range(n)) if form.states is None else form.states
    inputs = list(range(m)) if form.inputs is None else form.inputs
    features = Features(states, inputs, form.angles, n, m)
    kinds = np.full(features.dim, PLAIN)
    kinds[features.sines] = SINE
    kinds[features.sines + 1] = COSINE
    zero = torch.zeros((), dtype=torch.float64)
    shapes = ((n, n), (n, m), (n,))
    parts = zip((form.A, form.G, form.c), shapes, strict=True)
    A, G, c = (
        to_array((zero if part is None else part).expand(shape).contiguous())
        for part, shape in parts
    )
    B = np.eye(n) if form.B is None else to_array(form.B)
    places = features.columns, kinds, np.array(inputs, dtype=np.intp)
    tape = NO_TAPE if form.tape is None else form.tape
    return AffineGPs(
        form.f.packed.arrays, to_array(form.f.offset), A, G, c, B, *places, tape
    )


def _known_form(model: Any) -> AffineGPs:
    """The arrays of a tape alone, without a GP."""
    n = model.state_dim
    m = model.input_dim
    none = np.empty((0, 0))
    nothing = GPArrays(none, none, np.empty(0), none, 0)
    empty = np.empty(0, dtype=np.intp)
    affine = np.zeros((n, n)), np.zeros((n, m)), np.zeros(n), np.empty((n, 0))
    return AffineGPs(nothing, np.empty(0), *affine, empty, empty, empty, model.tape)
