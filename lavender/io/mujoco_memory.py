"""Find the members of MuJoCo's C structs that `lavender_ext.io.mujoco_step` reads, and keep constant data."""

from __future__ import annotations

import re
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lavender.base.arrays import IntArray, mark_read_only
from lavender.base.errors import InputError
from lavender_ext.io.mujoco_step import MEMBERS, Step

CHANGED_ADVICE = "MjData was changed since its forward pass, or belongs to another model: run mj_forward"
OTHER_MODEL_ADVICE = (
    "The model was changed, or MjData belongs to another model: give a model and data made from it"
)
# Sizes in bytes of the types of members; "*" is a pointer.
TYPE_SIZES = {
    "*": 8, "mjtNum": 8, "double": 8, "mjtSize": 8, "size_t": 8, "uintptr_t": 8, "uint64_t": 8, "int64_t": 8,
    "int": 4, "float": 4, "mjtBool": 1, "mjtByte": 1, "char": 1,
}  # fmt: skip
ROW_TYPES = (
    "EQUALITY", "FRICTION_DOF", "FRICTION_TENDON", "LIMIT_JOINT", "LIMIT_TENDON", "CONTACT_FRICTIONLESS",
    "CONTACT_PYRAMIDAL", "CONTACT_ELLIPTIC",
)  # fmt: skip
# A model with rows in compressed form and several contacts, whose members are read in both ways.
PROBE = """<mujoco><option jacobian="sparse" noslip_iterations="3" timestep="0.003"/><worldbody>
<geom type="plane" size="1 1 .1"/><body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
</worldbody></mujoco>"""


class ModelCache:
    """The module MuJoCo, its numbers of the types of rows, and the operator of a model's first problem.

    Later problems share its index arrays if their patterns are equal. `is_plain` states that its velocities keep their
    order.
    """

    def __init__(self, mj: Any) -> None:
        self.mj = mj
        codes = [int(getattr(mj.mjtConstraint, f"mjCNSTR_{name}")) for name in ROW_TYPES]
        self.codes = mark_read_only(np.array(codes, np.int32))
        self.first_operator: Any = None
        self.is_plain = False


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
        m, contacts, entries, size = step.counts
        raise InputError(
            f"nefc is {m}, ncon is {contacts} and nJ is {entries}, which do not fit into the {size} "
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
    kept = _MODELS.get(model) or _MODELS.setdefault(model, ModelCache(mj))
    try:
        step = _STEPS[data] = Step(model, data, find_offsets(mj), mj.mj_isSparse, kept)
    except ValueError:
        raise InputError(
            f"the arrays of the MjData have other sizes than the model. {OTHER_MODEL_ADVICE}"
        ) from None
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
            "mujoco cannot be imported: pip install mujoco, which provides models and data"
        ) from None
    if not hasattr(mujoco.MjModel, "M_rowadr"):
        raise InputError(f"mujoco is {mujoco.__version__}; 3.4 or later is needed: pip install -U mujoco")
    return mujoco


@cache
def find_offsets(mj: Any) -> IntArray | None:
    """Return the `offsets` of `Step`; None if MuJoCo does not describe its structs, or the attributes differ."""
    try:
        from mujoco.introspect.structs import STRUCTS

        layouts = {name: _lay_out(STRUCTS, name) for name in ("mjData", "mjContact", "mjOption")}
        layouts["mjModel"] = _lay_out(STRUCTS, "mjModel", "opt")
        found = [_find_member(mj, layouts, *member) for member in MEMBERS]
    except (ImportError, KeyError, AttributeError):  # A type or struct is unknown.
        return None
    offsets = mark_read_only(np.array(found, np.int64))
    model = mj.MjModel.from_xml_string(PROBE)
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    steps = [Step(model, data, x, mj.mj_isSparse, None) for x in (offsets, None)]
    for step in steps:
        step.read(data)
    return offsets if data.ncon > 1 and steps[0].has_equal_members(steps[1]) else None


def _find_member(mj: Any, layouts: dict[str, Any], struct: str, name: str) -> tuple[int, int]:
    """Return offset and size [bytes] of a member; -1 and 0 if this version does not have it."""
    if not name:
        return layouts[struct][1], 0
    if name.startswith("opt."):
        offset, size = layouts["mjOption"][0][name[4:]]
        return layouts[struct][0]["opt"][0] + offset, size
    if name in ("efm_active", "flg_surfacevel") and not hasattr(
        getattr(mj, struct.replace("mj", "Mj")), name
    ):
        return -1, 0  # Older versions do not have this member.
    return layouts[struct][0][name]


def _lay_out(structs: Any, name: str, last: str = "") -> tuple[dict[str, tuple[int, int]], int, int]:
    """Return offset and size [bytes] of each member of a C struct up to member `last`, then its size and alignment."""
    members, end, alignment = {}, 0, 1
    for field in structs[name].fields:
        text = str(field.type)
        kind = "*" if "*" in text else text.replace("const ", "").split(" ")[0]
        if kind in TYPE_SIZES:
            size = align = TYPE_SIZES[kind]
        else:
            _, size, align = _lay_out(structs, kind)
        offset = -(-end // align) * align
        members[field.name] = offset, size
        end = offset + size * int(np.prod([int(x) for x in re.findall(r"\[(\d+)\]", text)]))
        alignment = max(alignment, align)
        if field.name == last:
            break
    return members, -(-end // alignment) * alignment, alignment
