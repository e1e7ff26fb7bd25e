"""Learning while flying: from step to step, and from flight to flight."""

from gpmpc.learning.change import ChangedModel
from gpmpc.learning.episodes import EpisodicLearning
from gpmpc.learning.online import Learned, LearningController, OnlineLearning

__all__ = ["ChangedModel", "EpisodicLearning", "Learned", "LearningController", "OnlineLearning"]
