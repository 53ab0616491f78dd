"""Models and planted changes: what a user changes in a model, and the name of the cause that it has.

MuJoCo itself gives the truth: the models without changes, with each change, and with both.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco as mj
import numpy as np

FOLDER = Path(__file__).parent / "causes" / "models"
# Steps before the compared one. The sled, which friction lifts, leaves the floor in its first step.
SETTLING_STEPS = {
    "gripper": 3,
    "sliding": 0,
    "arm": 3,
    "loop": 3,
    "tendon": 3,
    "ball": 3,
    "swimmer": 3,
}
Change = Callable[[Any], None]


def read_model(name: str, integrator: str, cone: str) -> Any:
    """Return a model with an integrator and a cone."""
    model = mj.MjModel.from_xml_path(str(FOLDER / f"{name}.xml"))
    model.opt.integrator = getattr(KINDS, f"mjINT_{integrator.upper()}")
    model.opt.cone = getattr(mj.mjtCone, f"mjCONE_{cone.upper()}")
    return model


def load(name: str, integrator: str, cone: str, *changes: Change) -> tuple[Any, Any]:
    """Return a model with the changes and its data at the state that the model without changes has reached."""
    first = read_model(name, integrator, cone)
    start = mj.MjData(first)
    mj.mj_resetDataKeyframe(first, start, 0)
    for _ in range(SETTLING_STEPS[name]):
        mj.mj_step(first, start)
    model = read_model(name, integrator, cone)
    for change in changes:
        change(model)
    data = mj.MjData(model)
    mj.mj_setConst(model, data)
    mj.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel, start.ctrl
    if model.na:
        data.act[:] = start.act
    return model, data


def scale(array: str, at: Any, factor: float) -> Change:
    """Multiply entries of an array of the model."""

    def change(model: Any) -> None:
        values = getattr(model, array)
        values[at] = np.asarray(values[at]) * factor

    return change


def put(array: str, at: Any, value: Any) -> Change:
    """Replace entries of an array of the model."""

    def change(model: Any) -> None:
        getattr(model, array)[at] = value

    return change


def option(name: str, value: Any) -> Change:
    """Replace an option."""

    def change(model: Any) -> None:
        if isinstance(value, tuple):
            getattr(model.opt, name)[:] = value
        else:
            setattr(model.opt, name, value)

    return change


def together(*changes: Change) -> Change:
    """Do several changes."""

    def change(model: Any) -> None:
        for one in changes:
            one(model)

    return change


def heavier(body: int, factor: float) -> Change:
    """Change mass and inertia of one body."""
    return together(scale("body_mass", body, factor), scale("body_inertia", body, factor))


ALL = slice(None)
KINDS = mj.mjtIntegrator
ELLIPTIC, PYRAMIDAL = int(mj.mjtCone.mjCONE_ELLIPTIC), int(mj.mjtCone.mjCONE_PYRAMIDAL)
GAINS = together(scale("actuator_gainprm", (0, 0), 1.5), scale("actuator_biasprm", (0, 1), 1.5))
SOLREF, SOLIMP = ("geom_solref", "jnt_solref", "dof_solref", "eq_solref", "tendon_solref_lim", "tendon_solref_fri"), (
    "geom_solimp", "jnt_solimp", "dof_solimp", "eq_solimp", "tendon_solimp_lim", "tendon_solimp_fri")  # fmt: skip


def other_cone(model: Any) -> None:
    """Exchange the cone."""
    model.opt.cone = PYRAMIDAL if model.opt.cone == ELLIPTIC else ELLIPTIC


def set_integrator(name: str) -> Change:
    """Choose an integrator by its name."""
    return option("integrator", int(getattr(KINDS, f"mjINT_{name}")))


#: Name -> (change, cause).
COMMON: dict[str, tuple[Change, str]] = {
    "gravity": (option("gravity", (1.0, 0.0, -9.0)), "force"),
    "solref": (together(*(put(x, ALL, (0.03, 0.8)) for x in SOLREF)), "softness"),
    "direct solref": (together(*(put(x, ALL, (-4e3, -60.0)) for x in SOLREF)), "softness"),
    "solimp": (together(*(put(x, ALL, (0.8, 0.97, 0.002, 0.4, 3.0)) for x in SOLIMP)), "softness"),
    "damping": (scale("dof_damping", ALL, 2.0), "integrator"),
    "implicitfast": (set_integrator("IMPLICITFAST"), "integrator"),
    "implicit": (set_integrator("IMPLICIT"), "integrator"),
    "discrete": (set_integrator("DISCRETE"), "integrator"),
}  # fmt: skip
CONTACT: dict[str, tuple[Change, str]] = {
    "cone": (other_cone, "friction"),
    "mu": (scale("geom_friction", (ALL, 0), 0.5), "friction"),
    "impratio": (option("impratio", 5.0), "softness"),
    "margin": (put("geom_margin", ALL, 0.001), "rows"),
    "noslip": (option("noslip_iterations", 5), "noslip"),
}
OWN: dict[str, dict[str, tuple[Change, str]]] = {
    "gripper": {
        "mass of one body": (heavier(3, 1.7), "mass"),
        "armature of one joint": (scale("dof_armature", 0, 5.0), "mass"),
        "inertia of one body": (scale("body_inertia", 3, 3.0), "mass"),
        "gains": (GAINS, "integrator"),
        "kv": (scale("actuator_biasprm", (0, 2), 2.0), "integrator"),
        "size": (scale("geom_size", (3, 0), 1.002), "rows"),
        "excluded": (together(put("geom_contype", 1, 0), put("geom_conaffinity", 1, 0)), "rows"),
        "condim 1": (put("geom_condim", ALL, 1), "friction"),
        "condim 4": (put("geom_condim", ALL, 4), "friction"),
        "frictionloss": (put("dof_frictionloss", 0, 3.0), "friction"),
        **CONTACT,
    },
    "sliding": {
        "mass of one body": (heavier(2, 3.0), "mass"),
        "stiffness": (scale("jnt_stiffness", 1, 4.0), "force"),
        "condim 6": (put("geom_condim", ALL, 6), "friction"),
        "floor": (put("geom_pos", (0, 2), 0.0003), "rows"),
        "belt": (put("geom_surfacevel", (0, 0), 0.7) if hasattr(mj.MjModel, "geom_surfacevel") else None, "rows"),
        **CONTACT,
    },
    "arm": {
        "mass of one body": (heavier(2, 1.5), "mass"),
        "range": (put("jnt_range", (0, 1), 0.5035), "rows"),
        "limit off": (put("jnt_limited", 1, 0), "rows"),
        "frictionloss": (scale("dof_frictionloss", ALL, 2.0), "friction"),
        "no frictionloss": (put("dof_frictionloss", 0, 0.0), "friction"),
        "solreflimit": (put("jnt_solref", 0, (0.01, 1.0)), "softness"),
        "solreffriction": (put("dof_solref", ALL, (0.05, 1.0)), "softness"),
        "gains": (GAINS, "integrator"),
        "margin": (put("jnt_margin", ALL, 0.01), "rows"),
    },
    "loop": {
        "mass of one body": (heavier(3, 2.0), "mass"),
        "pose of the weld": (put("eq_data", (1, 4), 0.153), "rows"),
        "anchor": (put("eq_data", (0, 2), -0.302), "rows"),
        "torquescale": (put("eq_data", (1, 10), 0.5), "rows"),
        "weld off": (put("eq_active0", 1, 0), "rows"),
        "solref of the weld": (put("eq_solref", 1, (0.05, 1.0)), "softness"),
        "frictionloss": (scale("dof_frictionloss", ALL, 3.0), "friction"),
    },
    "tendon": {
        "mass of one body": (heavier(2, 2.0), "mass"),
        "range": (put("tendon_range", (0, 1), 0.098), "rows"),
        "frictionloss": (scale("tendon_frictionloss", ALL, 2.0), "friction"),
        "damping of tendons": (scale("tendon_damping", ALL, 3.0), "integrator"),
        "gain": (scale("actuator_gainprm", (0, 0), 2.0), "integrator"),
    },
    "swimmer": {
        "mass of one body": (heavier(2, 1.6), "mass"),
        "inertia of one body": (scale("body_inertia", 3, 2.0), "mass"),
        "density": (option("density", 700.0), "integrator"),
        "viscosity": (option("viscosity", 0.5), "integrator"),
        "wind": (option("wind", (0.5, 0.0, -0.2)), "integrator"),
        "frictionloss": (scale("dof_frictionloss", ALL, 2.0), "friction"),
        "range": (put("jnt_range", (1, 1), 0.402), "rows"),
    },
    "ball": {
        "mass of one body": (heavier(1, 2.0), "mass"),
        "rolling": (scale("geom_friction", (ALL, 2), 4.0), "friction"),
        "spin": (scale("geom_friction", (ALL, 1), 4.0), "friction"),
        "condim 3": (put("geom_condim", ALL, 3), "friction"),
        **CONTACT,
    },
}  # fmt: skip
CHANGES = {
    name: {k: v for k, v in (COMMON | own).items() if v[0] is not None} for name, own in OWN.items()
}
