"""numba's type of a workspace: fields that become arrays where they are read.

A value is a handful of pointers and sizes, which the kernels hand on to each other;
``work.lower`` makes an array of them where it stands in the code. To add or rename a
field, change the lists of ``gpmpc.qp._workspace``: nothing here names a vector.

This file does what numba's features for it cannot do here:

- A named tuple of the same arrays hands on seven numbers for each of them. With 35
  arrays that took five seconds more to compile.
- ``numba.experimental.structref`` keeps its fields on the heap and counts references to
  them; these kernels are compiled without that (``allocates=False``).
- A structured NumPy array has the sizes of its fields in its type, and so would be
  compiled anew for each size of a program.

A type takes four registrations, each a function or class below: how a value is laid out
(``_WorkspaceModel``), how one is made (``_workspace``), which type each field has
(``_FieldTypes``), and what machine code reads or writes it (``_read_field``,
``_write_setting``).
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

from gpmpc._compiled import inline_njit
from gpmpc.qp._workspace import (
    INTEGER_VECTORS,
    MATRICES,
    SETTINGS,
    SIZES,
    VECTORS,
    first_rows,
)


@inline_njit
def open_workspace(P, q, G, memory):
    """Returns the workspace of a program in its memory."""
    first = first_rows(len(q), len(G))
    L = memory[first.L :]
    factor = memory[first.factor :]
    w = memory[first.w :]
    K = memory[first.K :]
    # numba passes the first argument
    return _workspace(P, q, G, memory, L, factor, w, K)  # pyright: ignore


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
def _workspace(typing_context, P, q, G, memory, L, factor, w, K):
    """Returns the pointers and sizes of these arrays as a workspace."""

    def generate(context, builder, signature, arguments):
        names = ("P", "q", "G", "memory", "L", "factor", "w", "K")
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

    return _WORKSPACE(P, q, G, memory, L, factor, w, K), generate


@infer_getattr
class _FieldTypes(AttributeTemplate):
    key = _WorkspaceType

    def generic_resolve(self, work, name):
        return _FIELD_TYPES.get(name)


@lower_getattr_generic(_WorkspaceType)
def _read_field(context, builder, kind, work, name):
    model = context.data_model_manager[kind]
    if name in SIZES:
        return model.get(builder, work, name)
    if name in SETTINGS:
        memory = model.get(builder, work, "memory")
        return builder.load(_setting(builder, memory, name))
    if name in _POINTERS:
        data = model.get(builder, work, name)
        sizes = MATRICES.get(name, ("n",))
    else:
        data = _start_of_vector(builder, model, work, name)
        sizes = ("width",)
    shape = [model.get(builder, work, size) for size in sizes]
    return _array(context, builder, _FIELD_TYPES[name], data, shape)


@lower_setattr_generic(_WorkspaceType)
def _write_setting(context, builder, signature, arguments, name):
    work, value = arguments
    model = context.data_model_manager[signature.args[0]]
    memory = model.get(builder, work, "memory")
    builder.store(value, _setting(builder, memory, name))


def _setting(builder, memory, name):
    """Returns the pointer to a setting, in the first row of memory."""
    return builder.gep(memory, [ir.IntType(64)(SETTINGS.index(name))])


def _start_of_vector(builder, model, work, name):
    """Returns the pointer to the row of memory that a vector is."""
    row = 1 + (VECTORS + INTEGER_VECTORS).index(name)
    width = model.get(builder, work, "width")
    offset = builder.mul(width, ir.IntType(64)(row))
    return builder.gep(model.get(builder, work, "memory"), [offset])


def _array(context, builder, kind, data, shape):
    """Returns a contiguous array of 8-byte numbers that start at ``data``."""
    itemsize = ir.IntType(64)(8)
    if len(shape) == 1:
        size = shape[0]
        strides = [itemsize]
    else:
        size = builder.mul(shape[0], shape[1])
        strides = [builder.mul(shape[1], itemsize), itemsize]
    members = {
        "nitems": size,
        "itemsize": itemsize,
        "data": builder.bitcast(data, context.get_data_type(kind.dtype).as_pointer()),
        "shape": cgutils.pack_array(builder, shape),
        "strides": cgutils.pack_array(builder, strides),
    }
    model = context.data_model_manager[kind]
    array = ir.Constant(model.get_value_type(), None)  # all zeros: it owns nothing
    for name, value in members.items():
        array = model.set(builder, array, value, name)
    return array
