"""Step a gymnasium environment and yield the state before every step of MuJoCo, with the model at that time.

Environments change their model after loading: gymnasium-robotics resets welds, and domain randomisation changes masses
and friction. `mujoco.mj_step` is replaced while an environment steps, so that each step is captured as it is.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lavender.audit.simulated_worlds import Runs, has_diverged
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError

# Model, states before steps (n, size), velocities after them (n, nv), and whether the last step diverged.
Captured = list[tuple[Any, FloatArray, FloatArray, bool]]


def is_environment(source: Any) -> bool:
    """Return whether an object is an environment: it has `reset`, `step` and `unwrapped`."""
    return all(hasattr(source, name) for name in ("reset", "step", "unwrapped"))


def make_environment_runs(env: Any, episodes: int, steps: int, seed: int) -> Runs:
    """Make the runs of an environment, which steps itself."""
    model, data = (getattr(env.unwrapped, name, None) for name in ("model", "data"))
    if type(model).__name__ != "MjModel" or type(data).__name__ != "MjData":
        raise InputError(
            f"{type(env.unwrapped).__name__} has no model and data of MuJoCo as env.unwrapped.model and .data; "
            "record the steps of your own loop by lavender.io.Recorder"
        )
    name = getattr(getattr(env, "spec", None), "id", None) or type(env.unwrapped).__name__
    return Runs(name, model, episodes, steps, seed=seed, spread=0.0)


@contextlib.contextmanager
def capture_steps(mj: Any, env: Any) -> Iterator[Captured]:
    """Append each call of `mujoco.mj_step` for the data of an environment to a list."""
    captured: Captured = []
    kind = mj.mjtState.mjSTATE_INTEGRATION
    mj_step = mj.mj_step

    def step(model: Any, data: Any, nstep: int = 1) -> None:
        """Step like `mujoco.mj_step`, one step at a time."""
        if data is not env.unwrapped.data:
            mj_step(model, data, nstep)
            return
        states = np.empty((nstep, mj.mj_stateSize(model, kind)))
        after = np.full((nstep, model.nv), np.nan)
        own = copy.copy(model)
        for k in range(nstep):
            mj.mj_getState(model, data, states[k], kind)
            mj_step(model, data)
            if has_diverged(mj, data):
                captured.append((own, states[: k + 1], after[: k + 1], True))
                if nstep > k + 1:
                    mj_step(model, data, nstep - k - 1)
                return
            after[k] = data.qvel
        captured.append((own, states, after, False))

    mj.mj_step = step
    try:
        yield captured
    finally:
        mj.mj_step = mj_step


def iterate_environment(
    env: Any, policy: Callable[[Any], Any] | None, runs: Runs, world: int
) -> Iterator[tuple[Any, FloatArray, FloatArray, int, bool]]:
    """Step an environment from `env.reset(seed=seed + world)` until `runs.steps` steps of MuJoCo are done.

    An episode that ends earlier is followed by the next one. Yields the model, the states before consecutive steps
    (n, size) of mjSTATE_INTEGRATION, the velocities after them (n, nv), the number of the first of them, and whether
    the world diverged in the last.
    """
    observation, _ = env.reset(seed=runs.seed + world)
    env.action_space.seed(runs.seed + world)
    done = 0
    while done < runs.steps:
        action = env.action_space.sample() if policy is None else policy(observation)
        with capture_steps(runs.mj, env) as captured:
            observation, _, terminated, truncated, _ = env.step(action)
        if not captured:
            raise InputError(
                f"env.step of {runs.name} called mujoco.mj_step for env.unwrapped.data no time; record the steps of "
                "your own loop by lavender.io.Recorder"
            )
        for model, states, after, diverged in captured:
            states = states[: runs.steps - done]
            if len(states):
                yield model, states, after[: len(states)], done, diverged
            done += len(states)
            if diverged:
                return
        if terminated or truncated:
            observation, _ = env.reset()
