"""Learning between flights."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from gpmpc._arrays import is_measured
from gpmpc._calls import explains_arguments
from gpmpc.exceptions import check_number
from gpmpc.gp import Transitions
from gpmpc.signals import Signals
from gpmpc.simulation import Rollout


@explains_arguments
@dataclass(frozen=True)
class EpisodicLearning:
    """Learns from one flight to the next: its transitions join the data of a new model.

    Flights alone teach little of the derivatives that a controller needs
    (``gpmpc.datasets.Excitation``), so the earlier data stay. A model that predicts
    better may control worse, so the one whose flight had the smallest error flies the
    flight that counts. Where the plant is another one than that of the data, these
    contradict the flights: there ``OnlineLearning`` helps.
    """

    #: flights before the one that counts: the first with the model of the data, two at
    #: least
    episodes: int = 2

    def __post_init__(self) -> None:
        check_number("learning.episodes", self.episodes, least=2, whole=True)

    def with_flight(self, data: Transitions, flight: Rollout) -> Transitions:
        """Returns the data with the transitions of a flight that were measured."""
        data.signals.check(
            "the data", Signals(time_step=flight.time_step), "the flight"
        )
        measured = np.all(is_measured(flight.measured), axis=1)
        rows = np.flatnonzero(np.logical_and(measured[:-1], measured[1:]))
        states = torch.from_numpy(flight.measured[rows])
        inputs = torch.from_numpy(flight.inputs[rows])
        next_states = torch.from_numpy(flight.measured[rows + 1])
        return replace(
            data,
            states=torch.cat([data.states, states]),
            inputs=torch.cat([data.inputs, inputs]),
            next_states=torch.cat([data.next_states, next_states]),
        )
