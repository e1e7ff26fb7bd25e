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
    interrupts = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        raise KeyboardInterrupt

    def interrupt_again(lost: "sys.UnraisableHookArgs") -> None:
        """Interrupts once more where an interrupt was lost inside a finaliser.

        Python would print a traceback and go on.
        """
        if issubclass(lost.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.05)  # once this call is over
        else:
            sys.__unraisablehook__(lost)

    ignored = (
        signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    )  # as under nohup
    if not ignored:
        signal.signal(signal.SIGINT, interrupt)
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, interrupt)
            sys.unraisablehook = interrupt_again
    try:
        from gpmpc.cli._terminal import usable_streams

        with usable_streams():
            from gpmpc.cli._main import main as command

            command()
    except BaseException as error:  # whatever a library made of the interrupt
        if not interrupts:
            raise
        advice = (
            f"; {error}" if isinstance(error, KeyboardInterrupt) and error.args else ""
        )
        with suppress(OSError):
            print(f"\ninterrupted{advice}", file=sys.stderr)
        sys.exit(130)
    finally:
        if not ignored:
            signal.signal(
                signal.SIGINT, signal.SIG_DFL
            )  # ends what is still being tidied up, without a traceback
