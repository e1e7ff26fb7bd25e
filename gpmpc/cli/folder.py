"""Where a command's results go: the mistakes that a user can make with it, in one line each."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gpmpc.exceptions import SettingError


def folder_of(settings: dict) -> Path:
    """The folder that ``folder`` names.

    Raises:
        SettingError: It is no text, or empty.
    """
    if not isinstance(settings["folder"], str) or not settings["folder"].strip():
        raise SettingError("folder", f"must be the path of a folder; got {settings['folder']!r}")
    return Path(settings["folder"])


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """What is written inside goes to ``folder``, which the setting ``key`` named.

    Raises:
        SettingError: It cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise SettingError(key, f"cannot write to {folder}: {error.strerror or error}") from error
