"""The arguments of commands that work on files and have no settings to compose."""

import argparse
from typing import Any, NoReturn

from gpmpc.exceptions import GpmpcError


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are errors of this package, so that they are answered as all others are."""

    def __init__(self, *arguments: Any, description: str | None = None, **settings: Any):
        plain = description and description.replace("``", "")  # a module's docstring, without its markup
        super().__init__(*arguments, description=plain, **settings)

    def error(self, message: str) -> NoReturn:
        """Raises instead of exiting.

        Raises:
            GpmpcError: Always.
        """
        raise GpmpcError(f"{message}; {self.prog} --help shows how")
