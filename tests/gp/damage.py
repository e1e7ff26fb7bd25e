"""Loads damaged files under a limit of memory; ``python -m tests.gp.damage KIND COUNT
SEED`` in a process of its own.

What is loaded is the undamaged content, or a ``GpmpcError`` of one line names the file;
nothing takes 300 MB or 5 s.
"""

import io
import json
import random
import resource
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from gpmpc.exceptions import GpmpcError
from gpmpc.gp import Transitions, load_posterior
from gpmpc.models import load_model
from tests.gp.small_models import SAVE, as_before, posterior, residual_model

MEMORY = 300 * 2**20
SECONDS = 5.0


def flipped(content, rng):
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 8])):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(content, rng):
    return content[: rng.randrange(len(content))]


def without_a_piece(content, rng):
    start = rng.randrange(len(content))
    length = rng.choice([1, 8, 100])
    return content[:start] + content[start + length :]


def overwritten(content, rng):
    start = rng.randrange(len(content))
    length = rng.choice([1, 4, 64])
    return (
        content[:start]
        + rng.choice([bytes(length), b"\xff" * length, rng.randbytes(length)])
        + content[start + length :]
    )


def repeated(content, rng):
    start = rng.randrange(len(content))
    length = rng.choice([1, 30, 500])
    return content[: start + length] + content[start:]


def rezipped(change):
    """A damage of the archive's members, whose CRCs are then right again."""

    def damage(content, rng):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        change(members, rng)
        out = io.BytesIO()
        small = sum(map(len, members.values())) < 2**24
        with zipfile.ZipFile(
            out,
            "w",
            zipfile.ZIP_STORED
            if small and rng.random() < 0.5
            else zipfile.ZIP_DEFLATED,
        ) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return out.getvalue()

    damage.__name__ = change.__name__
    return damage


@rezipped
def members_swapped(members, rng):
    one, other = rng.sample(sorted(members), 2)
    members[one], members[other] = members[other], members[one]


@rezipped
def a_member_dropped(members, rng):
    del members[rng.choice(sorted(members))]


@rezipped
def a_member_renamed(members, rng):
    members[rng.choice(["a.npy", "../features.npy", "states.npy", "header"])] = (
        members.pop(rng.choice(sorted(members)))
    )


@rezipped
def a_header_edited(members, rng):
    header = json.loads(members["header.json"])
    key = rng.choice([key for key in header if key != "checksum"])
    values = [
        None,
        0,
        -1,
        3,
        10**9,
        1.5,
        True,
        "value",
        "difference",
        [],
        [0, 1],
        [[0]],
        {},
        {"features": [0, 0]},
        "x" * 999,
    ]
    header[key] = rng.choice(values)
    if rng.random() < 0.2:
        del header[key]
    members["header.json"] = json.dumps(header).encode()


@rezipped
def a_header_of_garbage(members, rng):
    choices = [
        b"",
        b"[" * 100_000,
        b"null",
        b"[]",
        b"1e999",
        b"\xff\xfe",
        b'{"format": "gpmpc model"}',
        b"{" * 9000,
    ]
    members["header.json"] = rng.choice(choices)


@rezipped
def an_array_of_another_kind(members, rng):
    name = rng.choice([name for name in members if name.endswith(".npy")])
    array = np.load(io.BytesIO(members[name]))
    dtypes = [
        "c16",
        "?",
        "U9",
        "S9",
        "M8[s]",
        "m8[s]",
        "O",
        ">f8",
        "f2",
        "f4",
        "i8",
        "u1",
        "f16",
    ]
    changed = [
        array.astype(rng.choice(dtypes)),
        array.T,
        array[:0],
        array[None],
        array.ravel(),
        array[..., :-1],
    ]
    written = io.BytesIO()
    with np.errstate(all="ignore"):
        np.save(written, rng.choice(changed), allow_pickle=True)
    members[name] = written.getvalue()


@rezipped
def a_huge_shape(members, rng):
    name = rng.choice([name for name in members if name.endswith(".npy")])
    data = rng.choice([members[name][128:], b"", bytes(rng.choice([10**4, 10**7]))])
    shape = rng.choice(
        [
            (10**9, 3),
            (2**31, 2**31),
            (10**7,),
            (2**62, 4),
            (-1, 3),
            (0, 10**12),
            (10**30,),
            (1,) * 70,
        ]
    )
    dtype = rng.choice(["<f8", "<f4", "|i1"])
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    version, length = rng.choice([(b"\x01\x00", 2), (b"\x02\x00", 4), (b"\x03\x00", 4)])
    members[name] = (
        b"\x93NUMPY"
        + version
        + len(header).to_bytes(length, "little")
        + header.encode()
        + data
    )


@rezipped
def a_bomb(members, rng):
    name = rng.choice(sorted(members))
    written = io.BytesIO()
    np.save(written, np.zeros((rng.choice([10**5, 10**6]), 3)))
    members[name] = written.getvalue()


def reheaded(change):
    """A damage of the JSON header of a safetensors file, whose stated length is then
    right again."""

    def damage(content, rng):
        length = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + length])
        text = change(header, rng)
        text = json.dumps(header).encode() if text is None else text
        return len(text).to_bytes(8, "little") + text + content[8 + length :]

    damage.__name__ = change.__name__
    return damage


def a_tensor(header, rng):
    return header[rng.choice([name for name in header if name != "__metadata__"])]


@reheaded
def a_tensor_elsewhere(header, rng):
    a_tensor(header, rng)["data_offsets"] = rng.choice(
        [[0, 8], [8, 0], [0, 2**62], [-8, 0], [2**63, 2**64 - 1], []]
    )


@reheaded
def tensors_swapped(header, rng):
    one = a_tensor(header, rng)
    other = a_tensor(header, rng)
    one["data_offsets"], other["data_offsets"] = (
        other["data_offsets"],
        one["data_offsets"],
    )


@reheaded
def a_tensor_of_another_shape(header, rng):
    a_tensor(header, rng)["shape"] = rng.choice(
        [[10**9, 3], [2**31, 2**31], [], [0], [2**62, 4], [-1], [1] * 70]
    )


@reheaded
def a_tensor_of_another_type(header, rng):
    a_tensor(header, rng)["dtype"] = rng.choice(
        ["F32", "I64", "BF16", "U8", "F8_E4M3", "x", None, 3]
    )


@reheaded
def a_tensor_renamed(header, rng):
    name = rng.choice([name for name in header if name != "__metadata__"])
    header[rng.choice(["a", "../features", "weights", ""])] = header.pop(name)


@reheaded
def a_tensor_dropped(header, rng):
    del header[rng.choice([name for name in header if name != "__metadata__"])]


@reheaded
def a_header_edited_in_place(header, rng):
    said = json.loads(header["__metadata__"]["gpmpc"])
    key = rng.choice([key for key in said if key != "checksum"])
    said[key] = rng.choice(
        [
            None,
            0,
            -1,
            3,
            10**9,
            1.5,
            True,
            "value",
            [],
            [0, 1],
            {},
            {"features": [0, 0]},
            "x" * 999,
        ]
    )
    header["__metadata__"]["gpmpc"] = json.dumps(said)


@reheaded
def metadata_of_garbage(header, rng):
    header["__metadata__"] = rng.choice(
        [{}, {"gpmpc": "[" * 100_000}, {"gpmpc": "null"}, {"gpmpc": "x" * 2**21}, 3]
    )


@reheaded
def a_whole_header_of_garbage(header, rng):
    return rng.choice(
        [b"", b"[" * 100_000, b"null", b"{}", b"\xff\xfe", b"{" * 9000, b'{"a": {}}']
    )


def a_huge_header(content, rng):
    return (
        rng.choice([2**27, 2**40, 2**63, 2**64 - 1]).to_bytes(8, "little") + content[8:]
    )


BYTES = [flipped, cut, without_a_piece, overwritten, repeated]
ZIP = [
    members_swapped,
    a_member_dropped,
    a_member_renamed,
    a_header_edited,
    a_header_of_garbage,
    an_array_of_another_kind,
    a_huge_shape,
    a_bomb,
]
SAFETENSORS = [
    a_tensor_elsewhere,
    tensors_swapped,
    a_tensor_of_another_shape,
    a_tensor_of_another_type,
    a_tensor_renamed,
    a_tensor_dropped,
    a_header_edited_in_place,
    metadata_of_garbage,
    a_whole_header_of_garbage,
    a_huge_header,
]


def transitions():
    generator = torch.Generator().manual_seed(0)
    return Transitions(*(torch.randn(20, n, generator=generator) for n in (3, 3, 3)))


def content(model):
    """Everything that a model or transitions hold, for a comparison to the bit."""
    if isinstance(model, torch.Tensor):
        return model.numpy().tobytes(), tuple(model.shape)
    attributes = vars(model) if hasattr(model, "__dict__") else model
    return (
        {k: content(v) for k, v in attributes.items()}
        if isinstance(attributes, dict)
        else attributes
    )


def from_csv(path):
    return Transitions.from_csv(path, ["a", "b"], ["c"])


def main(kind, count, seed):
    makers = {
        "model": posterior,
        "old": posterior,
        "residual": residual_model,
        "transitions": transitions,
        "csv": transitions,
    }
    undamaged = makers[kind]()
    load = {
        "model": load_posterior,
        "old": load_posterior,
        "residual": load_model,
        "transitions": Transitions.load,
        "csv": from_csv,
    }[kind]
    rng = random.Random(seed)
    said = Counter()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.npz"
        if kind == "csv":
            rows = [",".join(map(repr, row)) for row in undamaged.states.tolist()]
            path.write_text("\n".join(["a,b,c", *rows]))
        elif kind == "transitions":
            undamaged.save(path)
        elif kind == "old":
            as_before(undamaged, path)
        else:
            SAVE[type(undamaged)](undamaged, path)
        parts = ZIP if kind in ("transitions", "old") else SAFETENSORS
        whole = path.read_bytes()
        same = content(load(path))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        size = (
            int(Path("/proc/self/statm").read_text().split()[0])
            * resource.getpagesize()
        )
        for _ in range(count):
            damage = rng.choice(BYTES if kind == "csv" or rng.random() < 0.5 else parts)
            damaged = damage(whole, rng)
            path.write_bytes(damaged)
            resource.setrlimit(
                resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY)
            )
            begin = time.perf_counter()
            try:
                loaded = load(path)
            except GpmpcError as error:
                text = str(error)
                clear = text.startswith(f"{path}: ") and "\n" not in text
                if not clear or isinstance(error.__cause__, MemoryError):
                    raise AssertionError(damage.__name__, text) from error
                said["refused"] += 1
            else:
                if kind != "csv":  # a digit may have changed, which nothing can tell
                    assert content(loaded) == same, damage.__name__
                said["read"] += 1
            finally:
                slowest = max(slowest, time.perf_counter() - begin)
                resource.setrlimit(
                    resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
                )
            assert slowest < SECONDS, (damage.__name__, slowest)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(
        kind,
        dict(said),
        f"slowest {slowest:.2f} s, grown by {grown / 1024:.0f} MB at most "
        "(the damaging itself too)",
    )


if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    for each in sys.argv[1].split(","):
        main(each, int(sys.argv[2]), int(sys.argv[3]))
