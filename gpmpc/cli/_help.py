"""``gpmpc help``: lists the commands."""

import argparse

import gpmpc
from gpmpc.cli._commands import COMMANDS, Result

_USAGE = """gpmpc {version}: Gaussian process model predictive control

usage: gpmpc COMMAND [SETTING=VALUE ...] [OPTIONS]

commands:
{commands}

gpmpc COMMAND --help lists what a command takes, gpmpc run --cfg prints its settings. \
Every command takes
  --json    print the result as JSON on the standard output, \
everything else on the standard error
  --quiet   print nothing but errors
  --debug   show the traceback of an error

eval "$(gpmpc completion bash)" completes at TAB; zsh likewise; \
fish: gpmpc completion fish | source
"""


def help(arguments: argparse.Namespace) -> Result:
    """Lists the commands."""
    lines = [f"  {name:12}{command.summary}" for name, command in COMMANDS.items()]
    usage = _USAGE.format(version=gpmpc.__version__, commands="\n".join(lines))
    print(usage, end="")
    return Result()
