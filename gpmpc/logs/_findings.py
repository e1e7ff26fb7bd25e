"""What reading a log notices: findings, collected run by run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that was noticed in a run, and what was done about it."""

    kind: str  # such as "gap", "repeated stamp", "at rest"
    run: str
    count: int  # rows, or gaps
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
