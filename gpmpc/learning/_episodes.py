"""Learns from one flight to the next: fly, learn, fly.

After each flight its transitions join the data, and a model is trained anew. Flights alone teach little of the
derivatives that a controller needs (``gpmpc.datasets.Excitation``), so the earlier data stay. A model that predicts
better may control worse, so the one whose flight had the smallest error flies the flight that counts. Where the plant
is another one than that of the data, these contradict the flights: there ``OnlineLearning`` helps.
"""

from dataclasses import dataclass

import numpy as np
import torch

from gpmpc.exceptions import check_number
from gpmpc.gp import Transitions
from gpmpc.simulation import Rollout


@dataclass(frozen=True)
class EpisodicLearning:
    """How a model is learned over episodes.

    Raises:
        SettingError: Fewer than two.
    """

    episodes: int = 2  #: flights before the one that counts: the first with the model of the data, two at least

    def __post_init__(self) -> None:
        check_number("learning.episodes", self.episodes, least=2, whole=True)

    def with_flight(self, data: Transitions, flight: Rollout) -> Transitions:
        """The data and the transitions of a flight, as far as they were measured."""
        known = np.all(np.isfinite(flight.measured), axis=1)
        rows = np.flatnonzero(np.logical_and(known[:-1], known[1:]))
        states, inputs, after = flight.measured[rows], flight.inputs[rows], flight.measured[rows + 1]
        parts = (data.states, states), (data.inputs, inputs), (data.next_states, after)
        return Transitions(*(torch.cat([first, torch.from_numpy(second)]) for first, second in parts))
