"""The command ``gpmpc``: thin entries over the package; the only importer of hydra."""

from gpmpc.cli.main import main

__all__ = ["main"]
