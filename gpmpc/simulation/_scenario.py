"""Everything that a flight needs but its seed."""

from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass, field, replace
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
        ShapeError: Too few references for the steps and the horizon, or a set point's
            kappas of another horizon.
        DataError: References that are no numbers, or have other names.
        SettingError: An unknown policy, or a controller of other names of states and
            inputs, or another time step, than the system has.
    """

    system: System | ModelLoop
    controller: Controller
    references: InitVar[Reference | Array | Sequence[float]]  # as the user gave them
    initial: Any  # a state (n,) or a ``Gaussian``; None for a simulator
    steps: int
    noise: Noise | None = None
    disturbances: Sequence[Disturbance] = ()
    on_failure: OnFailure = "raise"
    name: str  # of the system, for messages
    # What the controller steers: of a cascade's outer loop less than the system.
    signals: Signals
    #: the references of all steps and of the last horizon, columns in order
    path: Reference = field(init=False)
    #: standard deviations (H,) that replace the problem's at every step: a set point's
    set_point_kappas: Array | None = field(init=False)

    def __post_init__(self, references: Reference | Array | Sequence[float]) -> None:
        check_policy(self.on_failure)
        check_method("controller", self.controller, "control", "GPMPC(...)")
        check_belongs(self.controller, self.signals, self.name)
        horizon = self.controller.horizon
        reference = read_reference(references).in_order(self.signals)
        object.__setattr__(
            self, "set_point_kappas", _kappas_of_set_point(reference, horizon)
        )
        if self.set_point_kappas is not None:
            reference = replace(reference, kappas=None)
        object.__setattr__(self, "path", _path_over(reference, self.steps, horizon))

    def reference_from(self, k: int) -> Reference:
        """Returns what the controller is to follow over its horizon from step k on.

        Its arrays are copies: what a controller does to them, the path does not see.
        Its kappas are those of a set point, or where the path has some its next ones.
        """
        end = k + self.controller.horizon
        inputs = self.path.inputs
        if inputs is not None:
            inputs = np.array(inputs[k:end])
        kappas = self.set_point_kappas
        if self.path.kappas is not None:
            kappas = self.path.kappas[k:end]
        if kappas is not None:
            kappas = np.array(kappas)
        return Reference(np.array(self.reference_states_from(k)), inputs, kappas)

    def reference_states_from(self, k: int) -> Array:
        """Returns the states (H + 1, n) of the path from step k on."""
        return self.path.states[k : k + self.controller.horizon + 1]

    def reference_state(self, k: int) -> Array:
        """Returns r[k] (n,), or the last one where no r[k] was given."""
        states = self.path.states
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


def _kappas_of_set_point(reference: Reference, horizon: int) -> Array | None:
    """Returns the kappas (H,) of a set point, which hold at every step.

    None where there are none, and for a path, whose kappas move along with it.

    Raises:
        ShapeError: They are of another horizon.
    """
    if reference.kappas is None or np.ndim(reference.states) == 2:
        return None
    kappas = np.asarray(reference.kappas)
    if kappas.shape != (horizon,):
        rule = f"kappas of a set point must be ({horizon},), one a stage"
        raise ShapeError(f"{rule}; got {kappas.shape}")
    return kappas


def _path_over(reference: Reference, steps: int, horizon: int) -> Reference:
    """Returns references for all steps and for the horizon of the last one.

    Raises:
        ShapeError: They are too few.
    """
    check_number("steps", steps, least=1, whole=True)
    needed = steps + horizon
    path = reference.over(needed)
    count = len(path.states)
    if count < needed:
        rule = f"{steps} steps with horizon {horizon} need {needed} references"
        raise ShapeError(f"{rule}; got {count}")
    return path
