"""Recordings of runs in MCAP files: writing, live view, reading, replaying, recovering."""

from gpmpc.recording._flaws import Flaw
from gpmpc.recording._layout import layout
from gpmpc.recording._messages import RecordedSystem
from gpmpc.recording._reader import Run, read_run, recover, replay
from gpmpc.recording._recorder import McapRecorder
from gpmpc.step import Step

__all__ = [
    "Flaw",
    "McapRecorder",
    "RecordedSystem",
    "Run",
    "Step",
    "layout",
    "read_run",
    "recover",
    "replay",
]
