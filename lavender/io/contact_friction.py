"""Find the friction coefficients of a MuJoCo contact by its name; MuJoCo combines them from both geoms."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.io.mujoco_memory import import_mujoco


def find_geom(mj: Any, model: Any, name: str) -> int:
    """Return the number of a geom by its name, or by its number if it has no name; -1 if there is none."""
    geom = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_GEOM, name))
    return int(name) if geom < 0 and name.isdigit() and int(name) < model.ngeom else geom


def find_friction(model: Any, contact: str) -> FloatArray | None:
    """Return the coefficients (2,) [-] of both tangents of a contact "contact K (GEOM, GEOM)"; None without two geoms.

    Explicit pairs have their own. Otherwise the geom with the higher priority decides, or the larger coefficient.
    """
    mj = import_mujoco()
    sides = contact.partition(" (")[2].partition(")")[0].split(", ")
    geoms = [find_geom(mj, model, side) for side in sides]
    if len(geoms) != 2 or min(geoms) < 0:
        return None
    if model.opt.enableflags & mj.mjtEnableBit.mjENBL_OVERRIDE:
        found = np.array(model.opt.o_friction[:2])
    else:
        pairs = np.sort(np.column_stack([model.pair_geom1, model.pair_geom2]), axis=1)
        own = np.flatnonzero((pairs == sorted(geoms)).all(axis=1))
        first, second = model.geom_friction[geoms, 0]
        order = int(np.sign(int(np.subtract(*model.geom_priority[geoms]))))
        sliding = (max(first, second), first, second)[order]
        found = model.pair_friction[own[0], :2] if len(own) else np.full(2, sliding)
    return np.maximum(np.asarray(found, float), mj.mjMINMU)
