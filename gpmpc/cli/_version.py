"""``gpmpc version``: prints what a report of a bug needs."""

import argparse

from gpmpc._provenance import environment
from gpmpc.cli._commands import Result


def version(arguments: argparse.Namespace) -> Result:
    """Prints versions, the BLAS library and the processor."""
    facts = environment()
    for name, value in facts.items():
        print(f"{name:10}{value}")
    return Result(facts)
