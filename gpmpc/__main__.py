"""``python -m gpmpc``: the command line, where its script is not on the path."""

from gpmpc.cli import main

if __name__ == "__main__":
    main()
