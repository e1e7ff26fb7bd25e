"""Describes one flight of one system, with everything that its numbers follow from."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc.datasets import DataSource
from gpmpc.exceptions import (
    SettingError,
    ShapeError,
    check_choice,
    check_kind,
    check_method,
    check_number,
)
from gpmpc.gp import Training, Transitions
from gpmpc.learning import EpisodicLearning, OnlineLearning
from gpmpc.learning._controller import check_no_disturbance_estimate
from gpmpc.models import train
from gpmpc.models._past import variances_of_next_row
from gpmpc.models._training import KINEMATICS, KinematicsChoice
from gpmpc.mpc._policy import OnFailure, check_policy
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.simulation import Disturbance, Noise
from gpmpc.simulation._simulator import PlantSimulator
from gpmpc.studies.study import random_rows
from gpmpc.systems import System
from gpmpc.trajectories import Trajectory


@explains_arguments
@dataclass(frozen=True)
class Experiment:
    """One flight of one system, with everything that it depends on.

    Data come from the system that is learned; it is the plant as well, unless ``plant``
    is another one. ``seed`` is that of the subset of the data, of the training's random
    starts and of the noise: one seed gives one result. The subsets of one seed are
    nested, so that sizes can be compared in pairs.

    Raises:
        SettingError: A number out of range, an unknown policy or loop, or a disturbance
            that does not fit the plant.
        ShapeError: Noise that does not fit the plant.
    """

    #: where transitions come from
    data: DataSource
    #: what is followed, from its beginning; None holds the system's goal
    trajectory: Trajectory | None
    #: whose transitions are learned; names, units and references are its own
    system: System
    #: from transitions and a ``seed`` to a ``Training``, such as a ``Trainer``; one
    #: that learns differences learns what the system's description leaves open
    #: (``gpmpc.models.train``)
    train: Callable[..., Training]
    #: from a model, or from a ``plant`` where its first argument is called so, to a
    #: ``Controller``
    controller: Callable[..., Any]
    #: what flies, and the true model of a controller that takes one; by default the
    #: system
    plant: System | None = None
    #: of the trajectory, which data from files are filed under
    name: str = "elliptical"
    #: rows drawn for the training; None takes all
    size: int | None = None
    #: of the flight
    steps: int = 100
    #: of all random numbers
    seed: int = 0
    #: what stands at the other end: the plant, or the learned model rolled on itself
    loop: Literal["plant", "model"] = "plant"
    #: the controller's own, if it has one. A model loop carries its belief on with it,
    #: or as ``best_propagator`` does
    propagator: Propagator | None = None
    #: on the plant
    noise: Noise | None = None
    #: of the plant
    disturbances: Sequence[Disturbance] = ()
    #: what is applied where a solve fails
    on_failure: OnFailure = "previous_plan"
    #: from the flight, while it flies or after it
    learning: OnlineLearning | EpisodicLearning | None = None
    #: trained before; None trains one where the controller needs it
    model: DynamicsModel | None = None
    #: whether states that have rates are integrated from these, or learned too
    kinematics: KinematicsChoice = "integrated"

    def __post_init__(self) -> None:
        check_kind("system", self.system, System, "a System")
        if self.data is not None:
            check_method("data", self.data, "transitions", "RandomData(...)")
        self._check_functions()
        self._check_numbers()
        self._check_loop()
        self._check_plant()
        self._check_problem()
        if self.learns and self.model is None and hasattr(self.data, "check"):
            self.data.check(self.system, self.trajectory)

    @property
    def plant_in_loop(self) -> System:
        """The plant: the system, unless another one was given."""
        return self.plant or self.system

    @property
    def learns(self) -> bool:
        """Whether the controller works on a learned model."""
        first_argument = next(iter(inspect.signature(self.controller).parameters))
        return first_argument != "plant"

    def training_rows(self) -> Transitions:
        """Draws the rows to learn from, in the order of the flight that they come from.

        Raises:
            SettingError: More rows are asked for than there are.
            ShapeError: The data have other dimensions than the system.
        """
        data = self.data.transitions(self.system, self.trajectory, self.name)
        dimensions = (data.state_dim, data.input_dim)
        if dimensions != self._dimensions:
            raise ShapeError(
                f"data and system must have the same dimensions; got {dimensions}"
            )
        size = len(data) if self.size is None else self.size
        return data[random_rows(len(data), size, self.seed, "data.size")]

    def learn(self, transitions: Transitions, seed: int) -> Training:
        """Trains on transitions; see ``train``.

        Where the ``prior_lengthscale`` of a trainer is None, the system's limits say
        what it supposes of columns that never move.
        """
        return train(
            transitions,
            system=self.system,
            trainer=self.train,
            kinematics=self.kinematics,
            seed=seed,
        )

    def references(self, count: int) -> np.ndarray:
        """Returns the states to follow (count, n), one per time step."""
        return self.system.reference_states(self.trajectory, count)

    def unplanned_noise(
        self, training: Training | None, controller: Any = None
    ) -> np.ndarray:
        """Returns the noise of a next state that the covariances of a plan leave out.

        It is what the model has learned of it; a controller that knows the plant knows
        its noise as well. A plan of means alone leaves out everything.

        Args:
            training: What was learned for the flight; None where nothing was.
            controller: That flies, where it is known: compiled code tells the means of
                its plans alone.

        Returns:
            Standard deviations (n,), in the units of the states.
        """
        nothing = np.zeros(len(self.system.state_names))
        settings = getattr(self.controller, "keywords", {}).get("prediction")
        plans_means_alone = getattr(controller, "plans_means_alone", False)
        plans_means_alone |= getattr(settings, "covariance", "") == "none"
        propagates_noise = getattr(self.propagator, "process_noise", False)
        is_planned = propagates_noise and not plans_means_alone
        is_noiseless = self.loop == "model"  # rolled on itself, by its means
        if is_planned or is_noiseless:
            return nothing
        model = self.model if training is None else training.posterior
        if model is not None and self.learns:
            learned_variances = variances_of_next_row(model)
            assert learned_variances is not None
            return np.sqrt(learned_variances[: len(nothing)])
        noise_of_plant = None if self.noise is None else self.noise.process
        if noise_of_plant is None:
            return nothing
        return np.array(noise_of_plant, dtype=float)

    @property
    def _dimensions(self) -> tuple[int, int]:
        """Numbers of states and of inputs."""
        return len(self.system.state_names), len(self.system.input_names)

    def _check_functions(self) -> None:
        """Raises unless controller and training are functions of models and data."""
        if not callable(self.controller):
            raise SettingError(
                "controller",
                "must be a function from a model to a controller, such as "
                "functools.partial(GPMPC, propagator=..., problem=..., ...); "
                f"got {type(self.controller).__name__}",
            )
        if not (self.train is None or callable(self.train)):
            raise SettingError(
                "train", f"must be a function, such as Trainer(); got {self.train!r}"
            )

    def _check_numbers(self) -> None:
        if self.size is not None:
            check_number("data.size", self.size, least=1, whole=True)
        check_number("steps", self.steps, least=1, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        check_policy(self.on_failure)
        check_choice("kinematics", self.kinematics, KINEMATICS)

    def _check_loop(self) -> None:
        """Raises where plant, loop or learning do not fit the controller."""
        if self.loop not in ("plant", "model"):
            raise SettingError("loop", f"must be 'plant' or 'model'; got {self.loop!r}")
        signals = self.plant_in_loop.signals
        if self.system.signals != signals:
            raise SettingError(
                "plant",
                "must have the states, inputs and time step of "
                f"{self.system.name}; got {signals}",
            )
        if self.loop == "model" and not self.learns:
            raise SettingError(
                "loop",
                "a model loop needs a controller that learns a model; this one knows "
                "the plant",
            )
        learns_on_plant = self.learns and self.loop == "plant"
        if self.learning is not None and not learns_on_plant:
            raise SettingError(
                "learning",
                "needs a controller that learns a model, and a plant in the loop",
            )
        settings = getattr(self.controller, "keywords", {}).get("prediction")
        if isinstance(self.learning, OnlineLearning) and settings is not None:
            check_no_disturbance_estimate(settings)
        if isinstance(self.learning, EpisodicLearning) and self.model is not None:
            raise SettingError(
                "learning",
                "episodes train their models; leave out the one that was trained "
                f"before, model=FILE; got {type(self.model).__name__}",
            )

    def _check_plant(self) -> None:
        """Raises, before a training, where noise or disturbances do not fit."""
        for disturbance in self.disturbances:
            if not hasattr(disturbance, "disturb_plant"):
                raise SettingError(
                    "disturbances",
                    "must each name what it is, such as "
                    "{_target_: gpmpc.simulation.Gust, rates: {vx: 0.5}}; "
                    f"got {disturbance!r}",
                )
        if self.loop == "plant":
            plant = self.plant_in_loop
            PlantSimulator(plant, plant.goal, self.disturbances, self.noise, self.seed)

    def _check_problem(self) -> None:
        """Raises where the controller's problem does not fit system or start."""
        reference = self.references(1)[0]
        settings = getattr(self.controller, "keywords", {})
        problem: Problem | None = settings.get("problem")
        if problem is None:
            return
        if (problem.state_dim, problem.input_dim) != self._dimensions:
            n, m = self._dimensions
            raise SettingError(
                "controller.problem",
                f"weighs {problem.state_dim} states and {problem.input_dim} inputs; "
                f"{self.system.name} has {n} and {m}",
            )
        plant = self.plant_in_loop
        start = reference if plant.start is None else plant.start
        problem.check_start(
            np.asarray(start, dtype=float),
            np.asarray(plant.initial_input, dtype=float),
        )
