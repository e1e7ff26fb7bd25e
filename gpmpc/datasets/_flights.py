"""Records or reads the transitions of an experiment.

``NMPCData`` flies the experiment of Cao, Lai and Alam (2017), section 5, itself: unconstrained NMPC on the true plant,
first along the trajectory with the translational subsystem, then along the attitude that those controls ask for with
the rotational one. ``PaperData`` reads the four files that the authors published. Both give the data of one
trajectory and one subsystem at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from gpmpc.exceptions import DataError, SettingError, check_number, check_numbers
from gpmpc.gp import Transitions
from gpmpc.mpc import problem as mpc
from gpmpc.mpc.baselines import NMPC
from gpmpc.simulation import Rollout, closed_loop
from gpmpc.systems import ATTITUDES, Plant, System, attitude_for_thrust_direction
from gpmpc.trajectories import Trajectory

SUBSYSTEMS = ("translational", "rotational")


def check_quadrotor(system: System, trajectory: Trajectory | None) -> None:
    """Raises ``SettingError`` unless the system is one of the quadrotor's two and there is a trajectory."""
    if system.name not in SUBSYSTEMS:
        what = f"these data are of {' and '.join(SUBSYSTEMS)} alone; data=random is of any system"
        raise SettingError("data", f"{what}; got {system.name!r}")
    if trajectory is None:
        raise SettingError("trajectory", "these data follow one; got none")


class DataSource(Protocol):
    """Transitions of a system."""

    @property
    def note(self) -> str:
        """What a reader has to know who compares results on these data with the paper's."""
        ...

    def check(self, system: System, trajectory: Trajectory | None) -> None:
        """Raises a ``SettingError`` where there are no such data of the system."""
        ...

    def transitions(self, system: System, trajectory: Trajectory | None, name: str = "") -> Transitions:
        """Returns transitions.

        Args:
            system: Whose they are; data that are flown are flown by it, unless their settings say otherwise.
            trajectory: What it follows.
            name: What the trajectory is called, which files are filed under.
        """
        ...


@dataclass(frozen=True)
class Tracking:
    """How one subsystem is flown.

    Raises:
        SettingError: A weight has another length than the plant's states or inputs.
    """

    plant: Plant  #: the true system
    Q: Sequence[float]  #: state weights, the diagonal (n,)
    R: Sequence[float]  #: input weights, the diagonal (m,)
    initial_input: Sequence[float]  #: first guess of the solver (m,)

    def __post_init__(self) -> None:
        check_numbers("Q", self.Q, len(self.plant.dynamics.state_names), least=0)
        check_numbers("R", self.R, len(self.plant.dynamics.input_names), least=0)

    def fly(self, references: np.ndarray, horizon: int, steps: int) -> Rollout:
        """Unconstrained NMPC from rest along references (steps + horizon, n)."""
        problem = mpc.Problem(mpc.Tracking(self.Q, self.R, penalized="inputs"))
        controller = NMPC(self.plant, problem, horizon, self.initial_input)
        return closed_loop(self.plant, controller, references, np.zeros(len(self.Q)), steps)


@dataclass(frozen=True)
class NMPCData:
    """Transitions of unconstrained NMPC on the true plant."""

    translational: Tracking  #: how the outer subsystem is flown
    rotational: Tracking  #: how the inner subsystem is flown
    samples: int = 189  #: transitions of either subsystem
    horizon: int = 2  #: of the controller: predicted states in its cost
    #: how thrust direction becomes attitude: ``"paper"`` or ``"exact"``; see ``attitude_for_thrust_direction``
    attitude: str = "paper"

    note = (
        "Data: our own flights. Rotational: our yaw channels are at rest, the authors' hold their solver's residue, "
        "scaled to full range; ours come out smaller. Lorenz: the authors' path is only approximately known; expect "
        "the order of magnitude."
    )

    def __post_init__(self) -> None:
        check_number("data.samples", self.samples, least=1, whole=True)
        check_number("data.horizon", self.horizon, least=1, whole=True)
        if self.attitude not in ATTITUDES:
            raise SettingError("data.attitude", f"must be one of {', '.join(ATTITUDES)}; got {self.attitude!r}")

    check = staticmethod(check_quadrotor)

    def transitions(self, system: System, trajectory: Trajectory | None, name: str = "") -> Transitions:
        """Flies the trajectory by the plants of these settings, and for the rotational subsystem its attitude."""
        self.check(system, trajectory)
        steps = self.samples + self.horizon  # the attitude's references reach this far beyond its last step
        references = np.zeros((steps + self.horizon, 6))  # the velocities are asked to be zero, with little weight
        along: Any = trajectory
        references[:, ::2] = along(self.translational.plant.time_step * np.arange(len(references)))  # x, y, z
        outer = self.translational.fly(references, self.horizon, steps)
        if system.name == "translational":
            return transitions_of(outer, self.samples)
        angles = attitude_for_thrust_direction(outer.inputs[:, 1], outer.inputs[:, 2], self.attitude)
        references = np.zeros((len(angles), 6))
        references[:, [0, 2]] = angles  # phi, theta; psi and the rates are to be zero
        return transitions_of(self.rotational.fly(references, self.horizon, self.samples), self.samples)


@dataclass(frozen=True)
class PaperData:
    """The authors' published files, ``ds_nmpc_<Trajectory>_<trans|rotate>.txt``."""

    folder: str | Path  #: where the files lie
    samples: int = 189  #: rows to use from the top of each file

    note = "Data: the authors' own."

    def __post_init__(self) -> None:
        check_number("data.samples", self.samples, least=1, whole=True)
        if not isinstance(self.folder, str | Path) or not Path(self.folder).is_dir():
            raise DataError(f"{self.folder}: no such folder; data.folder must hold the authors' four text files")

    check = staticmethod(check_quadrotor)

    def transitions(self, system: System, trajectory: Trajectory | None, name: str = "") -> Transitions:
        """Reads one file; ``DataError`` where it is missing, malformed, or shorter than ``samples``."""
        self.check(system, trajectory)
        part = {"translational": "trans", "rotational": "rotate"}[system.name]
        path = Path(self.folder) / f"ds_nmpc_{name.capitalize()}_{part}.txt"
        data = Transitions.from_text(path)
        if len(data) < self.samples:
            raise DataError(f"{path}: the file holds {len(data)} rows; data.samples asks for {self.samples}")
        return data[: self.samples]


def transitions_of(flight: Rollout, samples: int) -> Transitions:
    """The first transitions of a flight."""
    states, inputs = torch.from_numpy(flight.states), torch.from_numpy(flight.inputs)
    return Transitions(states[:samples], inputs[:samples], states[1 : samples + 1])
