"""Chooses the runs of a sweep whose settings are tried before anything is launched.

To make the objects of one run takes ten milliseconds, of a hundred thousand a quarter
of an hour. A mistake in a sweep is one in what was typed: a wrong choice, a word that
is no number, the end of a range. So one run is tried for each choice of files, and for
each setting its least and its greatest number and what is no number; of all other
values some. Where one of the rest is a mistake, the runs that have it fail.
"""

import json
from collections.abc import Iterable, Sequence
from typing import Any

from gpmpc.cli._chunks import Job
from gpmpc.cli._composing import ComposedSettings
from gpmpc.cli._mistakes import explain
from gpmpc.exceptions import GpmpcError

_MOST_OTHERS = 20  # values that are tried beside choices and ends of ranges


class Examples:
    """The runs that are tried, and what was tried before."""

    def __init__(self):
        self._templates: set[int] = set()
        self._ends: dict[tuple[str, type], tuple[Any, Any]] = {}  # least and greatest
        self._others: set[tuple[str, str]] = set()  # key and value

    def of(self, jobs: Sequence[Job]) -> list[Job]:
        """Returns those of some runs that show what none before them has shown."""
        chosen: dict[str, Job] = {}
        for job in [*self._of_choices(jobs), *self._of_ends(jobs)]:
            chosen[str(job.folder.path)] = job
        for job in chosen.values():
            self._others.update(_values(job))
        for job in jobs:
            if len(self._others) > _MOST_OTHERS:
                break
            new = {*_values(job)} - self._others
            if new:
                self._others |= new
                chosen[str(job.folder.path)] = job
        return [*chosen.values()]

    def _of_choices(self, jobs: Iterable[Job]) -> list[Job]:
        """Returns the first run of each choice of files."""
        first = []
        for job in jobs:
            # Templates live as long as the sweep.
            if id(job.settings.template) not in self._templates:
                self._templates.add(id(job.settings.template))
                first.append(job)
        return first

    def _of_ends(self, jobs: Iterable[Job]) -> list[Job]:
        """Returns the runs with the least and the greatest number of every setting."""
        least: dict[tuple[str, type], Job] = {}
        greatest: dict[tuple[str, type], Job] = {}
        for job in jobs:
            for key, value in job.settings.values:
                if type(value) not in (int, float):
                    continue
                kind = key, type(value)
                low, high = self._ends.get(kind, (value, value))
                if kind not in self._ends or value < low:
                    least[kind] = job
                if kind not in self._ends or value > high:
                    greatest[kind] = job
                self._ends[kind] = min(low, value), max(high, value)
        return [*least.values(), *greatest.values()]


def try_settings(settings: Sequence[ComposedSettings]) -> None:
    """Makes the objects of some runs, in whichever process a launcher has for it.

    Raises:
        GpmpcError: They cannot be made; the mistake is told in one line.
    """
    # Loads what flies, for seconds.
    from gpmpc._compiling import report_compilation
    from gpmpc.cli._experiment import experiment_of

    with report_compilation():
        for each in settings:
            try:
                experiment_of(each.config())
            except SystemExit as error:
                raise GpmpcError(
                    f"code that the settings call ended the process (exit {error.code})"
                ) from error
            except Exception as error:
                message = explain(error, "run")
                if message is None:
                    raise
                raise GpmpcError(message) from error


def _values(job: Job) -> list[tuple[str, str]]:
    return [(key, json.dumps(value)) for key, value in job.settings.values]
