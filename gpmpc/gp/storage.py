"""Problem: a trained model has to outlive its process, and a damaged or foreign file must never pass for one.

A model is one uncompressed ``.npz`` file of plain arrays and a header (``gpmpc.gp.archive``), which says what they are
and what wrote them; ``numpy.load`` opens it where gpmpc is not installed.

The Cholesky factor is stored too (its lower triangle): factorising again would give other last digits, and the factor
of a posterior that was updated or made sparse does not follow from its hyperparameters at all. The header also keeps
the order in which a tensor's dimensions lie in memory, because BLAS rounds differently for each; so what is loaded
predicts what was saved, bit by bit.
"""

import math
import mmap
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import DataError, GpmpcError, SettingError, UnsupportedModel
from gpmpc.files import write_whole
from gpmpc.gp.archive import HEADER, check_whole, existing_file, new_file, pack, read_arrays, read_header
from gpmpc.gp.kernel import PREDICTS
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.residual import Affine, ResidualModel
from gpmpc.provenance import now, versions

FORMAT, VERSION = "gpmpc model", 1
DTYPES = {torch.float64: "float64", torch.float32: "float32"}
POSITIVE = ("lengthscales", "signal_variance", "noise_variance")


def save_posterior(posterior: GPPosterior, path: str | Path) -> None:
    """Writes a posterior to one file, in one piece or not at all.

    Args:
        posterior: On any device; float64 or float32.
        path: The file; ``.npz`` by convention.

    Raises:
        UnsupportedModel: It is of a derived class, whose own parts this format does not know.
        SettingError: It is in another floating-point type.
        DataError: The folder does not exist, or the posterior is inconsistent and could not be read again.
    """
    path = new_file(path)
    _write(path, "GPPosterior", *_parts(path, posterior))


def load_posterior(path: str | Path) -> GPPosterior:
    """Reads what ``save_posterior`` wrote, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.
    """
    path = existing_file(path, "a saved GPPosterior")
    header, tensors = _read(path, "GPPosterior")
    posterior = _posterior(path, header, tensors)
    _check_whole(path, header, "GPPosterior")
    return posterior


def save_residual_model(model: ResidualModel, path: str | Path) -> None:
    """Writes a residual model with an affine nominal part to one file, in one piece or not at all.

    Raises:
        UnsupportedModel: The nominal model is code, which a file of numbers cannot hold.
        SettingError: A tensor is neither float64 nor float32.
        DataError: The folder does not exist.
    """
    path = new_file(path)
    if not isinstance(model.nominal, Affine):
        raise UnsupportedModel(
            f"only an Affine nominal model is numbers and can be saved; got {type(model.nominal).__name__}. Save the "
            "part that was learned (model.residual.save) and give ResidualModel the nominal function again"
        )
    header = {
        "input_dim": model.input_dim,
        "states": [int(i) for i in model.states],
        "inputs": [int(i) for i in model.inputs],
    }
    header["residual"], residual = _parts(path, model.residual)
    tensors = {"B": model.B, **{f"nominal/{name}": getattr(model.nominal, name) for name in ("A", "B", "c")}}
    tensors |= {f"residual/{name}": value for name, value in residual.items()}
    _write(path, "ResidualModel", header, tensors)


def load_residual_model(path: str | Path) -> ResidualModel:
    """Reads what ``save_residual_model`` wrote, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.
    """
    path = existing_file(path, "a saved ResidualModel")
    header, tensors = _read(path, "ResidualModel")
    residual = {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith("residual/")}
    gp = _posterior(path, _entry(path, header, "residual", dict), residual)
    m = _entry(path, header, "input_dim", int)
    n = len(tensors["B"]) if "B" in tensors and tensors["B"].dim() else 0
    shapes = {"B": (n, gp.output_dim), "nominal/A": (n, n), "nominal/B": (n, m), "nominal/c": (n,)}
    B, *nominal = _checked(path, tensors, shapes, gp.dtype).values()
    states, inputs = (_entry(path, header, name, list) for name in ("states", "inputs"))
    try:
        model = ResidualModel(Affine(*nominal), gp, B, states, inputs, m)
    except (GpmpcError, TypeError) as error:
        raise DataError(f"{path}: not a consistent residual model ({error})") from error
    _check_whole(path, header, "ResidualModel")
    return model


def _parts(path: Path, posterior: GPPosterior) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What goes into the header and what into arrays, after a look at whether it could be read again."""
    if type(posterior) is not GPPosterior:
        raise UnsupportedModel(f"only a GPPosterior can be saved; got {type(posterior).__name__}")
    header = {
        "predicts": posterior.predicts,
        "input_dim": posterior.input_dim,
        "states": posterior.state_dim,
        "outputs": posterior.output_dim,
        "points": len(posterior),
    }
    tensors = {f.name: v for f in fields(posterior) if isinstance(v := getattr(posterior, f.name), Tensor)}
    _posterior(path, header, tensors)
    return header, tensors


def _posterior(path: Path, header: dict, tensors: dict[str, Tensor]) -> GPPosterior:
    """A posterior of tensors, after they were held against each other."""
    predicts, m = _entry(path, header, "predicts", str), _entry(path, header, "input_dim", int)
    shape = {name: value.shape if value.dim() == 2 else (0, 0) for name, value in tensors.items()}
    size, d = shape.get("features", (0, 0))
    k = shape.get("targets", (0, 0))[1]
    shapes = {
        "features": (size, d),
        "targets": (size, k),
        "lengthscales": (k, d),
        "signal_variance": (k,),
        "noise_variance": (k,),
        "offset": (k,),
        "cholesky": (k, size, size),
        "weights": (k, size),
    }
    found = _checked(path, tensors, shapes, tensors["features"].dtype if "features" in tensors else None)
    if predicts not in PREDICTS or not (size and k) or not 0 <= m < d or (predicts != "value" and d != k + m):
        raise DataError(
            f"{path}: not a consistent posterior: {size} points, {d} features of which {m} are inputs, {k} outputs "
            f"that predict {predicts!r}"
        )
    wrong = [name for name in POSITIVE if not bool((found[name] > 0).all())]
    if not bool((found["cholesky"].diagonal(dim1=-2, dim2=-1) > 0).all()):
        wrong.append("the diagonal of cholesky")
    if wrong:
        raise DataError(f"{path}: {wrong[0]} must be positive")
    return GPPosterior(**found, input_dim=m, predicts=predicts)


def _checked(path: Path, tensors: dict, shapes: dict[str, tuple], dtype: torch.dtype | None) -> dict[str, Tensor]:
    for name, shape in shapes.items():
        if name not in tensors:
            raise DataError(f"{path}: array {name!r} is missing; expected {', '.join(shapes)}")
        value = tensors[name]
        if tuple(value.shape) != shape or value.dtype != dtype:
            raise DataError(f"{path}: {name} must be {dtype} {shape}; got {value.dtype} {tuple(value.shape)}")
        if not all(
            np.isfinite(part.to(torch.float64).numpy(force=True)).all()
            for part in (value if value.dim() == 3 else [value])
        ):
            raise DataError(f"{path}: {name} must be finite; got {float(value[~torch.isfinite(value)][0])}")
    return {name: tensors[name] for name in shapes}


def _entry(path: Path, header: dict, name: str, kind: type) -> Any:
    value = header.get(name)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise DataError(f"{path}: {HEADER} must say {name!r} ({kind.__name__}); got {value!r}")
    return value


def _write(path: Path, kind: str, header: dict, tensors: dict[str, Tensor]) -> None:
    tensors = {name: value.detach() for name, value in tensors.items()}
    for name, value in tensors.items():
        if value.dtype not in DTYPES:
            raise SettingError(name, f"must be one of {', '.join(DTYPES.values())} to be saved; got {value.dtype}")
    header = {
        "format": FORMAT,
        "format_version": VERSION,
        "kind": kind,
        "kernel": "SE-ARD",
        **header,
        "memory_order": {name: _order(value) for name, value in tensors.items()},
        "versions": versions(("gpmpc", "torch", "gpytorch", "numpy")),
        "created": now(),
    }
    arrays = ((name, _packed(name, value).cpu().contiguous().numpy()) for name, value in tensors.items())
    write_whole(path, pack(header, arrays))


def _read(path: Path, kind: str) -> tuple[dict, dict[str, Tensor]]:
    """Header and tensors of a file of the given kind."""
    try:
        header = read_header(path)
    except Exception as error:
        raise DataError(f"{path}: damaged, or not a file of this package; expected a saved {kind} ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise DataError(f"{path}: a file of something else; expected a saved {kind}")
    if not 1 <= _entry(path, header, "format_version", int) <= VERSION:
        raise DataError(
            f"{path}: written in format {header['format_version']} by gpmpc "
            f"{_entry(path, header, 'versions', dict).get('gpmpc')}; this version reads up to {VERSION}: update gpmpc"
        )
    if header.get("kind") != kind:
        raise DataError(f"{path}: holds a {header.get('kind')}; expected a {kind} ({header.get('kind')}.load reads it)")
    if header.get("kernel") != "SE-ARD":
        raise DataError(f"{path}: has the kernel {header.get('kernel')!r}; expected 'SE-ARD'")
    try:
        tensors = {name: _restored(name, array, header["memory_order"][name]) for name, array in read_arrays(path)}
    except Exception as error:
        raise DataError(f"{path}: damaged; expected a saved {kind} ({error})") from error
    return header, tensors


def _check_whole(path: Path, header: dict, kind: str) -> None:
    """After all that can say more exactly what is wrong."""
    try:
        check_whole(path, header)
    except Exception as error:
        raise DataError(f"{path}: damaged; expected a saved {kind} ({error})") from error


def _order(value: Tensor) -> list[int]:
    """The dimensions of a tensor from the outermost to the innermost in memory."""
    return sorted(range(value.dim()), key=value.stride, reverse=True)


def _packed(name: str, value: Tensor) -> Tensor:
    """A factor (k, N, N) as its lower triangle, row by row (k, N (N + 1) / 2); anything else as it is."""
    if not name.endswith("cholesky"):
        return value
    rows, columns = torch.tril_indices(*value.shape[-2:], device=value.device)
    return value[..., rows, columns]


def _restored(name: str, stored: np.ndarray, order: list[int]) -> Tensor:
    """The tensor of an array, lying in memory as it did when it was saved.

    The zeros above the diagonal of a factor are pages that nobody writes, which take no memory.
    """
    dtype = torch.from_numpy(np.empty(0, stored.dtype)).dtype
    triangular = name.endswith("cholesky")
    size = math.isqrt(2 * stored.shape[-1]) if triangular else 0
    shape = (len(stored), size, size) if triangular else stored.shape
    if sorted(order) != list(range(len(shape))) or (
        triangular and stored.shape != (len(stored), size * (size + 1) // 2)
    ):
        raise ValueError(f"{name} of shape {stored.shape} cannot lie in the order {order}")
    inverse = sorted(range(len(shape)), key=order.__getitem__)
    if not triangular:
        tensor = torch.empty([shape[d] for d in order], dtype=dtype).permute(inverse)
        tensor.numpy()[...] = stored
        return tensor
    pages = mmap.mmap(-1, len(stored) * size * size * stored.itemsize, access=mmap.ACCESS_COPY)
    tensor = torch.frombuffer(pages, dtype=dtype, count=len(stored) * size * size)
    tensor = tensor.view([shape[d] for d in order]).permute(inverse)
    lower = tensor.numpy()
    for row in range(size):
        start = row * (row + 1) // 2
        lower[:, row, : row + 1] = stored[:, start : start + row + 1]
    return tensor
