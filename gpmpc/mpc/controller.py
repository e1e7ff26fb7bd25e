"""Problem: everything that turns what is known of the state, and a reference, into an input, behind one call.

A controller keeps nothing between calls: what it wants to remember (its last plan) is part of the ``Decision`` that it
returns, and comes back to it as ``previous``.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.qp import QPSolution, QuadraticProgram
from gpmpc.status import Status


@dataclass(frozen=True)
class Reference:
    """What a controller is to follow over its horizon H, from the current time on.

    Attributes:
        states: r_0 .. r_H (H + 1, n); r_0 belongs to the current time.
        inputs: u*_0 .. u*_{H-1} (H, m), the inputs that belong to it where they are known.

    Raises:
        ShapeError: The two do not belong together.
    """

    states: np.ndarray
    inputs: np.ndarray | None = None

    def __post_init__(self) -> None:
        if np.ndim(self.states) != 2 or len(self.states) < 2:
            raise ShapeError(f"reference states must be (H + 1, n), H of 1 or more; got {np.shape(self.states)}")
        if self.inputs is not None and (np.ndim(self.inputs) != 2 or len(self.inputs) != len(self.states) - 1):
            raise ShapeError(f"reference inputs must be ({len(self.states) - 1}, m); got {np.shape(self.inputs)}")

    @property
    def horizon(self) -> int:
        """H."""
        return len(self.states) - 1


@dataclass(frozen=True)
class Timing:
    """Where the wall time of a decision went [s].

    Attributes:
        model: Propagation and linearisation.
        build: From the local model to the optimisation problem.
        solve: The optimisation problem itself.
    """

    model: float  # [s]
    build: float  # [s]
    solve: float  # [s]

    @property
    def total(self) -> float:
        """All of it [s]."""
        return self.model + self.build + self.solve


@dataclass(frozen=True)
class Decision:
    """What a controller decided at one step.

    Attributes:
        input: The input to apply now (m,).
        inputs: The planned inputs (H, m); the first row is ``input``.
        means: Predicted means of the states (H + 1, n), from the current state on.
        covariances: Their covariances (H + 1, n, n); zero where the controller does not predict them.
        status: How the solve ended.
        iterations: Iterations of the solver.
        timing: Where the time went.
        problem: The quadratic program that was solved last, where there is one.
        solution: Its solution: active set, multipliers, residuals; a warm start for the next.
        disturbance: What was added to the model's mean at every stage (n,), an estimate of its constant error; None
            where nothing is estimated.
        suboptimal: The solve stopped short of its tolerance, at a limit say, with a plan that keeps its bounds and that
            steps towards the optimum led to (Scokaert, Mayne and Rawlings, 1999).
    """

    input: np.ndarray
    inputs: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    status: Status
    iterations: int
    timing: Timing
    problem: QuadraticProgram | None = None
    solution: QPSolution | None = None
    disturbance: np.ndarray | None = None
    suboptimal: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "input", np.array(self.input, dtype=float))  # no view of the plan

    @property
    def applicable(self) -> bool:
        """Whether the plan may be applied, and started from; the inputs of another decision are a failed iterate."""
        return self.status.solved or self.suboptimal


class Controller(Protocol):
    """A feedback law with a look-ahead."""

    @property
    def horizon(self) -> int:
        """H, how far it looks ahead."""

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Decides the input for one step.

        Args:
            belief: What is known of the state; ``Gaussian.certain(x)`` for a measured one.
            reference: Over the controller's horizon.
            previous: The last decision, to warm-start from; None at the first step.
        """
