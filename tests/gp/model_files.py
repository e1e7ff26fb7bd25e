"""The files of models and of transitions, read and written by their format alone.

A header may say anything: its checksum is right.
"""

import hashlib
import io
import json
import zipfile

import numpy as np
import safetensors
import safetensors.numpy


def parts_of(path):
    """The header and the arrays of a model file."""
    with safetensors.safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return json.loads(file.metadata()["gpmpc"]), arrays


def content_of(header, arrays):
    """The content of a model file."""
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = hashlib.sha256(signed_text(header).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    header = header | {"checksum": digest.hexdigest()}
    return safetensors.numpy.save(arrays, {"gpmpc": json.dumps(header)})


def write(path, header, arrays):
    """Writes a model file."""
    path.write_bytes(content_of(header, arrays))


def write_npz(path, header, arrays):
    """Writes a file of transitions, or of a model of gpmpc 1."""
    content = io.BytesIO()
    np.savez(content, **arrays)
    with zipfile.ZipFile(content, "a") as archive:
        members = sorted(
            (info.filename, info.file_size, info.CRC) for info in archive.infolist()
        )
        text = json.dumps([json.loads(signed_text(header)), members], sort_keys=True)
        checksum = hashlib.sha256(text.encode()).hexdigest()
        archive.writestr("header.json", json.dumps(header | {"checksum": checksum}))
    path.write_bytes(content.getvalue())


def signed_text(header):
    """What a checksum is of: the header without it, in one spelling."""
    signed = {key: value for key, value in header.items() if key != "checksum"}
    return json.dumps(signed, sort_keys=True)
