"""Logs of real systems: reading, checking, learning from them, and judging what was learned."""

from gpmpc.logs.log import Finding, Log, LogRun, Windows
from gpmpc.logs.mapping import LogMapping, Signal
from gpmpc.logs.readers import read_streams
from gpmpc.logs.reading import read_log
from gpmpc.logs.state_space import StateGroup, StateSpace

__all__ = [
    "Finding",
    "Log",
    "LogMapping",
    "LogRun",
    "Signal",
    "StateGroup",
    "StateSpace",
    "Windows",
    "read_log",
    "read_streams",
]
