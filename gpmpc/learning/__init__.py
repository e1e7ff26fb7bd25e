"""Learning while flying: from step to step, and from flight to flight."""

from gpmpc.learning._change import ChangedModel
from gpmpc.learning._episodes import EpisodicLearning
from gpmpc.learning._online import Learned, LearningController, OnlineLearning

__all__ = ["ChangedModel", "EpisodicLearning", "Learned", "LearningController", "OnlineLearning"]
