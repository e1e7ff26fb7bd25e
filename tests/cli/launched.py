"""Jobs and chunks for tests of launchers: what they do is in their choices."""

import os
import signal
import time
from dataclasses import dataclass

from gpmpc.studies._run_folder import Busy, RunFolder


@dataclass(frozen=True)
class Job:
    """One run; its only choice says what it does."""

    folder: RunFolder
    choices: tuple[str]


@dataclass(frozen=True)
class Chunk:
    """Runs that one process flies."""

    jobs: tuple[Job, ...]

    @property
    def folders(self):
        return [job.folder for job in self.jobs]


def jobs_of(tree, *acts):
    return [
        Job(RunFolder(tree / f"{i}-{act}"), (f"act={act}",))
        for i, act in enumerate(acts)
    ]


def in_chunks(size):
    def chunked(jobs):
        return [Chunk(tuple(jobs[i : i + size])) for i in range(0, len(jobs), size)]

    return chunked


def fly(chunk):
    for job in chunk.jobs:
        try:
            with job.folder.locked(wait=False):
                if not job.folder.finished:
                    fly_one(job)
        except Busy:
            continue


def fly_one(job):
    act = job.choices[0].removeprefix("act=")
    job.folder.begin("act: 1\n")
    if act == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if act == "dies once" and job.folder.outside_attempts == 0:
        os.kill(os.getpid(), signal.SIGSEGV)
    if act == "sleeps":
        time.sleep(600)
    if act == "raises":
        raise ValueError("of nobody's making")
    job.folder.finish({"settings": {}, "process": os.getpid()})
