"""Learning while flying: from step to step, and from flight to flight."""

from gpmpc.learning._online import ChangedModel, EpisodicLearning, Learned, LearningController, OnlineLearning

__all__ = ["ChangedModel", "EpisodicLearning", "Learned", "LearningController", "OnlineLearning"]
