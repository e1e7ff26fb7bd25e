"""The command ``gpmpc``: thin entries over the package; the only importer of hydra.

    main -> _main (words to a command) -> _commands (the list) -> _NAME (the command)

This module is loaded before any library, so that Ctrl-C and SIGTERM, by which systems
end a process, end the command with one line from its first moment on.
"""

import signal
import sys
from contextlib import suppress
from types import FrameType


def main() -> None:
    """Runs the command line."""
    interrupts = _Interrupts()
    try:
        from gpmpc.cli._terminal import usable_streams

        with usable_streams():
            from gpmpc.cli._main import main as command

            command()
    except BaseException as error:  # whatever a library made of the interrupt
        if interrupts.number is None:
            raise
        has_advice = isinstance(error, KeyboardInterrupt) and error.args
        advice = f"; {error}" if has_advice else ""
        with suppress(OSError):
            print(f"\n{_WORDS[interrupts.number]}{advice}", file=sys.stderr)
        sys.exit(128 + interrupts.number)
    finally:
        interrupts.end_at_once()


# Signals that end a command, and what it says then.
_WORDS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class _Interrupts:
    """Makes every signal that ends a command a ``KeyboardInterrupt``.

    What is ignored stays so, such as Ctrl-C under nohup.
    """

    def __init__(self) -> None:
        #: the first one that came
        self.number: int | None = None
        self._numbers = [
            number
            for number in _WORDS
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
        ]
        for number in self._numbers:
            signal.signal(number, self._raise)
        if self._numbers and hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, self._raise)
            sys.unraisablehook = self._raise_again

    def end_at_once(self) -> None:
        """Lets the next one end what is still being tidied up, without a traceback."""
        for number in self._numbers:
            signal.signal(number, signal.SIG_DFL)

    def _raise(self, number: int, frame: FrameType | None) -> None:
        if self.number is None and number in _WORDS:
            self.number = number
        raise KeyboardInterrupt

    def _raise_again(self, lost: "sys.UnraisableHookArgs") -> None:
        """Interrupts once more where an interrupt was lost inside a finaliser.

        Python would print a traceback and go on.
        """
        if issubclass(lost.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.05)  # once this call is over
        else:
            sys.__unraisablehook__(lost)
