"""Recordings of runs in MCAP files: writing, live view, reading, replaying, recovering."""

from gpmpc.recording._bags import bag_flaws
from gpmpc.recording._flaws import NO_CHECKSUMS, Flaw
from gpmpc.recording._layout import layout
from gpmpc.recording._messages import RecordedSystem
from gpmpc.recording._reader import Run, read_run, recover, replay
from gpmpc.recording._recorder import McapRecorder
from gpmpc.step import Step

__all__ = [
    "NO_CHECKSUMS",
    "Flaw",
    "McapRecorder",
    "RecordedSystem",
    "Run",
    "Step",
    "bag_flaws",
    "layout",
    "read_run",
    "recover",
    "replay",
]
