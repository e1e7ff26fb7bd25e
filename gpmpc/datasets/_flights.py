"""Records or reads flights of the quadrotor as transitions.

``NMPCData`` flies the experiment of Cao, Lai and Alam (2017), section 5, itself:
unconstrained NMPC on the true plant, first along the trajectory with the translational
subsystem, then along the attitude that those controls ask for with the rotational one.
``PaperData`` reads the four files that the authors published. ``ExcitedData`` flies
with dither: where a controller tracks well, inputs are a function of states and
references, and the effects of the two cannot be separated (Ljung, 1999, section 13.4: a
closed loop has to be excited). Measured, 189 samples, median error of a GP's
derivatives by the inputs along the elliptical flight, relative to the plant's: 4
without dither and noise, 0.1 to 0.2 with noise alone, 0.012 and 0.003 (translational,
rotational) with both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import DataError, SettingError, check_number, check_numbers
from gpmpc.gp import Transitions
from gpmpc.mpc import problem as mpc
from gpmpc.mpc.baselines import NMPC
from gpmpc.signals import Signals
from gpmpc.simulation import Noise, Rollout, closed_loop
from gpmpc.systems import System, attitude_for_thrust_direction, translational
from gpmpc.systems._quadrotor import ATTITUDES, approach_attitudes
from gpmpc.trajectories import Trajectory

_SUBSYSTEMS = ("translational", "rotational")


def check_quadrotor(system: System, trajectory: Trajectory | None) -> Trajectory:
    """Returns the trajectory that a quadrotor's subsystem is to fly.

    Raises ``SettingError`` unless there is one and the system is one of the two.
    """
    if system.name not in _SUBSYSTEMS:
        subsystems = " and ".join(_SUBSYSTEMS)
        raise SettingError(
            "data",
            f"these data are of {subsystems} alone; data=random is of any system; "
            f"got {system.name!r}",
        )
    if trajectory is None:
        raise SettingError("trajectory", "these data follow one; got none")
    return trajectory


class DataSource(Protocol):
    """A source of transitions of a system."""

    @property
    def note(self) -> str:
        """Remark for readers who compare results on these data with the paper's."""
        ...

    def check(self, system: System, trajectory: Trajectory | None) -> None:
        """Raises ``SettingError`` where there are no such data of the system."""
        ...

    def transitions(
        self, system: System, trajectory: Trajectory | None, name: str = ""
    ) -> Transitions:
        """Records or reads the transitions.

        Args:
            system: The system.
            trajectory: What it follows; None where it follows none.
            name: Of the trajectory, under which files are filed.
        """
        ...


def check_data(data: Any, **least: int) -> None:
    """Raises ``SettingError`` unless the settings of a data source are possible.

    Its numbers must be whole and large enough, and its attitude known.
    """
    for key, lowest in least.items():
        check_number(f"data.{key}", getattr(data, key), least=lowest, whole=True)
    if getattr(data, "attitude", "exact") not in ATTITUDES:
        raise SettingError(
            "data.attitude",
            f"must be one of {', '.join(ATTITUDES)}; got {data.attitude!r}",
        )


@dataclass(frozen=True)
class Tracking:
    """The plant and the weights with which one subsystem is flown.

    Raises:
        SettingError: A weight has another length than the plant's states or inputs.
    """

    plant: System  #: the true system
    Q: Sequence[float]  #: state weights, the diagonal (n,)
    R: Sequence[float]  #: input weights, the diagonal (m,)
    initial_input: Sequence[float]  #: first guess of the solver (m,)

    def __post_init__(self) -> None:
        check_numbers("Q", self.Q, len(self.plant.dynamics.state_names), least=0)
        check_numbers("R", self.R, len(self.plant.dynamics.input_names), least=0)

    def fly(self, references: np.ndarray, horizon: int, steps: int) -> Rollout:
        """Flies unconstrained NMPC from rest along references (steps + horizon, n)."""
        problem = mpc.Problem(mpc.Tracking(self.Q, self.R, penalized="inputs"))
        controller = NMPC(self.plant, problem, horizon, self.initial_input)
        at_rest = np.zeros(len(self.Q))
        return closed_loop(self.plant, controller, references, at_rest, steps)


@explains_arguments
@dataclass(frozen=True)
class NMPCData:
    """Transitions of unconstrained NMPC on the true plant."""

    translational: Tracking  #: how the outer subsystem is flown
    rotational: Tracking  #: how the inner subsystem is flown
    samples: int = 189  #: transitions of either subsystem
    horizon: int = 2  #: of the controller: predicted states in its cost
    #: how thrust direction becomes attitude: ``"paper"`` or ``"exact"``; see
    #: ``attitude_for_thrust_direction``
    attitude: str = "paper"

    note = (
        "Data: our own flights. Rotational: our yaw channels are at rest, the authors' "
        "hold their solver's residue, scaled to full range; ours come out smaller. "
        "Lorenz: the authors' path is only approximately known; expect the order of "
        "magnitude."
    )

    def __post_init__(self) -> None:
        check_data(self, samples=1, horizon=1)

    check = staticmethod(check_quadrotor)

    def transitions(
        self, system: System, trajectory: Trajectory | None, name: str = ""
    ) -> Transitions:
        """Flies the trajectory, or its attitude, by the plants of these settings.

        The rotational subsystem flies the attitude.
        """
        trajectory = check_quadrotor(system, trajectory)
        # Without a time step: a map goes from state to state, whatever the time is.
        signals = Signals(system.state_names, system.input_names)
        outer_flight = self._fly_trajectory(trajectory)
        if system.name == "translational":
            return _transitions(outer_flight, self.samples, signals)
        inner_flight = self._fly_attitudes(outer_flight)
        return _transitions(inner_flight, self.samples, signals)

    def _fly_trajectory(self, trajectory: Trajectory) -> Rollout:
        """Flies the translational subsystem, as long as attitudes of it are needed.

        The references of the last attitudes reach a horizon beyond the last step.
        """
        steps = self.samples + self.horizon
        times = self.translational.plant.time_step * np.arange(steps + self.horizon)
        # The velocities are asked to be zero, with little weight.
        references = np.zeros((len(times), 6))
        references[:, [0, 2, 4]] = trajectory(times)  # x, y, z
        return self.translational.fly(references, self.horizon, steps)

    def _fly_attitudes(self, outer_flight: Rollout) -> Rollout:
        """Flies the rotational subsystem along the attitudes of a flight."""
        angles = _attitudes(outer_flight, self.attitude)
        # Yaw and the rates are to be zero.
        references = np.zeros((len(angles), 6))
        references[:, [0, 2]] = angles  # roll, pitch
        return self.rotational.fly(references, self.horizon, self.samples)


@explains_arguments
@dataclass(frozen=True)
class PaperData:
    """The authors' published files, ``ds_nmpc_<Trajectory>_<trans|rotate>.txt``."""

    folder: str | Path  #: where the files lie
    samples: int = 189  #: rows to use from the top of each file

    note = "Data: the authors' own."

    def __post_init__(self) -> None:
        check_data(self, samples=1)
        if not isinstance(self.folder, str | Path) or not Path(self.folder).is_dir():
            raise DataError(
                f"{self.folder}: no such folder; "
                "data.folder must hold the authors' four text files"
            )

    check = staticmethod(check_quadrotor)

    def transitions(
        self, system: System, trajectory: Trajectory | None, name: str = ""
    ) -> Transitions:
        """Reads one file.

        Raises:
            DataError: It is missing, malformed, or shorter than ``samples``.
        """
        self.check(system, trajectory)
        suffix = {"translational": "trans", "rotational": "rotate"}[system.name]
        path = Path(self.folder) / f"ds_nmpc_{name.capitalize()}_{suffix}.txt"
        data = Transitions.from_text(path)
        if len(data) < self.samples:
            raise DataError(
                f"{path}: the file holds {len(data)} rows; "
                f"data.samples asks for {self.samples}"
            )
        return data[: self.samples]


def _transitions(flight: Rollout, samples: int, signals: Signals) -> Transitions:
    """Returns the first transitions of a flight."""
    states = flight.states[:samples]
    next_states = flight.states[1 : samples + 1]
    return Transitions(states, flight.inputs[:samples], next_states, signals)


def _attitudes(flight: Rollout, convention: str) -> np.ndarray:
    """Returns roll and pitch (K, 2) [rad] of a flight's decided thrust directions."""
    ux, uy = flight.inputs[:, 1:].T
    return attitude_for_thrust_direction(ux, uy, convention=convention)


@explains_arguments
@dataclass(frozen=True)
class Excitation:
    """A flight of one subsystem for data.

    NMPC flies the true system, which is shaken meanwhile.

    Raises:
        SettingError: A list has another length than the quadrotor's six states or three
            inputs.
    """

    Q: Sequence[float]  #: state weights, the diagonal (n,)
    R: Sequence[float]  #: weights of the inputs' increments, the diagonal (m,)
    #: first guess of the solver, and the input before the first (m,)
    initial_input: Sequence[float]
    #: standard deviation of what is added to the inputs (m,), in their units
    dither: Sequence[float]
    #: standard deviation of what is added to every next state (n,), in their units
    noise: Sequence[float]
    horizon: int = 1  #: of the NMPC

    def __post_init__(self) -> None:
        check_numbers("Q", self.Q, 6, least=0)
        check_numbers("noise", self.noise, 6, least=0)
        check_numbers("R", self.R, 3, least=0)
        check_numbers("initial_input", self.initial_input, 3)
        check_numbers("dither", self.dither, 3, least=0)
        check_number("horizon", self.horizon, least=1, whole=True)

    def fly(
        self, system: System, references: np.ndarray, steps: int, seed: int
    ) -> Rollout:
        """Flies along references (steps + horizon, n), from the first of them on."""
        problem = mpc.Problem(mpc.Tracking(self.Q, self.R))
        controller = NMPC(system, problem, self.horizon, self.initial_input)
        return closed_loop(
            system,
            controller,
            references,
            references[0],
            steps,
            noise=Noise(process=self.noise, input=self.dither),
            seed=seed,
            on_failure="previous_plan",
        )


@explains_arguments
@dataclass(frozen=True)
class ExcitedData:
    """Transitions of dithered flights, to train models that fly.

    The translational subsystem follows the trajectory from its beginning. The
    rotational one is asked for attitudes of that flight in random order, each held for
    a while and approached at first order, as a ``Cascade`` asks for them: so a few
    seconds at its own rate cover the whole flight's attitudes.
    """

    translational: Excitation  #: how the outer subsystem is flown
    rotational: Excitation  #: how the inner subsystem is flown
    samples: int = 189  #: transitions of either
    hold: int = 10  #: inner steps that an attitude is asked for
    response_time: float = 0.1  #: of the approach to it [s]
    #: how thrust direction becomes attitude: ``"exact"`` or ``"paper"``
    attitude: str = "exact"
    seed: int = 0  #: of dither, noise and the order of the attitudes

    note = (
        "Data: our own dithered and noisy flights of integrated plants. They are made "
        "for control; the paper's figures belong to noise-free data of the map."
    )

    def __post_init__(self) -> None:
        check_data(self, samples=1, hold=1, seed=0)
        check_number("data.response_time", self.response_time, above=0, unit="[s]")

    check = staticmethod(check_quadrotor)

    def transitions(
        self, system: System, trajectory: Trajectory | None, name: str = ""
    ) -> Transitions:
        """Flies the system; the inputs are those that acted, dither included.

        The attitudes that the rotational one flies are those of a flight of
        ``translational()``.
        """
        self.check(system, trajectory)
        if system.name == "translational":
            flight = self._fly_trajectory(system, trajectory)
        else:
            outer_flight = self._fly_trajectory(translational(), trajectory)
            flight = self._fly_attitudes(system, outer_flight)
        return _transitions(flight, self.samples, system.signals)

    def _fly_trajectory(self, outer: System, trajectory: Trajectory | None) -> Rollout:
        """Flies the translational subsystem along the trajectory."""
        references = outer.reference_states(
            trajectory, self.samples + self.translational.horizon
        )
        return self.translational.fly(outer, references, self.samples, self.seed)

    def _fly_attitudes(self, inner: System, outer_flight: Rollout) -> Rollout:
        """Flies the rotational subsystem along attitudes of a flight, drawn at random.

        Their order and the flight's noise have streams of random numbers of their own.
        """
        seeds = np.random.SeedSequence([self.seed, _SUBSYSTEMS.index("rotational")])
        angles = _attitudes(outer_flight, self.attitude)
        reference_count = self.samples + self.rotational.horizon
        attitude_count = -(-reference_count // self.hold)  # rounded up
        order = np.random.default_rng(seeds).integers(len(angles), size=attitude_count)
        references = approach_attitudes(
            angles[order],
            reference_count,
            self.hold,
            inner.time_step,
            self.response_time,
        )
        flight_seed = int(seeds.generate_state(1)[0])
        return self.rotational.fly(inner, references, self.samples, flight_seed)
