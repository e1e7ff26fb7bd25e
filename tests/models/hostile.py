"""Loads crafted models under a limit of memory.

Also by hand: ``python -m tests.models.hostile N SEED``.

Unlike a damaged file, a crafted one has the right checksum: every field of its header
and every array may hold anything. What is loaded predicts; everything else is a
``DataError`` of one line that names the file. Nothing takes 300 MB or 5 s.
"""

import copy
import math
import random
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from gpmpc import systems
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gp.casadi_ import successor_function
from gpmpc.logs import load_flyable, load_learned, save_learned
from gpmpc.models import (
    CasadiFunction,
    DelayedModel,
    DisturbedModel,
    LogDynamics,
    NoisyModel,
    ResidualModel,
    load_model,
    save_model,
)
from tests.gp.model_files import parts_of, write
from tests.gp.small_models import posterior, residual_model
from tests.logs.made_models import of_a_pendulum_log, of_a_quadrotor_log

MEMORY = 300 * 2**20
SECONDS = 5.0
F = torch.float64


def with_operations():
    """A pendulum whose nominal model and effect are stored as operations."""
    import casadi

    x = casadi.SX.sym("x", 2)
    effect = casadi.Function("B", [x], [casadi.vertcat(x[1], 1 + x[0] ** 2)])
    nominal = CasadiFunction(successor_function(systems.pendulum()))
    gp = posterior(n=1, m=1, predicts="value")
    noise = torch.eye(2, dtype=F)
    return ResidualModel(nominal, gp, CasadiFunction(effect), [1], [0], 1, noise=noise)


def pull(x, u):
    """A nominal model that a file names by its path."""
    return x + 0.1 * u[..., :1]


def with_code():
    gp = posterior(n=1, m=1, predicts="value")
    return ResidualModel(pull, gp, torch.tensor([[0.0], [1.0]], dtype=F), [1], [0], 2)


def nested():
    model = DisturbedModel(residual_model(), torch.ones(2, 1, dtype=F), [0.1], [0.9])
    return DelayedModel(model, 1.5)


def noisy():
    g = posterior(n=1, m=3, predicts="value")
    parts = {name: getattr(g, name) for name in ("features", "targets")}
    log_noise = type(g).from_hyperparameters(
        parts["features"],
        parts["targets"],
        torch.ones(1, 4, dtype=F),
        torch.ones(1, dtype=F),
        torch.ones(1, dtype=F),
        2,
        "value",
    )
    return NoisyModel(residual_model(), log_noise, [1])


def load_with_code(path):
    return load_model(path, trusted=["tests"])


def load_to_fly(path):
    return load_flyable(path, ["tests"]).model


def load_log_model(path):
    loaded = load_learned(path)
    return LogDynamics(
        loaded.model, len(loaded.input_names), loaded.time_step, loaded.noise
    )


KINDS = {
    "posterior": (posterior, save_model, load_model),
    "residual": (residual_model, save_model, load_to_fly),
    "operations": (with_operations, save_model, load_model),
    "code": (with_code, save_model, load_with_code),
    "nested": (nested, save_model, load_to_fly),
    "noisy": (noisy, save_model, load_model),
    "pendulum log": (of_a_pendulum_log, save_learned, load_log_model),
    "quadrotor log": (of_a_quadrotor_log, save_learned, load_to_fly),
}


VALUES = [
    None,
    True,
    -1,
    0,
    1,
    2,
    3,
    10**9,
    2**31,
    2**63,
    10**30,
    10**400,
    1.5,
    -0.5,
    math.nan,
    math.inf,
    1e308,
    "",
    "x" * 999,
    "value",
    "two\nlines",
    "subprocess:call",
    [],
    [0],
    [1],
    [1, 1],
    [[0]],
    [10**7, 1],
    [2**31, 2**31],
    [0, 0],
    [None],
    ["a"],
    [0] * 2000,
    {},
    {"kind": "ResidualModel"},
    {"kind": []},
    {"kind": "operations"},
    {"kind": "operations", "sizes": [10**7, 1], "shape": [2, 1]},
    {"kind": "function", "path": "os:system", "parameters": {"command": "true"}},
    {"kind": "casadi", "path": "gpmpc.systems:sin", "parameters": {"angle": 1.0}},
    {"kind": "GPPosterior"},
    [[[]] * 50] * 50,
]


def places(node):
    """Every dictionary or list of a header with every key or index in it."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in pairs:
        yield node, key
        if isinstance(value, dict | list):
            yield from places(value)


def a_value(header, arrays, rng):
    skipped = ("checksum", "versions", "created", "format", "format_version", "kernel")
    node, key = rng.choice(
        [place for place in places(header) if place[1] not in skipped]
    )
    node[key] = copy.deepcopy(rng.choice(VALUES))


def a_value_left_out(header, arrays, rng):
    node, key = rng.choice([*places(header)])
    del node[key]


def a_field_added(header, arrays, rng):
    nodes = [node for node, _ in places(header) if isinstance(node, dict)]
    names = [name.partition("/")[0] for name in arrays]
    fields = ["nominal", "B", "noise", "model", "angles", "decay", "outputs", *names]
    rng.choice(nodes)[rng.choice(fields)] = copy.deepcopy(rng.choice(VALUES))


def a_model_inside_another(header, arrays, rng):
    node = {key: value for key, value in header.items() if key != "memory_order"}
    depth = rng.choice([1, 3, 30, 300])
    kind = rng.choice(["DelayedModel", "NoisyModel"])
    for _ in range(depth):
        node = {"kind": kind, "model": node, "delay": rng.choice([1, 0.5, 1e5])}
    header |= node
    for name in list(arrays):
        if rng.random() < 0.95:
            arrays["model/" * depth + name] = arrays.pop(name)


def numbers(header, arrays, rng):
    name = rng.choice([*arrays])
    array = arrays[name] = arrays[name].copy()
    value = rng.choice([0, -1, 1e300, 1e10, 0.5, math.nan, math.inf, 2**31, 2**53, 1])
    if array.size and rng.random() < 0.7:
        array.flat[rng.randrange(array.size)] = value
    else:
        array[...] = value


def a_shape(header, arrays, rng):
    name = rng.choice([*arrays])
    array = np.nan_to_num(arrays[name].clip(-1e30, 1e30))
    shapes = [
        array.T,
        array[:0],
        array[None],
        array.ravel(),
        array[..., :-1],
        array.astype("f4"),
        array.clip(-9, 9).astype("i8"),
        np.array(1.0),
        np.zeros((0, 10**9)),
        np.zeros((10**9, 0)),
        np.concatenate([array, array]),
        np.zeros((2**20, 0, 3)),
        np.zeros((4000, 1)),
        array.reshape(-1, 1),
    ]
    arrays[name] = rng.choice(shapes)
    if rng.random() < 0.9 and name in header.get("memory_order", {}):
        header["memory_order"][name] = [*range(arrays[name].ndim)]


def another_name(header, arrays, rng):
    name = rng.choice([*arrays])
    other = rng.choice([*arrays])
    prefix = name.rpartition("/")[0]
    new = rng.choice(
        [other, f"B/{other}", f"{prefix}/A", "noise", "B", "effect", "model/B"]
    )
    arrays[new] = arrays.pop(name) if rng.random() < 0.5 else arrays[name]
    order = header.get("memory_order")
    if isinstance(order, dict):
        order[new] = [*range(arrays[new].ndim)]


MUTATIONS = [
    a_value,
    a_value,
    a_value,
    a_value_left_out,
    a_field_added,
    a_model_inside_another,
    numbers,
    numbers,
    a_shape,
    another_name,
]


def check_predicts(model):
    """Predicts and linearises; what comes out has the right shape."""
    n = model.state_dim
    m = model.input_dim
    x = torch.full((3, n), 0.1, dtype=model.dtype)
    u = torch.full((3, m), 0.2, dtype=model.dtype)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        belief = model.predict(x, u)
        assert belief.covariance.shape == (3, model.output_dim, model.output_dim)
        if hasattr(model, "linearize"):
            model.linearize(x.double().numpy(), u.double().numpy(), True)
        assert model.noise_covariance.shape == (model.output_dim, model.output_dim)


def address_space():
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main(count, seed):
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    rng = random.Random(seed)
    said = Counter()
    slowest = (0.0, "")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        good = {}
        for kind, (make, save, load) in KINDS.items():
            save(make(), path)
            good[kind] = parts_of(path)
            check_predicts(load(path))
        size = address_space()
        for number in range(count):
            kind = [*KINDS][number % len(KINDS)]
            header, arrays = copy.deepcopy(good[kind])
            names = []
            for _ in range(rng.choice([1, 1, 1, 2])):
                mutation = rng.choice(MUTATIONS)
                names.append(mutation.__name__)
                try:
                    mutation(header, arrays, rng)
                except (AttributeError, IndexError, KeyError, TypeError, ValueError):
                    names.append("(failed)")
            write(path, header, arrays)
            limit = (size + MEMORY, resource.RLIM_INFINITY)
            resource.setrlimit(resource.RLIMIT_AS, limit)
            began = time.perf_counter()
            try:
                model = KINDS[kind][2](path)
            except DataError as error:
                text = str(error)
                clear = text.startswith(f"{path}: ") and "\n" not in text
                if not clear or isinstance(error.__cause__, MemoryError):
                    raise AssertionError(kind, names, text, header) from error
                said["refused"] += 1
                model = None
            except SettingError as error:  # what a log taught, and cannot be flown
                if error.key != "model" or "no controller can plan" not in str(error):
                    raise AssertionError(kind, names, header) from error
                said["refused"] += 1
                model = None
            except Exception as error:
                raise AssertionError(kind, names, header) from error
            finally:
                seconds = time.perf_counter() - began
                slowest = max(slowest, (seconds, f"{kind}: {names}"))
                unlimited = resource.RLIM_INFINITY, resource.RLIM_INFINITY
                resource.setrlimit(resource.RLIMIT_AS, unlimited)
            assert seconds < SECONDS, (kind, names, seconds)
            if model is not None:
                said["read"] += 1
                try:
                    check_predicts(model)
                except Exception as error:
                    raise AssertionError(kind, names, header) from error
    print(dict(said), f"slowest {slowest[0]:.2f} s ({slowest[1]})")


if __name__ == "__main__":
    from tests.models import hostile  # whose functions have a path

    hostile.main(int(sys.argv[1]), int(sys.argv[2]))
