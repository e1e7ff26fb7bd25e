"""Experiments as the command ``gpmpc run`` makes them from its words."""

from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._settings import compose, settings_folders


def experiment(*words):
    with settings_folders():
        return experiment_of(compose("run", list(words)))
