"""Records flights with dither on the inputs, from which a model for control can be learned.

A flight that tracks well teaches little: where the controller does its work, inputs are a function of states and
references, and the effects of the two cannot be separated (Ljung, 1999, section 13.4: a closed loop has to be
excited). A GP trained on such data predicts the very same flight closely and has useless derivatives by the inputs,
which are what a controller steers by. The remedy is dither: seeded white noise on the inputs, in their own units, well
above the process noise. Measured, 189 samples, error of the derivatives by the inputs relative to the plant's, median
along the elliptical flight:

                     dither and noise   noise alone   neither
    translational               0.012          0.19       4.1
    rotational                  0.003          0.11       4.0

Steered by the first column's GPs, one step ahead, the plant keeps within 0.03 m of that flight (RMSE); by the last's it
ends up a kilometre away.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpmpc.datasets._flights import SUBSYSTEMS, check_quadrotor, transitions_of
from gpmpc.exceptions import SettingError, check_number, check_numbers
from gpmpc.gp.transitions import Transitions
from gpmpc.mpc.baselines import NMPC
from gpmpc.mpc.problem import Problem, Tracking
from gpmpc.simulation import Noise, Rollout, closed_loop
from gpmpc.systems import ATTITUDES, System, approach_attitudes, attitude_for_thrust_direction, translational
from gpmpc.trajectories import Trajectory


@dataclass(frozen=True)
class Excitation:
    """How one subsystem is flown for data: NMPC on the true system, which is shaken meanwhile.

    Raises:
        SettingError: A list has another length than the quadrotor's six states or three inputs.
    """

    Q: Sequence[float]  #: state weights, the diagonal (n,)
    R: Sequence[float]  #: weights of the inputs' increments, the diagonal (m,)
    initial_input: Sequence[float]  #: first guess of the solver, and the input before the first (m,)
    dither: Sequence[float]  #: standard deviation of what is added to the inputs (m,), in their units
    noise: Sequence[float]  #: standard deviation of what is added to every next state (n,), in their units
    horizon: int = 1  #: of the NMPC

    def __post_init__(self) -> None:
        for key, length in (("Q", 6), ("noise", 6), ("R", 3), ("initial_input", 3), ("dither", 3)):
            check_numbers(key, getattr(self, key), length, **({} if key == "initial_input" else {"least": 0}))
        check_number("horizon", self.horizon, least=1, whole=True)

    def fly(self, system: System, references: np.ndarray, steps: int, seed: int) -> Rollout:
        """From the first of the references (steps + horizon, n) on."""
        problem = Problem(Tracking(self.Q, self.R))
        controller = NMPC(system, problem, self.horizon, self.initial_input)
        noise = Noise(process=self.noise, input=self.dither)
        return closed_loop(
            system, controller, references, references[0], steps, noise=noise, seed=seed, on_failure="previous_plan"
        )


@dataclass(frozen=True)
class ExcitedData:
    """Transitions of dithered flights, to train models that fly.

    The translational subsystem follows the trajectory from its beginning. The rotational one is asked for attitudes of
    that flight in random order, each held for a while and approached at first order, as a ``Cascade`` asks for them: so
    a few seconds at its own rate cover the whole flight's attitudes.
    """

    translational: Excitation  #: how the outer subsystem is flown
    rotational: Excitation  #: how the inner subsystem is flown
    samples: int = 189  #: transitions of either
    hold: int = 10  #: inner steps that an attitude is asked for
    response_time: float = 0.1  #: of the approach to it [s]
    attitude: str = "exact"  #: how thrust direction becomes attitude: ``"exact"`` or ``"paper"``
    seed: int = 0  #: of dither, noise and the order of the attitudes

    note = (
        "Data: our own dithered and noisy flights of integrated plants. They are made for control; the paper's figures "
        "belong to noise-free data of the map."
    )

    def __post_init__(self) -> None:
        for key, least in (("samples", 1), ("hold", 1), ("seed", 0)):
            check_number(f"data.{key}", getattr(self, key), least=least, whole=True)
        check_number("data.response_time", self.response_time, above=0, unit="[s]")
        if self.attitude not in ATTITUDES:
            raise SettingError("data.attitude", f"must be one of {', '.join(ATTITUDES)}; got {self.attitude!r}")

    check = staticmethod(check_quadrotor)

    def transitions(self, system: System, trajectory: Trajectory | None, name: str = "") -> Transitions:
        """Flies the system; the inputs are those that acted, dither included.

        The attitudes that the rotational one flies are those of a flight of ``translational()``.
        """
        self.check(system, trajectory)
        outer = system if system.name == "translational" else translational()
        references = outer.reference_states(trajectory, self.samples + self.translational.horizon)
        flight = self.translational.fly(outer, references, self.samples, self.seed)
        if system is outer:
            return transitions_of(flight, self.samples)
        streams = np.random.SeedSequence([self.seed, SUBSYSTEMS.index("rotational")])
        angles = attitude_for_thrust_direction(flight.inputs[:, 1], flight.inputs[:, 2], self.attitude)
        count = self.samples + self.rotational.horizon
        chosen = angles[np.random.default_rng(streams).integers(len(angles), size=-(-count // self.hold))]
        references = approach_attitudes(chosen, count, self.hold, system.time_step, self.response_time)
        seed = int(streams.generate_state(1)[0])
        return transitions_of(self.rotational.fly(system, references, self.samples, seed), self.samples)
