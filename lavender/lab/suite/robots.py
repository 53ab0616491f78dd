"""Steps of robots from models that other packages install; nothing of theirs is copied."""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from lavender.base.errors import SolverUnavailable, UnknownName
from lavender.lab.suite.case import Draft, family, parse

#: Licence of each package's models.
LICENCES = {"gymnasium": "MIT", "dm_control": "Apache-2.0"}
FOLDERS = {"gymnasium": "envs/mujoco/assets", "dm_control": "suite"}
CONES = {"pyramidal": 0, "elliptic": 1}


@family()
def robot(package: str = "gymnasium", model: str = "ant", cone: str = "pyramidal", at: int = 200) -> Draft:
    """A MuJoCo model of gymnasium or dm_control after `at` steps under controls drawn by seed 0.

    The numbers are those of one version of MuJoCo and of the package (`versions`).
    """
    path, known = _find(package, model), tuple(CONES)
    if cone not in CONES:
        raise UnknownName("cone", cone, known)
    import mujoco

    from lavender.io import from_mujoco

    m = mujoco.MjModel.from_xml_path(str(path))
    m.opt.cone = CONES[cone]
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    for _ in range(at):
        d.ctrl[:] = rng.uniform(-1.0, 1.0, m.nu)
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    problem = dataclasses.replace(from_mujoco(m, d), guess=None)
    return Draft(problem, f"{model} of {package}, thrown about: few rows that share many velocities")


def package_of(name: str) -> str:
    """The package that the model of a case's name is in; empty where the name alone makes it."""
    if name.partition("(")[0] != "robot":
        return ""
    return str(parse(name)[1].get("package", "gymnasium"))


def missing(package: str) -> str:
    """What has to be installed for the models of a package; empty where all is there."""
    absent = [name for name in ("mujoco", package) if package and find_spec(name) is None]
    return (
        f"robots of {package} need {' and '.join(absent)}: pip install 'lavender-contact[robots]'"
        if absent
        else ""
    )


def versions(package: str) -> str:
    """Versions of MuJoCo and of a package of models; empty for none."""
    from importlib.metadata import version

    return ", ".join(f"{name} {version(name)}" for name in ("mujoco", package)) if package else ""


def _find(package: str, model: str) -> Path:
    if package not in FOLDERS:
        raise UnknownName("package of models", package, FOLDERS)
    spec, told = find_spec(package), missing(package)
    if told or spec is None or not spec.submodule_search_locations:
        raise SolverUnavailable(told)
    folder = Path(spec.submodule_search_locations[0]) / FOLDERS[package]
    path = folder / f"{model}.xml"
    if not path.is_file():
        raise UnknownName(f"model of {package}", model, sorted(p.stem for p in folder.glob("*.xml")))
    return path
