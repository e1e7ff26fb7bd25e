"""The command as a user calls it."""

import os
import subprocess
import sys
from pathlib import Path

PATH = str(Path(sys.executable).with_name("gpmpc"))


def gpmpc(*arguments, cwd, **environment):
    """Runs to its end."""
    return subprocess.run(
        [PATH, *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | environment,
        timeout=300,
        check=False,
    )


def start(*arguments, cwd):
    """Runs on, in a process group of its own."""
    return subprocess.Popen(
        [PATH, *arguments], cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
