"""The .npz files of transitions and of the models of gpmpc 1.

Such a file is a zip of ``.npy`` arrays, each with its own CRC-32, and mostly of a ``header.json`` with a checksum of
itself and of the arrays' names, sizes and CRCs: parts that changed places are noticed. No pickle: reading runs no code.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_HEADER = "header.json"
_EXPANSION = 20  # times what a file holds: more than numbers shrink by


def write_npz(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """The content of a file that holds a header and named arrays, uncompressed."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(_HEADER, json.dumps(header | {"checksum": _checksum(header, archive)}, indent=2))
    return content.getvalue()


def read_npz(path: Path, names: tuple[str, ...] | None = None) -> tuple[Any, dict[str, np.ndarray]]:
    """The header, None where there is none, and the arrays of a file, all of them or those of the given names.

    Damage makes zipfile, json and NumPy raise whatever they come upon first: callers take any exception for one and
    name the file.
    """
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        declared = sum(info.file_size for info in archive.infolist())
        if declared > _EXPANSION * size:
            raise ValueError(f"declares {declared} bytes, more than a file of {size} bytes can hold")
        header = json.loads(archive.read(_HEADER)) if _HEADER in archive.namelist() else None
        if isinstance(header, dict) and "checksum" in header and header["checksum"] != _checksum(header, archive):
            raise ValueError("the checksum of its parts differs from the one in its header")
        if (damaged := archive.testzip()) is not None:  # compares the CRCs
            raise ValueError(f"{damaged} is damaged")
    with np.load(path, allow_pickle=False) as file:
        return header, {name: file[name] for name in file.files if name != _HEADER and (not names or name in names)}


def _checksum(header: dict[str, Any], archive: zipfile.ZipFile) -> str:
    parts = sorted((i.filename, i.file_size, i.CRC) for i in archive.infolist() if i.filename.endswith(".npy"))
    said = {key: value for key, value in header.items() if key != "checksum"}
    return hashlib.sha256(json.dumps([said, parts], sort_keys=True).encode()).hexdigest()
