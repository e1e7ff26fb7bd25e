"""Files of models: plain arrays in a safetensors file, with a header.

The metadata entry ``gpmpc`` holds the header as JSON: kind, dimensions, versions, names
and units where they are known, and a checksum of everything; so no damaged or foreign
file passes for a model. Any safetensors library opens the file where gpmpc is not
installed. Reading runs no code, and the declared sizes are compared with the file's
before memory is allocated.

The Cholesky factor is stored (its lower triangle): factorising again would give other
last digits, and the factor of a posterior that was updated or made sparse does not
follow from its hyperparameters at all. The header also keeps the order in which a
tensor's dimensions lie in memory, because BLAS rounds differently for each; so a loaded
model predicts bit by bit what the saved one does.

Transitions, and the models of gpmpc 1, are ``.npz``: a zip of ``.npy`` arrays, each
with its own CRC-32, and mostly of a ``header.json`` with a checksum of itself and of
the arrays' names, sizes and CRCs.
"""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._files import existing_file, new_file, write_whole
from gpmpc._provenance import now, versions
from gpmpc.exceptions import DataError, SettingError, UnsupportedModel
from gpmpc.gp._kernel import kernel_matrix
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._tensor_checks import check_gp_tensors
from gpmpc.signals import Signals, check_signals

_FORMAT = "gpmpc model"
_VERSION = 2
_DTYPES = {torch.float64: "float64", torch.float32: "float32"}
_LONGEST = 2**20  # characters of a header
_HEADER = "header.json"
_POSTERIOR_TENSORS = (
    "features",
    "targets",
    "lengthscales",
    "signal_variance",
    "noise_variance",
    "offset",
    "cholesky",
    "weights",
)
# what the header calls the targets
_OBSERVATIONS = "observations"
_PSEUDO_OBSERVATIONS = "pseudo-observations"
_EXPANSION = 20  # times what a file holds: more than numbers shrink by


@explains_arguments
def save_posterior(
    posterior: GPPosterior, path: str | Path, metadata: Mapping[str, Any] | None = None
) -> None:
    """Writes a posterior to one file, in one piece or not at all.

    Args:
        posterior: On any device; float64 or float32.
        path: The file; ``.safetensors`` by convention.
        metadata: Kept in the header, such as names and units of states and inputs; what
            JSON can hold.

    Raises:
        UnsupportedModel: It is of a derived class, whose own parts this format does not
            hold.
        SettingError: It is in another floating-point type, or the metadata are no JSON.
        DataError: The folder does not exist, or the posterior is inconsistent and could
            not be read again.

    See Also:
        ``load_posterior``, and ``gpmpc.models.save_model`` for models around a GP.
    """
    path = new_file(path)
    if metadata is not None and not isinstance(metadata, Mapping):
        raise SettingError("metadata", f"must be a mapping; got {metadata!r}")
    header, tensors = posterior_parts(path, posterior)
    write_model(path, "GPPosterior", header, tensors, metadata)


@explains_arguments
def load_posterior(path: str | Path) -> GPPosterior:
    """Reads a file of ``save_posterior``, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.

    See Also:
        ``save_posterior``, and ``gpmpc.models.load_model`` for models around a GP.
    """
    path = existing_file(path, "a saved GPPosterior")
    header, tensors = read_model(path, "GPPosterior")
    return posterior_of_parts(path, header, tensors)


@explains_arguments
def load_metadata(path: str | Path) -> dict[str, Any]:
    """Reads the header of a model file.

    It has kind, dimensions, versions, and the metadata that the model was saved with.

    See Also:
        ``load_posterior``, which reads the whole file.
    """
    path = existing_file(path, "a saved model")
    header, _ = _content(path, "model", header_only=True)
    return header


def posterior_parts(
    path: Path, posterior: GPPosterior
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the header and the tensors of a posterior.

    Raises:
        DataError: They could not be read again.
    """
    if type(posterior) is not GPPosterior:
        raise UnsupportedModel(
            f"only a GPPosterior can be saved; got {type(posterior).__name__}"
        )
    check_signals(posterior.signals)
    header: dict[str, Any] = {
        "predicts": posterior.predicts,
        "input_dim": posterior.input_dim,
        "states": posterior.state_dim,
        "outputs": posterior.output_dim,
        "points": len(posterior),
        "signals": posterior.signals.to_header(),
    }
    tensors = {name: getattr(posterior, name) for name in _POSTERIOR_TENSORS}
    if posterior.observation_noise is None:
        header["targets"] = _PSEUDO_OBSERVATIONS
    else:
        header["targets"] = _OBSERVATIONS
        tensors["observation_noise"] = posterior.observation_noise
    posterior_of_parts(path, header, tensors)
    return header, tensors


def posterior_of_parts(
    path: Path, header: Any, tensors: Mapping[str, Tensor]
) -> GPPosterior:
    """Builds a posterior of a file's header and tensors, after checks.

    Raises:
        DataError: They do not belong together.
    """
    names = ", ".join(_POSTERIOR_TENSORS)
    with consistent(path, f"not a consistent posterior of {names}"):
        parts = {name: tensors[name] for name in _POSTERIOR_TENSORS}
        kind_of_targets = header.get("targets")
        if kind_of_targets == _OBSERVATIONS:
            parts["observation_noise"] = tensors["observation_noise"]
        predicts = header["predicts"]
        m = header["input_dim"]
        check_gp_tensors(
            **parts, input_dim=m, predicts=predicts, dtype=parts["features"].dtype
        )
        signals = Signals.from_header(header.get("signals"))
        signals.check_sizes(parts["features"].shape[1] - m, m)
    if not bool((parts["cholesky"].diagonal(dim1=-2, dim2=-1) > 0).all()):
        raise DataError(f"{path}: the diagonal of cholesky must be positive")
    posterior = GPPosterior(**parts, input_dim=m, predicts=predicts, signals=signals)
    if kind_of_targets is not None:
        return posterior
    return replace(posterior, observation_noise=_noise_of_factor(posterior))


def _noise_of_factor(posterior: GPPosterior) -> Tensor | None:
    """Reads the observation noise (k,) off a factor; None of pseudo-observations.

    Files of gpmpc 0.2 and before do not say it. Of observations the factor is that of
    the kernel matrix and one noise: ``noise_variance``, or that before
    ``separate_noise`` left the process' part there.
    """
    signal_variance = posterior.signal_variance
    diagonal = torch.linalg.vector_norm(posterior.cholesky, dim=-1).square()
    nominal = (signal_variance + posterior.noise_variance)[:, None]
    round_off = torch.finfo(posterior.dtype).eps ** 0.75 * nominal

    def is_round_off(errors: Tensor) -> bool:
        return bool((errors.abs() <= round_off).all())

    if is_round_off(diagonal - nominal):
        return posterior.noise_variance
    noise = diagonal.mean(-1) - signal_variance
    if len(posterior) == 1:
        # a pseudo-observation sums up several rows: its noise is less than theirs
        return noise if bool((noise > posterior.noise_variance).all()) else None
    # Of the matrix that was factorised the diagonal and the first column are asked.
    cross = kernel_matrix(
        posterior.features[1:],
        posterior.features[:1],
        lengthscales=posterior.lengthscales,
        signal_variance=signal_variance,
    )[..., 0]
    first_column = posterior.cholesky[:, 1:, 0] * posterior.cholesky[:, :1, 0]
    is_kernel_and_noise = (
        bool((noise > 0).all())
        and is_round_off(diagonal - diagonal[:, :1])
        and is_round_off(first_column - cross)
    )
    return noise if is_kernel_and_noise else None


@contextmanager
def consistent(path: Path, otherwise: str) -> Iterator[None]:
    """Turns whatever parts of a file raise into one ``DataError`` that names it."""
    try:
        yield
    except Exception as error:
        if isinstance(error, DataError) and str(error).startswith(f"{path}: "):
            raise
        raise DataError(f"{path}: {otherwise} ({_reason(error)})") from error


def brief(value: Any) -> str:
    """Shortens what stands in a file to one line."""
    return f"{' '.join(str(value).split()):.80}"


def _reason(error: Exception) -> str:
    """Returns the text of an error in one line; its kind where it has no text."""
    return f"{' '.join(str(error).split()) or type(error).__name__:.500}"


def write_model(
    path: Path,
    kind: str,
    header: dict,
    tensors: dict[str, Tensor],
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Writes a model file of a kind, in one piece or not at all."""
    for name, value in tensors.items():
        if value.dtype not in _DTYPES:
            raise SettingError(
                name,
                f"must be one of {', '.join(_DTYPES.values())} to be saved; "
                f"got {value.dtype}",
            )
    tensors = {name: value.detach() for name, value in tensors.items()}
    arrays = {
        name: _packed(name, value).cpu().contiguous().numpy()
        for name, value in tensors.items()
    }
    # Dimensions from the outermost to the innermost.
    memory_order = {
        name: sorted(range(value.dim()), key=value.stride, reverse=True)
        for name, value in tensors.items()
    }
    header = {
        "format": _FORMAT,
        "format_version": _VERSION,
        "kind": kind,
        "kernel": "SE-ARD",
        **header,
        "memory_order": memory_order,
        "versions": versions(("gpmpc", "torch", "gpytorch", "numpy")),
        "created": now(),
        "metadata": dict(metadata or {}),
    }
    header = _as_read(header)
    text = json.dumps({**header, "checksum": _checksum(header, arrays)})
    _check_length(text)
    write_whole(path, safetensors.numpy.save(arrays, {"gpmpc": text}))


def read_model(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Reads the header and the tensors of a model file of a kind, in host memory.

    Errors are those of ``load_posterior``.
    """
    header, arrays = _content(path, kind)
    for key, expected in (("kind", kind), ("kernel", "SE-ARD")):
        got = header.get(key)
        if got != expected:
            raise DataError(f"{path}: holds a {brief(got)}; expected a {expected}")
    try:
        if not _is_npz(path) and header["checksum"] != _checksum(header, arrays):
            raise ValueError(
                "the checksum of its parts differs from the one in its header"
            )
        tensors: dict[str, Tensor] = {}
        for name in list(arrays):
            order = header["memory_order"][name]
            # An array goes as soon as its tensor is there: no second copy of all.
            tensors[name] = _restored(name, arrays.pop(name), order)
        return header, tensors
    except Exception as error:
        raise DataError(
            f"{path}: damaged; expected a saved {kind} ({_reason(error)})"
        ) from error


def write_npz(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Returns the content of an uncompressed ``.npz`` file of a header and arrays."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    with zipfile.ZipFile(content, "a") as archive:
        header = _as_read(header)
        header = header | {"checksum": _npz_checksum(header, archive)}
        text = json.dumps(header, indent=2)
        _check_length(text)
        archive.writestr(_HEADER, text)
    return content.getvalue()


def _as_read(header: dict[str, Any]) -> dict[str, Any]:
    """Returns a header as a reader will find it: in JSON every key is text.

    A checksum of anything else would not be that of what is read.

    Raises:
        SettingError: JSON cannot hold it.
    """
    try:
        return json.loads(json.dumps(header))
    except (TypeError, ValueError, RecursionError) as error:
        raise SettingError(
            "metadata", f"must be what JSON can hold; {error}"
        ) from error


def _check_length(text: str) -> None:
    """Raises ``SettingError`` where a header is longer than readers take."""
    if len(text) > _LONGEST:
        raise SettingError(
            "metadata",
            f"must leave a header of at most {_LONGEST} characters (names, parameters "
            f"and metadata as JSON); got {len(text)}: keep long series in a file of "
            "their own",
        )


def read_npz(
    path: Path, names: tuple[str, ...] | None = None
) -> tuple[Any, dict[str, np.ndarray]]:
    """Reads the header of a file, None where there is none, and its arrays.

    Arrays are all of them, or those of the given names.

    Damage makes zipfile, json and NumPy raise whatever they come upon first: callers
    take any exception for one and name the file.
    """
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        declared = sum(info.file_size for info in members)
        if declared > _EXPANSION * size:
            raise ValueError(
                f"declares {declared} bytes, more than a file of {size} bytes can hold"
            )
        for info in members:
            if info.filename == _HEADER and info.file_size > _LONGEST:
                raise ValueError(f"its header is longer than {_LONGEST} characters")
            name, is_array, _ = info.filename.rpartition(".npy")
            if is_array and (not names or name in names):
                _check_array_size(archive, info)
        header = None
        if _HEADER in archive.namelist():
            header = json.loads(archive.read(_HEADER))
        if isinstance(header, dict):
            expected = _npz_checksum(header, archive)
            if header.get("checksum", expected) != expected:
                raise ValueError(
                    "the checksum of its parts differs from the one in its header"
                )
        damaged = archive.testzip()  # compares the CRCs
        if damaged is not None:
            raise ValueError(f"{damaged} is damaged")
    with np.load(path, allow_pickle=False) as file:
        chosen = [n for n in file.files if n != _HEADER and (not names or n in names)]
        return header, {name: file[name] for name in chosen}


def _check_array_size(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    """Raises ``ValueError`` where an array says to be larger or smaller than it is."""
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        if version == (1, 0):
            header = np.lib.format.read_array_header_1_0(member)
        else:  # a later version is of names in a structure, which no number has
            header = np.lib.format.read_array_header_2_0(member)
        shape, _, dtype = header
        stored = info.file_size - member.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != stored:
        raise ValueError(
            f"{info.filename} is an array of shape {shape!s:.80} and {stored} bytes"
        )


def _content(
    path: Path, kind: str, header_only: bool = False
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads the header and the arrays of a model file."""
    try:
        if _is_npz(path):
            header, arrays = read_npz(path)
        else:
            with safetensors.safe_open(path, framework="numpy") as file:
                text = (file.metadata() or {}).get("gpmpc", "null")
                if len(text) > _LONGEST:
                    raise ValueError(f"its header is longer than {_LONGEST} characters")
                header = json.loads(text)
                names = file.keys()
                if header_only or not isinstance(header, dict):
                    names = []
                arrays = {name: file.get_tensor(name) for name in names}
    except Exception as error:  # damage makes libraries raise whatever they meet first
        raise DataError(
            f"{path}: damaged, or not a file of this package; expected a saved {kind} "
            f"({_reason(error)})"
        ) from error
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise DataError(f"{path}: a file of something else; expected a saved {kind}")
    version = header.get("format_version")
    if not isinstance(version, int) or not 1 <= version <= _VERSION:
        raise DataError(
            f"{path}: written in format {version!r:.80} "
            f"(versions {brief(header.get('versions'))}); this version reads up to "
            f"{_VERSION}: update gpmpc"
        )
    return header, arrays


def _is_npz(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"PK"


def _without_checksum(header: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in header.items() if key != "checksum"}


def _npz_checksum(header: dict[str, Any], archive: zipfile.ZipFile) -> str:
    members = sorted(
        (info.filename, info.file_size, info.CRC)
        for info in archive.infolist()
        if info.filename.endswith(".npy")
    )
    text = json.dumps([_without_checksum(header), members], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _checksum(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    text = json.dumps(_without_checksum(header), sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _packed(name: str, value: Tensor) -> Tensor:
    """Packs a factor (k, N, N) to its lower triangle, row by row (k, N (N + 1) / 2).

    Anything else stays as it is.
    """
    if not name.endswith("cholesky"):
        return value
    rows, columns = torch.tril_indices(*value.shape[-2:], device=value.device)
    return value[..., rows, columns]


def _restored(name: str, stored: np.ndarray, order: list[int]) -> Tensor:
    """Returns the tensor of an array, lying in memory as it did when it was saved.

    Args:
        name: Of the tensor: a factor is stored as its lower triangle.
        stored: The array of the file.
        order: The tensor's dimensions from the outermost to the innermost.
    """
    if stored.dtype.name not in _DTYPES.values():
        raise ValueError(
            f"{name} must be of type {' or '.join(_DTYPES.values())}; "
            f"got {stored.dtype}"
        )
    is_triangle = name.endswith("cholesky")
    size = math.isqrt(2 * stored.shape[-1])
    shape = (len(stored), size, size) if is_triangle else stored.shape
    is_order = sorted(order) == list(range(len(shape)))
    fits = not is_triangle or stored.shape == (len(stored), size * (size + 1) // 2)
    if not is_order or not fits:
        raise ValueError(
            f"{name} of shape {stored.shape} cannot lie in the order {order}"
        )
    inverse_order = sorted(range(len(shape)), key=order.__getitem__)
    # Pages that nobody writes are free.
    in_memory = np.zeros([shape[i] for i in order], stored.dtype)
    array = in_memory.transpose(inverse_order)
    if is_triangle:
        for row in range(size):
            start = row * (row + 1) // 2
            array[:, row, : row + 1] = stored[:, start : start + row + 1]
    else:
        array[...] = stored
    return torch.from_numpy(array)
