"""Models as C: one function for each model, around the tables of its GPs.

To add a kind of model: choose it in ``ModelWriter.write``, and write there its tables,
its function (``_SIGNATURE``; A is NULL where the mean alone is asked for), and, for
tubes and filters, ``_write_variances`` and ``_write_covariance``. What it works in is a
size (``_reserve``), with a comment in ``_problems`` and a member of ``gpmpc_work`` in
``core.h``. Ranges of its data, where there are some, come from the controller's
``data_scales``. Then ``docs/export.md`` says so, and a case of
``tests/export/test_decisions.py`` decides as Python does.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from gpmpc._dynamics import to_array
from gpmpc.exceptions import SettingError
from gpmpc.export._expressions import expansion_lines, graph_of_tape, value_lines
from gpmpc.export._fixed import fixed_tables
from gpmpc.export._text import Numbers, function, integers, split_jacobian, unused
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, DelayedModel, DisturbedModel, KnownModel, ResidualModel
from gpmpc.models._wrapper import LinearWrapper

Array = np.ndarray

_SIGNATURE = (
    "static void {name}(const real *x, const real *u, gpmpc_work *work,\n"
    "    real *mean, real *A, real *B)"
)
_TAPE_SIGNATURE = "static void {name}(const real *x, const real *u, real *value)"
_TAPE_EXPANSION = (
    "static void {name}(const real *x, const real *u, real *value, real *jacobian)"
)


class ModelWriter:
    """Writes the functions and tables of one model.

    Attributes:
        variances: Whether functions of variances are written, too.
        sizes: Of what its functions work in: N points, d N differences, k N kernels and
            k outputs, at most.
    """

    def __init__(self, numbers: Numbers, variances: bool, means_alone: bool):
        self._numbers = numbers
        self.variances = variances
        self._means_alone = means_alone
        self._parts: list[str] = []
        self._gps = 0
        self.sizes: dict[str, int] = dict.fromkeys(
            ("POINTS", "DIFFERENCES", "KERNELS", "GP_OUTPUTS"), 0
        )

    @property
    def text(self) -> str:
        """All that was written."""
        return "\n".join(self._parts)

    def write(self, model: Any, name: str) -> None:
        """Writes the function of a model.

        Raises:
            SettingError: A part of it cannot be exported.
        """
        if isinstance(model, GPPosterior):
            self._write_posterior(model, name)
        elif isinstance(model, ResidualModel):
            self._write_residual(model, name)
        elif isinstance(model, KnownModel):
            self._write_known(model, name)
        elif isinstance(model, LinearWrapper):
            self._write_wrapper(model, name)
        else:
            raise SettingError(
                "model",
                "an exported one is a GPPosterior, a ResidualModel, a KnownModel, or "
                "one of these in a DelayedModel or DisturbedModel; "
                f"got {type(model).__name__}",
            )

    def _write_posterior(self, model: GPPosterior, name: str) -> None:
        """Writes a model that is GPs alone."""
        table = self._write_gps(model)
        n = model.state_dim
        m = model.input_dim
        k = model.output_dim
        adds_state = model.predicts == "difference"
        formula = "x + f(x, u)" if adds_state else "f(x, u)"
        d = n + m
        body = [
            f"real query[{d}];",
            f"real jacobian[{k * d}];",
            "int i;",
            f"copy(x, query, {n});",
            f"copy(u, query + {n}, {m});",
            f"gp_evaluate(&{table}, query, work, mean, A ? jacobian : 0);",
        ]
        body += split_jacobian(k, n, m)
        if adds_state:
            body += [
                f"add_scaled(1, x, mean, {n});",
                f"for (i = 0; i < {n} && A; i++)",
                f"    A[i * {n} + i] += 1;",
            ]
        self._function(_SIGNATURE.format(name=name), body, f"x+ = {formula}, f by GPs")
        self._write_variances(name, table)
        self._write_covariance(name, _diagonal_variance(k))

    def _write_gps(self, gp: GPPosterior) -> str:
        """Writes the tables of GPs over the same points; returns their name."""
        if not isinstance(gp, GPPosterior):
            rule = "an exported residual is a GPPosterior"
            raise SettingError("model", f"{rule}; got {type(gp).__name__}")
        if str(gp.dtype) != "torch.float64":
            raise SettingError("model", f"must be in float64; got {gp.dtype}")
        prefix = f"gp{self._gps}"
        self._gps += 1
        size, d = gp.features.shape
        k = gp.output_dim
        self._reserve(size, d, k)
        features = to_array(gp.features)
        lengthscales = to_array(gp.lengthscales)
        table = partial(Numbers("double").table, kind="wide")
        lines = [
            f"/* GPs {prefix}: k = {k} outputs over N = {size} points of {d} features",
            "",
            "   m_a(x~) = offset_a + sum_i beta_ai k_a(x~_i, x~)",
            "   k_a(x~_i, x~) =",
            "       exp(log sf2_a - 1/2 sum_d (x~_id - x~_d)^2 / l_ad^2) */",
            table(f"{prefix}_points", features.T, "x~, a row for each feature (d, N)"),
            table(f"{prefix}_scales", lengthscales**-2.0, "1 / l^2 (k, d)"),
            table(
                f"{prefix}_log_signal",
                np.log(to_array(gp.signal_variance)),
                "log sf2 (k,)",
            ),
            table(f"{prefix}_signal", to_array(gp.signal_variance), "sf2 (k,)"),
            table(f"{prefix}_weights", to_array(gp.weights), "beta (k, N)"),
            table(f"{prefix}_offset", to_array(gp.offset), "prior means (k,)"),
        ]
        cholesky = "0"
        if self.variances:
            cholesky = f"{prefix}_cholesky"
            rows, columns = np.tril_indices(size)
            factors = to_array(gp.cholesky)[:, rows, columns]
            comment = "K + sn2 I = L L': lower triangles, row after row"
            lines.append(table(cholesky, factors, comment))
        fixed = ""
        if self._numbers.precision == "float":
            lines.append(fixed_tables(gp, prefix))
            fixed = f", &{prefix}_fixed"
        lines.append(
            f"static const gp_tables {prefix} = {{\n"
            f"    {size}, {d}, {k}, {prefix}_points, {prefix}_scales,\n"
            f"    {prefix}_log_signal, {prefix}_signal, {prefix}_weights,\n"
            f"    {prefix}_offset, {cholesky}{fixed}}};\n"
        )
        self._parts.append("\n".join(lines))
        return prefix

    def _reserve(self, points: int, features: int, outputs: int) -> None:
        """Makes room for GPs of N points, d features and k outputs."""
        needed = {
            "POINTS": points,
            "DIFFERENCES": features * points,
            "KERNELS": outputs * points if self.variances else 0,
            "GP_OUTPUTS": outputs,
        }
        for name, size in needed.items():
            self.sizes[name] = max(self.sizes[name], size)

    def _write_residual(self, model: ResidualModel, name: str) -> None:
        """Writes x+ = f0(x, u) + B d(phi(x, u))."""
        if callable(model.B):
            raise SettingError(
                "model",
                "an exported residual acts by a constant B (n, k); got a function "
                "of the state",
            )
        table = self._write_gps(model.residual)
        n = model.state_dim
        m = model.input_dim
        k = model.residual.output_dim
        features = model.features
        d = features.dim + len(features.inputs)
        self._parts.append(
            self._numbers.table(f"{name}_effect", to_array(model.B), "B (n, k)")
        )
        columns = [*features.columns.tolist(), *features.inputs]
        self._parts.append(
            integers(
                f"{name}_columns",
                columns,
                "the state of each feature, then the inputs",
            )
        )
        self._write_nominal(model.nominal, n, m, f"{name}_nominal")
        body = [
            f"real query[{d}];",
            f"real slopes[{d}];",
            f"real residual[{k}];",
            f"real jacobian[{k * d}];",
            "int a, i, j;",
            f"{name}_nominal(x, u, mean, A, B);",
            *_query_lines(features, name),
            f"gp_evaluate(&{table}, query, work, residual, A ? jacobian : 0);",
            f"for (i = 0; i < {n}; i++)",
            f"    mean[i] += dot({name}_effect + i * {k}, residual, {k});",
            *_residual_slope_lines(model, name),
        ]
        self._function(
            _SIGNATURE.format(name=name),
            body,
            "x+ = f0(x, u) + B d(phi(x, u)), d by GPs",
        )
        self._write_variances(name, table)
        self._write_covariance(name, _residual_variance_lines(n, k, name))

    def _write_nominal(self, nominal: Any, n: int, m: int, name: str) -> None:
        """Writes f0 and its derivatives."""
        tape = getattr(nominal, "tape", None)
        if isinstance(nominal, Affine):
            self._write_affine(nominal, n, m, name)
        elif tape is not None:
            self._write_tape(tape, n, m, name)
        else:
            raise SettingError(
                "model",
                "an exported nominal model is Affine, or a CasadiFunction of "
                f"elementary operations; got {type(nominal).__name__}",
            )

    def _write_affine(self, nominal: Affine, n: int, m: int, name: str) -> None:
        """Writes f0 = A x + B u + c."""
        table = self._numbers.table
        A = to_array(nominal.A)
        B = to_array(nominal.B)
        self._parts += [
            table(f"{name}_A", A, "of f0 (n, n)"),
            table(f"{name}_B", B, "of f0 (n, m)"),
            table(f"{name}_c", to_array(nominal.c), "of f0 (n,)"),
        ]
        body = [
            "int i;",
            f"for (i = 0; i < {n}; i++)",
            f"    mean[i] = {name}_c[i] + dot({name}_A + i * {n}, x, {n})",
            f"              + dot({name}_B + i * {m}, u, {m});",
            "if (A) {",
            f"    copy({name}_A, A, {n * n});",
            f"    copy({name}_B, B, {n * m});",
            "}",
        ]
        self._nominal_function(name, body, "f0 = A x + B u + c")

    def _write_tape(self, tape: Any, n: int, m: int, name: str) -> None:
        """Writes f0, a list of scalar operations, with its derivatives."""
        graph, value = graph_of_tape(tape)
        names = _input_names(n, m)
        if self._means_alone:
            lines = value_lines(graph, value, names, self._numbers)
            self._function(
                _TAPE_SIGNATURE.format(name=f"{name}_value"),
                [*unused("xu", lines), *lines],
                "f0(x, u)",
            )
        lines = expansion_lines(graph, value, names, self._numbers)
        self._function(
            _TAPE_EXPANSION.format(name=f"{name}_expansion"),
            [*unused("xu", lines), "(void)jacobian;", *lines],
            "f0(x, u) and its derivatives by (x, u); those that are zero stay",
        )
        d = n + m
        body = [
            f"real jacobian[{n * d}];",
            "int i;",
        ]
        if self._means_alone:
            body += ["if (!A) {", f"    {name}_value(x, u, mean);", "    return;", "}"]
        body += [
            f"fill(jacobian, 0, {n * d});",
            f"{name}_expansion(x, u, mean, jacobian);",
            *split_jacobian(n, n, m),
        ]
        self._nominal_function(name, body, "f0 as the model takes it")

    def _write_known(self, model: KnownModel, name: str) -> None:
        """Writes a model without uncertainty."""
        n = model.state_dim
        m = model.input_dim
        self._write_nominal(model.function, n, m, f"{name}_nominal")
        body = [
            "(void)work;",
            f"{name}_nominal(x, u, mean, A, B);",
        ]
        self._function(_SIGNATURE.format(name=name), body, "x+ = f0(x, u)")
        self._write_variances(name, "")
        no_variance = ["(void)variance;", f"fill(V, 0, {n * n});"]
        self._write_covariance(name, no_variance)

    def _write_wrapper(self, model: LinearWrapper, name: str) -> None:
        """Writes z+ = [f(x, Z z + W u); 0] + L z + M u."""
        inner = f"{name}_inner"
        self.write(model.model, inner)
        p = model.model.state_dim
        n = model.state_dim
        m = model.input_dim
        table = self._numbers.table
        Z, W, L, M = model.linear_part
        self._parts += [
            table(f"{name}_Z", Z, "(m, k)"),
            table(f"{name}_W", W, "(m, m)"),
            table(f"{name}_L", L, "(k, k)"),
            table(f"{name}_M", M, "(k, m)"),
        ]
        body = [
            f"real acting[{m}];",
            f"real next[{p}];",
            f"real by_state[{p * p}];",
            f"real by_input[{p * m}];",
            "int i;",
            f"for (i = 0; i < {m}; i++)",
            f"    acting[i] = dot({name}_Z + i * {n}, x, {n})",
            f"                + dot({name}_W + i * {m}, u, {m});",
            f"{inner}(x, acting, work, next, A ? by_state : 0, A ? by_input : 0);",
            f"for (i = 0; i < {n}; i++)",
            f"    mean[i] = dot({name}_L + i * {n}, x, {n})",
            f"              + dot({name}_M + i * {m}, u, {m})",
            f"              + (i < {p} ? next[i] : 0);",
            *_wrapped_slope_lines(n, m, p, name),
        ]
        formula = "z+ = [f(x, Z z + W u); 0] + L z + M u"
        if isinstance(model, DelayedModel):
            formula += f": inputs act {model.delay:g} steps late"
        elif isinstance(model, DisturbedModel):
            formula += ": disturbances are states"
        self._function(_SIGNATURE.format(name=name), body, formula)
        if self.variances:
            line = f"#define {name}_variances {inner}_variances\n"
            self._parts.append(line)
        self._write_covariance(name, _padded_variance_lines(n, p, inner))

    def _write_variances(self, name: str, table: str) -> None:
        """Writes the function of the GPs' variances at the points that were kept."""
        if not self.variances:
            return
        body = ["(void)work;", "(void)variance;"]
        if table:
            body = [f"gp_variances(&{table}, work, variance);"]
        signature = f"static void {name}_variances(gpmpc_work *work, real *variance)"
        self._function(signature, body, "variances of the GPs (lanes, k)")

    def _write_covariance(self, name: str, body: Sequence[str]) -> None:
        """Writes the function from the GPs' variances at a point to V (n, n)."""
        if not self.variances:
            return
        signature = f"static void {name}_covariance(const real *variance, real *V)"
        self._function(signature, body, "V: covariance of the next state")

    def _nominal_function(self, name: str, body: Sequence[str], comment: str) -> None:
        """Writes a nominal function."""
        signature = (
            f"static void {name}(const real *x, const real *u, real *mean, real *A,\n"
            "    real *B)"
        )
        self._function(signature, body, comment)

    def _function(self, signature: str, body: Sequence[str], comment: str) -> None:
        """Writes a function, its equation above it."""
        self._parts.append(function(signature, body, comment))


def _query_lines(features: Any, name: str) -> list[str]:
    """Returns the lines that write the features, and their slopes by what they read."""
    columns = features.columns.tolist()
    lines = [
        f"for (i = 0; i < {features.dim + len(features.inputs)}; i++) {{",
        f"    query[i] = i < {features.dim} ? x[{name}_columns[i]]",
        f"                                  : u[{name}_columns[i]];",
        "    slopes[i] = 1;",
        "}",
    ]
    for i in sorted(features.sines.tolist()):
        lines += [
            f"query[{i}] = SIN(x[{columns[i]}]);",
            f"query[{i + 1}] = COS(x[{columns[i]}]);",
            f"slopes[{i}] = query[{i + 1}];",
            f"slopes[{i + 1}] = -query[{i}];",
        ]
    return lines


def _residual_slope_lines(model: ResidualModel, name: str) -> list[str]:
    """Returns the lines that add the derivatives of B d to A and B."""
    k = model.residual.output_dim
    features = model.features
    d = features.dim + len(features.inputs)
    return [
        f"for (i = 0; i < {model.state_dim} && A; i++)",
        f"    for (a = 0; a < {k}; a++) {{",
        f"        const real effect = {name}_effect[i * {k} + a];",
        f"        for (j = 0; j < {d} && effect != 0; j++) {{",
        f"            real slope = effect * jacobian[a * {d} + j] * slopes[j];",
        f"            if (j < {features.dim})",
        f"                A[i * {model.state_dim} + {name}_columns[j]] += slope;",
        "            else",
        f"                B[i * {model.input_dim} + {name}_columns[j]] += slope;",
        "        }",
        "    }",
    ]


def _residual_variance_lines(n: int, k: int, name: str) -> list[str]:
    """Returns the lines that write V = B diag(variance) B'."""
    return [
        "int a, i, j;",
        f"for (i = 0; i < {n}; i++)",
        f"    for (j = 0; j < {n}; j++) {{",
        f"        V[i * {n} + j] = 0;",
        f"        for (a = 0; a < {k}; a++)",
        f"            V[i * {n} + j] += {name}_effect[i * {k} + a] * variance[a]",
        f"                              * {name}_effect[j * {k} + a];",
        "    }",
    ]


def _wrapped_slope_lines(n: int, m: int, p: int, name: str) -> list[str]:
    """Returns the lines that write A and B of a wrapper around p states."""
    return [
        "if (A) {",
        "    int j;",
        f"    copy({name}_L, A, {n * n});",
        f"    copy({name}_M, B, {n * m});",
        f"    for (i = 0; i < {p}; i++) {{",
        f"        add_scaled(1, by_state + i * {p}, A + i * {n}, {p});",
        f"        for (j = 0; j < {m}; j++) {{",
        f"            const real slope = by_input[i * {m} + j];",
        f"            add_scaled(slope, {name}_Z + j * {n}, A + i * {n}, {n});",
        f"            add_scaled(slope, {name}_W + j * {m}, B + i * {m}, {m});",
        "        }",
        "    }",
        "}",
    ]


def _padded_variance_lines(n: int, p: int, inner: str) -> list[str]:
    """Returns the lines that write V of a wrapper, zero but for the p inner states."""
    return [
        f"real block[{p * p}];",
        "int i;",
        f"{inner}_covariance(variance, block);",
        f"fill(V, 0, {n * n});",
        f"for (i = 0; i < {p}; i++)",
        f"    copy(block + i * {p}, V + i * {n}, {p});",
    ]


def _diagonal_variance(k: int) -> list[str]:
    """Returns the lines that write V = diag(variance)."""
    return [
        "int i;",
        f"fill(V, 0, {k * k});",
        f"for (i = 0; i < {k}; i++)",
        f"    V[i * {k} + i] = variance[i];",
    ]


def _input_names(n: int, m: int) -> list[str]:
    """Returns how a function of a state and an input reads its arguments."""
    return [f"x[{i}]" for i in range(n)] + [f"u[{i}]" for i in range(m)]
