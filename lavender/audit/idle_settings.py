"""Settings of physics that change nothing in a step, which `tune` and `slip` leave out.

Only settings of friction, softness and the integrator are left out: what a setting of the solver changes depends on the
steps before, so that they are always run.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, TypeVar

import numpy as np

from lavender.audit.rigid_laws import MAX_ROWS, MAX_VELOCITIES
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError
from lavender.causes.comparison import compare
from lavender.io.mujoco_step import step_from_mujoco

# [-] A setting is left out if it changes the step by less than this part of the step's change of velocity.
MIN_CHANGE = 0.01
PHYSICS_OPTIONS = ("cone", "impratio")  # Options of `MujocoSetting` that are not the solver's.
INGREDIENTS = ("friction", "softness", "integrator")
Key = TypeVar("Key", bound=Hashable)


def list_idle_settings(
    mj: Any, model: Any, state: FloatArray, changed: Mapping[Key, Any]
) -> dict[Key, float]:
    """Return the settings that hardly change a step, with the largest change in any mixture relative to the step [-].

    Parameters
    ----------
    mj : module
        MuJoCo.
    model : mujoco.MjModel
        With the present setting.
    state : (size,)
        MuJoCo's state before the step (mjSTATE_INTEGRATION).
    changed : dict of models
        Models with settings of physics. If the step cannot be divided into parts, none is left out.
    """
    if not changed or model.nv > MAX_VELOCITIES:
        return {}
    kind = mj.mjtState.mjSTATE_INTEGRATION

    def read(one: Any) -> Any:
        data = mj.MjData(one)
        mj.mj_setState(one, data, state, kind)
        return step_from_mujoco(one, data)

    found: dict[Key, float] = {}
    try:
        own = read(model)
        size = float(np.abs(own.velocity_after - own.velocity).max())
        if own.n_rows > MAX_ROWS or size == 0.0:
            return {}
        for key, one in changed.items():
            parts = compare(own, read(one)).parts
            if any(np.any(p.mean) for n, p in parts.items() if n in ("mass", "force", "rows")):
                continue
            largest = max(
                (float(np.abs(parts[n].changes).max()) for n in INGREDIENTS if n in parts),
                default=0.0,
            )
            if largest < MIN_CHANGE * size:
                found[key] = largest / size
    except (LavenderError, mj.FatalError, np.linalg.LinAlgError):
        return {}
    return found
