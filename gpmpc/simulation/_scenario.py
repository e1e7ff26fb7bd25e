"""Everything that a flight needs but its seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError, ShapeError, check_method, check_number
from gpmpc.models._past import measured_dim
from gpmpc.mpc import Controller, FlightJudge, Reference
from gpmpc.mpc._controller import read_reference
from gpmpc.mpc._policy import OnFailure, check_policy
from gpmpc.signals import Signals, signals_of
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._flight import Flight
from gpmpc.simulation._simulator import (
    ModelLoop,
    ModelSimulator,
    Noise,
    PlantSimulator,
    Simulator,
)
from gpmpc.step import Step
from gpmpc.systems import System

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A closed loop to be run: who steers what, from where, along what.

    Raises:
        ShapeError: Too few references for the steps and the horizon.
        SettingError: An unknown policy, or a controller of other names of states and
            inputs, or another time step, than the system has.
    """

    system: System | ModelLoop
    controller: Controller
    references: Reference | Array | Sequence[float]
    initial: Any  # a state (n,) or a ``Gaussian``; None for a simulator
    steps: int
    noise: Noise | None = None
    disturbances: Sequence[Disturbance] = ()
    on_failure: OnFailure = "raise"
    name: str  # of the system, for messages
    # What the controller steers: of a cascade's outer loop less than the system.
    signals: Signals
    #: the references of all steps and of the last horizon
    reference: Reference = field(init=False)

    def __post_init__(self) -> None:
        check_policy(self.on_failure)
        check_method("controller", self.controller, "control", "GPMPC(...)")
        check_belongs(self.controller, self.signals, self.name)
        reference = read_references(
            self.references, self.steps, self.controller.horizon, self.signals
        )
        object.__setattr__(self, "reference", reference)

    def reference_from(self, k: int) -> Reference:
        """Returns what the controller is to follow over its horizon from step k on."""
        horizon = self.controller.horizon
        states = self.reference.states[k : k + horizon + 1]
        inputs = self.reference.inputs
        if inputs is not None:
            inputs = inputs[k : k + horizon]
        return Reference(states, inputs)

    def reference_state(self, k: int) -> Array:
        """Returns r[k] (n,), or the last one where no r[k] was given."""
        states = self.reference.states
        return states[min(k, len(states) - 1)]

    def simulator(self, seed: int) -> Simulator:
        """Returns the system at its initial state, with the random numbers of a seed.

        Raises:
            SettingError: Noise or disturbances that do not fit, or in a model loop.
            ShapeError: A state or noise of the wrong length.
        """
        if isinstance(self.system, ModelLoop):
            if self.disturbances or self.noise is not None:
                raise SettingError(
                    "disturbances, noise", "need a plant in the loop; got a ModelLoop"
                )
            resting_input = getattr(self.controller, "initial_input", None)
            return ModelSimulator(self.system, self.initial, resting_input)
        return PlantSimulator(
            plant=self.system,
            initial=self.initial,
            disturbances=self.disturbances,
            noise=self.noise,
            seed=seed,
        )

    def flight(
        self, seed: int, on_step: Callable[[Step], None] | None = None
    ) -> Flight:
        """Returns a flight that is about to start."""
        return Flight(
            simulator=self.simulator(seed),
            time_step=self.system.time_step,
            judge=self._judge(),
            on_step=on_step,
        )

    def _judge(self) -> FlightJudge:
        """Returns the judge of one flight."""
        system = self.system
        if isinstance(system, ModelLoop):
            model = system.model
            return FlightJudge.of(self.controller, measured_dim(model), model.input_dim)
        return FlightJudge.of(
            self.controller,
            state_dim=len(system.state_names),
            input_dim=len(system.input_names),
            names=(system.state_names, system.input_names),
        )


def check_belongs(controller: Controller, signals: Signals, plant: str) -> None:
    """Raises ``SettingError`` where a controller is of something else than the plant.

    That is, of other names of states and inputs, or another time step.
    """
    signals_of(controller).check("the controller", signals, plant, "system")


def read_references(
    references: Reference | Array | Sequence[float],
    steps: int,
    horizon: int,
    signals: Signals,
) -> Reference:
    """Returns references for all steps, their columns in the order of names.

    Raises:
        ShapeError: They are too few, or no table.
        DataError: They are no numbers, or have other names.
    """
    check_number("steps", steps, least=1, whole=True)
    needed = steps + horizon
    references = read_reference(references).in_order(signals).over(needed)
    count = len(references.states)
    if count < needed:
        rule = f"{steps} steps with horizon {horizon} need {needed} references"
        raise ShapeError(f"{rule}; got {count}")
    return references
