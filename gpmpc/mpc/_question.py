"""The question to a controller at a state, and how it goes over to other horizons."""

from typing import Any, NamedTuple

import numpy as np
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.mpc._controller import Reference

Array = np.ndarray


class Question(NamedTuple):
    """What a controller is asked at a state, beside its last plan."""

    covariance: torch.Tensor  # of the belief (n, n)
    reference: Reference  # over the horizon
    parameters: Any
    previous_input: Array  # the input before (m,)
    disturbance: Array | None = None  # of the model (n,)

    def over(self, horizon: int) -> "Question":
        """Returns the question to a controller of another horizon.

        What ends sooner is held.
        """
        if self.reference.horizon == horizon:
            return self
        reference = self.reference
        inputs = reference.inputs
        if inputs is not None:
            inputs = hold_last(np.asarray(inputs), horizon)
        kappas = reference.kappas
        if kappas is not None:
            kappas = hold_last(np.asarray(kappas), horizon)
        states = hold_last(np.asarray(reference.states), horizon + 1)
        parameters = self.parameters
        if parameters is not None:
            parameters = rows_over(parameters, horizon)
        return self._replace(
            reference=Reference(states, inputs, kappas), parameters=parameters
        )

    def after(self, stages: int) -> "Question":
        """Returns the question some stages later.

        Parameters by stage move on, the last one held.
        """
        if self.parameters is None or np.ndim(self.parameters) < 2:
            return self
        count = len(self.parameters)
        parameters = rows_over(self.parameters, stages + count)[stages:]
        return self._replace(parameters=parameters)

    def belief(self, state: Array) -> Gaussian:
        """Returns the belief with a mean (n,)."""
        return Gaussian(torch.as_tensor(np.ascontiguousarray(state)), self.covariance)


def hold_last(rows: Array, count: int) -> Array:
    """Returns as many rows as counted, the last one repeated where some are missing."""
    rows = rows[:count]
    missing = count - len(rows)
    if missing > 0:
        rows = np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])
    return np.ascontiguousarray(rows)


def rows_over(parameters: Any, count: int) -> Array:
    """Returns parameters of stages (count, q), from (q,) or those of others."""
    return hold_last(np.atleast_2d(np.asarray(parameters, dtype=float)), count)


def first_weight(weight: Array) -> Array:
    """Returns the weight of the first stage, from one for all or those by stage.

    Where that is zero, as of a cost of the last stages alone, it is the mean of all.
    """
    by_stage = weight.reshape(-1, *weight.shape[-2:])
    return by_stage[0] if by_stage[0].any() else by_stage.mean(axis=0)
