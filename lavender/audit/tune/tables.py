"""Tables of the settings that are tried: field, values and meaning for each engine.

A line tries each of its values together with the fields in `fixed`. These fields replace fields of the present setting;
lines with `near` replace fields of the settings near the Pareto front of time and error.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

NOTHING: Mapping[str, Any] = MappingProxyType({})


class Field(NamedTuple):
    """A field of an engine's options, the values that are tried, and its meaning."""

    name: str
    values: tuple[Any, ...]
    meaning: str
    fixed: Mapping[str, Any] = NOTHING
    near: bool = False


def list_options(table: tuple[Field, ...], near: bool = False) -> list[dict[str, Any]]:
    """Return the options that a table tries: variants of settings near the front, or of the present setting."""
    return [{**f.fixed, f.name: x} for f in table if f.near == near for x in f.values]


NEWTON, CG, PGS = ({"solver": name} for name in ("Newton", "CG", "PGS"))
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)
#: Options of MuJoCo, attributes of `<option>`. The last three change the constraint problem itself.
MUJOCO = (
    Field("tolerance", TOLERANCES, "improvement below which Newton's method stops", NEWTON),
    Field("iterations", (1, 2, 3, 5, 10), "budget of Newton's method", NEWTON),
    Field("tolerance", TOLERANCES, "improvement below which conjugate gradients stop", CG),
    Field("iterations", (3, 6, 12, 25, 50), "budget of conjugate gradients", CG),
    Field("tolerance", TOLERANCES, "improvement below which projected Gauss-Seidel stops", PGS),
    Field("iterations", (3, 6, 12, 25, 50, 100), "budget of projected Gauss-Seidel", PGS),
    Field("cone", ("pyramidal", "elliptic"), "shape of the friction cone"),
    Field("impratio", (1.0, 10.0), "stiffness of friction over that of normal contact"),
    Field("noslip_iterations", (0, 3, 10), "sweeps of friction after the solve"),
)
#: Options of MuJoCo Warp, which works in float32 and raises smaller tolerances to about its round-off.
MUJOCO_WARP = (
    Field(
        "tolerance", (1e-2, 1e-3, 1e-4, 1e-5, 1e-6), "improvement below which Newton's method stops", NEWTON
    ),
    Field("iterations", (1, 2, 3, 5, 10, 20), "budget of Newton's method", NEWTON),
    Field(
        "tolerance", (1e-2, 1e-3, 1e-4, 1e-5, 1e-6), "improvement below which conjugate gradients stop", CG
    ),
    Field("iterations", (3, 6, 12, 25, 50), "budget of conjugate gradients", CG),
    Field("ls_iterations", (3, 5, 10, 20), "budget of a line search"),
    Field("impratio", (1.0, 10.0), "stiffness of friction over that of normal contact"),
    Field("ls_iterations", (3, 5, 10, 20), "budget of a line search", near=True),
)
#: Fields of newton's PADMMSolverConfig; "tolerance" sets the primal, dual and complementarity tolerances.
KAMINO = (
    Field("max_iterations", (10, 25, 50, 100, 200, 400), "budget of ADMM"),
    Field("tolerance", (1e-3, 1e-4, 1e-5, 1e-6, 1e-7), "residuals below which ADMM stops"),
    Field("rho_0", (0.01, 0.1, 1.0, 10.0, 100.0), "initial penalty of ADMM"),
    Field("rho_0", (0.01, 0.1, 1.0, 10.0, 100.0), "initial penalty of ADMM", near=True),
    Field("use_acceleration", (False,), "Nesterov's acceleration of ADMM", near=True),
)
