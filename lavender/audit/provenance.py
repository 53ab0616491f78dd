"""Name the versions, the settings and the command from which the numbers of an audit, a tuning or a slip come."""

from __future__ import annotations

import contextlib
import shlex
import sys
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from lavender._version import __version__
from lavender.audit.settings import get_option_value
from lavender.io.start_states import hash_model

# Packages of the engines by their names in `audit`; "mujoco" compiles the models of most of them.
PACKAGES = {
    "mujoco": "mujoco",
    "mjx": "mujoco-mjx",
    "mujoco_warp": "mujoco-warp",
    "kamino": "newton",
    "newton-mujoco": "newton",
    "genesis": "genesis-world",
}
N_HASH_DIGITS = 12


def describe_provenance(model: Any, name: str, engine: str = "mujoco") -> dict[str, Any]:
    """Return the provenance of numbers, as numbers.json holds it; `model` is None for scenes of other engines.

    engine, engine_version, lavender, mujoco, integrator, solver, cone, timestep [s], model, model_hash (of the arrays
    and options of the model), date (UTC) and command; an entry that the run does not have is None.
    """
    version = None
    program = Path(sys.argv[0])
    with contextlib.suppress(metadata.PackageNotFoundError):
        version = metadata.version(PACKAGES.get(engine, engine))
    is_lavender = program.stem == "lavender" or program.parts[-2:] == ("lavender", "__main__.py")
    entries: dict[str, Any] = {
        "engine": engine,
        "engine_version": version,
        "lavender": __version__,
        "mujoco": None,
        "integrator": None,
        "solver": None,
        "cone": None,
        "timestep": None,
        "model": name,
        "model_hash": None,
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": shlex.join(["lavender", *sys.argv[1:]]) if is_lavender else None,
    }
    if model is not None:
        import mujoco as mj

        integrator = mj.mjtIntegrator(int(model.opt.integrator)).name.removeprefix("mjINT_")
        entries |= {
            name: get_option_value(mj, model, name) for name in ("solver", "cone", "timestep")
        }
        entries |= {
            "mujoco": mj.__version__,
            "integrator": "Euler" if integrator == "EULER" else integrator.lower(),
            "model_hash": hash_model(model, options=True)[:N_HASH_DIGITS],
        }
    return entries


def format_provenance(entries: dict[str, Any]) -> str:
    """Return the last line of a terminal with the entries of `describe_provenance`."""
    settings = [entries[name] for name in ("integrator", "solver", "cone") if entries[name]]
    timestep = [] if entries["timestep"] is None else [f"{entries['timestep']:g} s"]
    model = " ".join(filter(None, (entries["model"], entries["model_hash"])))
    engine = " ".join(filter(None, (entries["engine"], entries["engine_version"])))
    parts = [engine, f"lavender {entries['lavender']}", *settings, *timestep, model]
    parts += [entries["date"], entries["command"]]
    return ", ".join(filter(None, parts))
