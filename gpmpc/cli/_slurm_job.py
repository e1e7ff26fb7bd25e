"""Flies one chunk in a job of Slurm: python -m gpmpc.cli._slurm_job FOLDER INDEX."""

import pickle
import socket
import sys
import traceback
from pathlib import Path

from gpmpc.cli._folders import find_modules_here
from gpmpc.cli._slurm import CHUNKS, DONE
from gpmpc.cli._terminal import print_error


def main() -> None:
    """Flies the chunk; how it ended is the last line of the log."""
    folder, index = sys.argv[1:]
    try:
        find_modules_here()
        content = pickle.loads((Path(folder) / CHUNKS).read_bytes())
        content["work"](pickle.loads(content["chunks"][int(index)]))
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        print_error(f"error: {type(error).__name__}: {' '.join(str(error).split())}")
        sys.exit(1)
    print(f"{DONE}{socket.gethostname()}", file=sys.stderr)


if __name__ == "__main__":
    main()
