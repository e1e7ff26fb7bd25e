"""What reading a log notices: findings, collected run by run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that was noticed in a run, and what was done about it.

    Counts of different kinds cannot be added up: a row that is left out for a missing
    value may also be counted as a sample with a sentinel.
    """

    kind: str  # such as "gap", "repeated stamp", "at rest"
    run: str
    count: int  # of rows, samples or gaps, as the text says
    text: str


class RunFindings:
    """Adds the findings of one run to those of a log."""

    def __init__(self, run: str, findings: list[Finding]) -> None:
        self.run = run
        self._findings = findings

    def add(self, kind: str, count: int, text: str) -> None:
        """Adds a finding, unless its count is zero."""
        if count:
            self._findings.append(Finding(kind, self.run, int(count), text))
