"""Features: what a GP sees of a state and an input.

They are selected columns, with angles as sine and cosine. ``Features`` computes them
for torch, arrays and derivatives. What a feature is stands elsewhere too; another kind
of feature is a change of each:

    models/_residual_data._feature_names  their names        tests/models/test_training
    models/_training._prior_lengthscales  their scales       tests/models/test_training
    models/_roll_out._compiled_form       compiled           tests/models/test_roll_out
    _kernels/gp_rollout (SINE, COSINE)    compiled           tests/models/test_roll_out
    gp/_posterior.AffineForm              for moments        tests/propagation
    gp/casadi_._predict_residual_model    CasADi             tests/gp/test_casadi
    mpc/_data_range._columns_of           ranges of data     tests/mpc/test_data_range
    mpc/_novelty._ranges                  ranges of data     tests/mpc/test_novelty
    export/_models                        C                  tests/export
    models/_residual.ResidualModel        a field, in files  tests/models/test_residual
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError, check_indices


@explains_arguments
@dataclass(frozen=True)
class Features:
    """A map from a state and an input to the features of a GP.

    A model without a column is invariant to it. The sine and cosine of an angle make it
    periodic.

    Raises:
        SettingError: An index is out of range or stands there twice, or an angle is not
            selected.

    >>> import torch
    >>> angle_and_rate = Features(
    ...     states=[0, 1], inputs=[0], angles=[0], state_dim=2, input_dim=1
    ... )
    >>> state, _ = angle_and_rate(torch.tensor([0.0, 3.0]), torch.tensor([0.5]))
    >>> state.tolist()
    [0.0, 1.0, 3.0]

    See Also:
        ``ResidualModel``, whose GP sees them.
    """

    states: Sequence[int]  #: selected states, in the order of the features
    inputs: Sequence[int]  #: selected inputs
    #: those of the selected states that are seen as (sine, cosine), at their place
    angles: Sequence[int]
    state_dim: int  #: n, of the state they are selected from
    input_dim: int  #: m

    def __post_init__(self) -> None:
        check_indices("states", self.states, self.state_dim)
        check_indices("inputs", self.inputs, self.input_dim)
        check_indices("angles", self.angles, self.state_dim)
        if not set(self.angles) <= set(self.states):
            rule = f"must be some of the selected states {list(self.states)}"
            raise SettingError("angles", f"{rule}; got {self.angles}")

    @property
    def dim(self) -> int:
        """Number of features of the state, s; a GP of them sees d = s + m_s."""
        return len(self.states) + len(self.angles)

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Index of the state that each feature is a function of (s,)."""
        columns: list[int] = []
        for i in self.states:
            columns += [i, i] if i in self.angles else [i]
        return np.array(columns, dtype=np.intp)

    @cached_property
    def sines(self) -> NDArray[np.intp]:
        """Indices of the sines among the features, each before its cosine (a,)."""
        begins_state = np.diff(self.columns, prepend=-1) != 0
        return np.flatnonzero(begins_state & np.isin(self.columns, self.angles))

    @cached_property
    def _input_columns(self) -> NDArray[np.intp]:
        """Indices of the selected inputs (m_s,)."""
        return np.array(self.inputs, dtype=np.intp)

    @cached_property
    def _selection(self) -> Array:
        """Matrix of the selection (s, n): 1 in the column of each feature's state."""
        return np.eye(self.state_dim)[self.columns]

    def __call__(self, state: Tensor, input: Tensor) -> tuple[Tensor, Tensor]:
        """Computes features and selected inputs.

        Args:
            state: (*batch, n).
            input: (*batch, m).

        Returns:
            The features (*batch, s), and the selected inputs (*batch, m_s).
        """
        selected_inputs = input[..., list(self.inputs)]
        features = state[..., self.columns.tolist()]
        sines = self.sines.tolist()
        if not sines:
            return features, selected_inputs
        columns = list(features.unbind(-1))
        for k in sines:
            columns[k] = columns[k].sin()
            columns[k + 1] = columns[k + 1].cos()
        return torch.stack(columns, dim=-1), selected_inputs

    def linearize(
        self, states: Array, inputs: Array
    ) -> tuple[Array, Array, Array | None]:
        """Computes features, selected inputs and derivatives at K points.

        Args:
            states: (K, n).
            inputs: (K, m).

        Returns:
            The features (K, s), the selected inputs (K, m_s), and slopes (K, s): of
            each feature one number, its derivative by the one state that it is a
            function of (``columns``). None where all of these are one.
        """
        features = states[:, self.columns].astype(float)
        selected_inputs = inputs[:, self._input_columns]
        if not len(self.sines):
            return features, selected_inputs, None
        sines = self.sines
        sine = np.sin(features[:, sines])
        cosine = np.cos(features[:, sines])
        slopes = np.ones_like(features)
        slopes[:, sines] = cosine
        slopes[:, sines + 1] = -sine
        features[:, sines] = sine
        features[:, sines + 1] = cosine
        return features, selected_inputs, slopes

    def chain(
        self, by_features: Array, by_inputs: Array, slopes: Array | None
    ) -> tuple[Array, Array]:
        """Applies the chain rule to the derivatives of a function of the features.

        Args:
            by_features: Derivatives by the features (K, k, s).
            by_inputs: Derivatives by the selected inputs (K, k, m_s).
            slopes: Derivatives of the features, from ``linearize``.

        Returns:
            The derivatives by the state (K, k, n) and by the input (K, k, m).
        """
        if slopes is not None:
            by_features = by_features * slopes[:, None, :]
        by_state = by_features @ self._selection
        by_input = np.zeros((*by_inputs.shape[:-1], self.input_dim))
        by_input[..., self._input_columns] = by_inputs
        return by_state, by_input
