"""The command ``gpmpc``: thin entries over the package; the only importer of hydra.

    main -> _main (words to a command) -> _commands (the list) -> _NAME (the command)

What stands here is there before any library: Ctrl-C ends the command with one line from
its first moment on.
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
        if not interrupts.came:
            raise
        has_advice = isinstance(error, KeyboardInterrupt) and error.args
        advice = f"; {error}" if has_advice else ""
        with suppress(OSError):
            print(f"\ninterrupted{advice}", file=sys.stderr)
        sys.exit(130)
    finally:
        interrupts.end_at_once()


class _Interrupts:
    """Makes every Ctrl-C a ``KeyboardInterrupt``; under nohup it stays ignored."""

    def __init__(self) -> None:
        #: whether there was one
        self.came = False
        self._ignored = (
            signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        )
        if self._ignored:
            return
        signal.signal(signal.SIGINT, self._raise)
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, self._raise)
            sys.unraisablehook = self._raise_again

    def end_at_once(self) -> None:
        """Lets the next one end what is still being tidied up, without a traceback."""
        if not self._ignored:
            signal.signal(signal.SIGINT, signal.SIG_DFL)

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        raise KeyboardInterrupt

    def _raise_again(self, lost: "sys.UnraisableHookArgs") -> None:
        """Interrupts once more where an interrupt was lost inside a finaliser.

        Python would print a traceback and go on.
        """
        if issubclass(lost.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.05)  # once this call is over
        else:
            sys.__unraisablehook__(lost)
