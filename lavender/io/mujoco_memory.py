"""Find the arrays of MuJoCo's C structs that `lavender_ext.io.mujoco_rows` reads, and keep constant data."""

from __future__ import annotations

import ctypes
import re
from functools import cache
from itertools import takewhile
from types import SimpleNamespace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lavender.base.arrays import IntArray, mark_read_only
from lavender.base.errors import InputError
from lavender_ext.io.mujoco_rows import ARRAYS, Step

CHANGED_ADVICE = (
    "MjData was changed since its forward pass, or belongs to another model: run mj_forward"
)
OTHER_MODEL_ADVICE = (
    "The model was changed, or MjData belongs to another model: give a model and data made from it"
)
# Sizes in bytes of the types of members; "*" is a pointer.
TYPE_SIZES = {
    "*": 8,
    "mjtNum": 8,
    "double": 8,
    "mjtSize": 8,
    "size_t": 8,
    "uintptr_t": 8,
    "uint64_t": 8,
    "int64_t": 8,
    "int": 4,
    "float": 4,
    "mjtBool": 1,
    "mjtByte": 1,
    "char": 1,
}
# A model with rows in compressed form and several contacts, whose arrays are read in both ways.
PROBE = """<mujoco><option jacobian="sparse"/><worldbody>
<geom type="plane" size="1 1 .1"/><body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
</worldbody></mujoco>"""


class ModelCache:
    """The module MuJoCo, its layout, and what problems of one model share.

    Attributes
    ----------
    offsets, contact_layout
        Results of `find_layout`.
    pattern : (indptr, indices)
        Pattern of the lower triangle of M.
    operator : Operator or None
        Operator of the last problem. Problems share index arrays if their patterns are equal.
    """

    def __init__(self, mj: Any) -> None:
        self.mj = mj
        self.offsets, self.contact_layout = find_layout(mj)
        self.pattern: tuple[IntArray, IntArray] = (np.zeros(0, np.int32), np.zeros(0, np.int32))
        self.operator: Any = None


_MODELS: WeakKeyDictionary[Any, ModelCache] = WeakKeyDictionary()
_STEPS: WeakKeyDictionary[Any, Step] = WeakKeyDictionary()


def read_step(model: Any, data: Any) -> Step:
    """Return the addresses of the arrays of a model and its data.

    Raises
    ------
    InputError
        The arguments are not a model and its data, or the counts of rows exceed the memory of the data.
    """
    try:
        step = _STEPS.get(data)
    except TypeError:  # The object does not support weak references, so it is not an MjData.
        step = None
    if step is None or step.model is not model:
        step = _make_step(model, data)
    if not step.read(data):  # The arrays would exceed the allocated memory.
        raise InputError(
            f"nefc is {data.nefc}, ncon is {data.ncon} and nJ is {data.nJ}, which do not fit into the {data.parena} "
            f"bytes that this MjData has allocated. {CHANGED_ADVICE}"
        )
    return step


def _make_step(model: Any, data: Any) -> Step:
    mj = import_mujoco()
    if not isinstance(model, mj.MjModel) or not isinstance(data, mj.MjData):
        raise InputError(
            f"got a {type(model).__name__} and a {type(data).__name__}; a mujoco.MjModel and its mujoco.MjData "
            "are needed"
        )
    if len(data.qvel) != model.nv:
        raise InputError(
            f"the MjData has {len(data.qvel)} degrees of freedom and the model {model.nv}; both must belong "
            "together: create the data with mujoco.MjData(model)"
        )
    nv, bodies = model.nv, model.nbody
    sizes = (nv, nv, nv, nv, nv, len(model.M_colind), 6 * nv, 6 * bodies)
    if any(getattr(data, name).size != size for name, size in zip(ARRAYS, sizes, strict=False)):
        raise InputError(
            f"the arrays of the MjData have other sizes than the model. {OTHER_MODEL_ADVICE}"
        )
    kept = _MODELS.get(model) or _MODELS.setdefault(model, ModelCache(mj))
    step = _STEPS[data] = Step(model, data, kept, list_addresses)
    return step


def import_mujoco() -> Any:
    """Return the module mujoco.

    Raises
    ------
    InputError
        MuJoCo is not installed, or is too old.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "mujoco cannot be imported; it has models and data: pip install mujoco"
        ) from None
    if not hasattr(mujoco.MjModel, "M_rowadr"):
        raise InputError(
            f"mujoco is {mujoco.__version__}; 3.4 or later is needed: pip install -U mujoco"
        )
    return mujoco


@cache
def find_layout(mj: Any) -> tuple[IntArray | None, tuple[int, ...]]:
    """Return the offsets of ARRAYS in mjData, and of dim, geom and friction in a contact with its size [bytes].

    The first result is None if MuJoCo does not describe its structs, or attributes have other addresses:
    `list_addresses` then finds the arrays, which takes longer.
    """
    model = mj.MjModel.from_xml_string(PROBE)
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    contact = data.contact
    addresses = list_addresses(data)
    members = [_get_address(x) for x in (contact.dim, contact.geom, contact.friction)]
    layout = [address - members[0] for address in members] + [contact.dim.strides[0]]
    try:
        from mujoco.introspect.structs import STRUCTS

        places = _lay_out(STRUCTS, "mjData")[0]
        offsets = np.array([places[name] for name in ARRAYS], np.int64)
    except (ImportError, KeyError, AttributeError):  # A type or struct is unknown.
        return None, tuple(layout)
    stored = [ctypes.c_int64.from_address(data._address + int(offset)).value for offset in offsets]
    addresses[-1] = stored[-1]  # The first contact begins before its dim.
    if not np.array_equal(stored, addresses) or not 0 <= members[0] - stored[-1] < layout[-1]:
        return None, tuple(layout)
    return mark_read_only(offsets), tuple(
        [x + members[0] - stored[-1] for x in layout[:3]] + layout[3:]
    )


@cache
def _count_size_bytes(mj: Any) -> int:
    """Return the number of bytes before `opt` in mjModel, which are its sizes; 0 if it is not known."""
    try:
        from mujoco.introspect.structs import STRUCTS

        sizes = takewhile(lambda field: field.name != "opt", STRUCTS["mjModel"].fields)
        places, count, _ = _lay_out({"sizes": SimpleNamespace(fields=[*sizes])}, "sizes")
    except (ImportError, KeyError, AttributeError):  # A type or struct is unknown.
        return 0
    model = mj.MjModel.from_xml_string(PROBE)
    names = "nq", "nv", "ngeom", "nbuffer"
    is_same = all(
        ctypes.c_int32.from_address(model._address + places[x]).value == getattr(model, x)
        for x in names
    )
    return count if is_same else 0


def read_sizes(mj: Any, model: Any) -> bytes:
    """Return the sizes of the model in memory; empty if their place is not known."""
    return ctypes.string_at(model._address, _count_size_bytes(mj))


def list_addresses(data: Any) -> IntArray:
    """Return the addresses of ARRAYS (22,) from attributes; the last one is the address of the first contact's dim."""
    arrays = [getattr(data, name) for name in ARRAYS[:-1]]
    return np.array([_get_address(x) for x in (*arrays, data.contact.dim)], np.int64)


def _get_address(array: Any) -> int:
    """Return the address of an array's first entry; 0 if the array is empty."""
    return int(array.__array_interface__["data"][0]) if array.size else 0


def _lay_out(structs: Any, name: str) -> tuple[dict[str, int], int, int]:
    """Return the offset of each member of a C struct [bytes], then its size and alignment."""
    members = {}
    end = 0
    alignment = 1
    for field in structs[name].fields:
        text = str(field.type)
        kind = "*" if "*" in text else text.replace("const ", "").split(" ")[0]
        size = align = TYPE_SIZES.get(kind, 0)
        if not size:
            _, size, align = _lay_out(structs, kind)
        members[field.name] = -(-end // align) * align
        end = members[field.name] + size * int(
            np.prod([int(x) for x in re.findall(r"\[(\d+)\]", text)])
        )
        alignment = max(alignment, align)
    return members, -(-end // alignment) * alignment, alignment
