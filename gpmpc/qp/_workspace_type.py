"""numba's type of a workspace: fields that become arrays where they are read.

A value is a handful of pointers and sizes. ``gpmpc.qp._workspace`` names the fields and
says why they are not simply those of a named tuple.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    register_model,
)
from numba.np.arrayobj import populate_array

from gpmpc._compiled import inline_njit
from gpmpc.qp._workspace import (
    FIRST_INTEGER,
    FIRST_MATRIX,
    INTEGER_VECTORS,
    MATRICES,
    SETTINGS,
    SIZES,
    VECTORS,
)


@inline_njit
def open_workspace(P, q, G, memory):
    """Returns the workspace of a program in its memory."""
    n = len(q)
    L = memory[FIRST_MATRIX:]
    factor = L[n:]
    rows = factor[n + 1 :]
    K = rows[n + len(G) + 1 :]
    return _workspace(P, q, G, memory, L, factor, rows, K)


class _WorkspaceType(types.Type):
    """numba's type of a workspace."""

    def __init__(self):
        super().__init__(name="Workspace")


_WORKSPACE = _WorkspaceType()
_POINTERS = ("memory", "q", *MATRICES)
_FIELD_TYPES = {
    **dict.fromkeys(SIZES, types.intp),
    **dict.fromkeys(SETTINGS, types.float64),
    **dict.fromkeys(("q", *VECTORS), types.float64[::1]),
    **dict.fromkeys(INTEGER_VECTORS, types.int64[::1]),
    **dict.fromkeys(MATRICES, types.float64[:, ::1]),
}


@register_model(_WorkspaceType)
class _WorkspaceModel(models.StructModel):
    def __init__(self, manager, kind):
        pointer = types.CPointer(types.float64)
        members = [(name, pointer) for name in _POINTERS]
        members += [(name, types.intp) for name in SIZES]
        super().__init__(manager, kind, members)


@intrinsic
def _workspace(typing_context, P, q, G, memory, L, factor, rows, K):
    """Returns the pointers and sizes of these arrays as a workspace."""

    def generate(context, builder, signature, arguments):
        names = ("P", "q", "G", "memory", "L", "factor", "rows", "K")
        arrays = {
            name: context.make_array(kind)(context, builder, argument)
            for name, kind, argument in zip(
                names, signature.args, arguments, strict=True
            )
        }
        work = cgutils.create_struct_proxy(_WORKSPACE)(context, builder)
        for name in _POINTERS:
            setattr(work, name, arrays[name].data)
        work.m, work.n = cgutils.unpack_tuple(builder, arrays["G"].shape)
        work.M = builder.add(work.n, work.m)
        work.slots = builder.add(work.n, ir.IntType(64)(1))
        work.width = builder.extract_value(arrays["memory"].shape, 1)
        return work._getvalue()

    return _WORKSPACE(P, q, G, memory, L, factor, rows, K), generate


@infer_getattr
class _FieldTypes(AttributeTemplate):
    key = _WorkspaceType

    def generic_resolve(self, work, name):
        return _FIELD_TYPES.get(name)


@lower_getattr_generic(_WorkspaceType)
def _read_field(context, builder, kind, value, name):
    work = cgutils.create_struct_proxy(kind)(context, builder, value=value)
    if name in SIZES:
        return getattr(work, name)
    if name in SETTINGS:
        return builder.load(_setting(builder, work, name))
    if name in _POINTERS:
        data = getattr(work, name)
        shape = [getattr(work, size) for size in MATRICES.get(name, ("n",))]
    else:
        row = (
            1 + VECTORS.index(name)
            if name in VECTORS
            else FIRST_INTEGER + INTEGER_VECTORS.index(name)
        )
        data = builder.gep(work.memory, [builder.mul(work.width, ir.IntType(64)(row))])
        shape = [work.width]
    return _array(context, builder, _FIELD_TYPES[name], data, shape)


@lower_setattr_generic(_WorkspaceType)
def _write_setting(context, builder, signature, arguments, name):
    kind, _ = signature.args
    work = cgutils.create_struct_proxy(kind)(context, builder, value=arguments[0])
    builder.store(arguments[1], _setting(builder, work, name))


def _setting(builder, work, name):
    """Returns the pointer to a setting, in the first row of memory."""
    return builder.gep(work.memory, [ir.IntType(64)(SETTINGS.index(name))])


def _array(context, builder, kind, data, shape):
    """Returns a contiguous array of 8-byte numbers that start at ``data``."""
    array = context.make_array(kind)(context, builder)
    itemsize = context.get_constant(types.intp, 8)
    strides = [itemsize]
    for size in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], size))
    populate_array(
        array,
        data=builder.bitcast(data, context.get_data_type(kind.dtype).as_pointer()),
        shape=shape,
        strides=strides,
        itemsize=itemsize,
        meminfo=None,
    )
    return array._getvalue()
