"""Judge every world of a vector environment at every step of a training loop.

Needs MuJoCo: pip install mujoco. With "gymnasium[mujoco]" the environment is HalfCheetah-v5; without it, hoppers in
plain MuJoCo with the same methods `reset` and `step`. After each step of the environments the states are imported by
`from_mujoco_many`, and MuJoCo's solutions are judged by `residual_many`. Worlds with an error above the limit of a
trainer are counted; their samples could be discarded.

    python examples/vector_worlds.py [WORLDS [STEPS [ITERATIONS]]]

ITERATIONS: iterations of MuJoCo's solver, to show the effect of too few.
"""

import sys
from time import perf_counter

import numpy as np

import lavender as lv

ACCEPT = 1e-3  # m/s
HOPPER = """<mujoco><option timestep="0.004"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="torso" pos="0 0 0.65"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint axis="0 1 0"/><geom type="capsule" size=".06" fromto="0 0 0 0 0 .3"/>
    <body name="thigh"><joint name="hip" axis="0 1 0" range="-60 60" limited="true"/>
      <geom type="capsule" size=".04" fromto="0 0 0 0.1 0 -.3"/>
      <body name="shank" pos="0.1 0 -.3"><joint name="knee" axis="0 1 0" range="0 120" limited="true"/>
        <geom name="foot" type="capsule" size=".04" fromto="0 0 0 -.1 0 -.3"/></body></body></body>
</worldbody><actuator><motor joint="hip" gear="40"/><motor joint="knee" gear="40"/></actuator></mujoco>"""


class Hoppers:
    """Worlds of plain MuJoCo with the interface of a vector environment of gymnasium."""

    def __init__(self, n, substeps=5):
        import mujoco as mj

        self.engine = mj
        self.model = mj.MjModel.from_xml_string(HOPPER)
        self.substeps = substeps
        self.datas = [mj.MjData(self.model) for _ in range(n)]

    def reset(self, seed):
        """Reset every world to its start, with a random velocity."""
        rng = np.random.default_rng(seed)
        for data in self.datas:
            self.engine.mj_resetData(self.model, data)
            data.qvel[:] = 0.1 * rng.standard_normal(self.model.nv)
        return self.observed(), {}

    def observed(self):
        """Return positions and velocities (n, nq + nv)."""
        return np.array([np.concatenate([data.qpos, data.qvel]) for data in self.datas])

    def step(self, actions):
        """Step all worlds; return observations, rewards, fallen worlds, timed-out worlds and an empty info."""
        for data, action in zip(self.datas, actions, strict=True):
            data.ctrl[:] = action
            self.engine.mj_step(self.model, data, self.substeps)
        fallen = np.array([data.qpos[1] < -0.4 for data in self.datas])
        reward = np.array([data.qvel[0] for data in self.datas])
        return self.observed(), reward, fallen, np.zeros(len(fallen), bool), {}


def make(n):
    """Return (environments, model, MjData of each world, name)."""
    try:
        import gymnasium

        envs = gymnasium.make_vec("HalfCheetah-v5", num_envs=n, vectorization_mode="sync")
        inner = [env.unwrapped for env in envs.envs]
        return envs, inner[0].model, [env.data for env in inner], "HalfCheetah-v5 of gymnasium"
    except ImportError as error:
        envs = Hoppers(n)
        return envs, envs.model, envs.datas, f"hoppers in plain MuJoCo ({error})"


def states_of(model, datas):
    """Return the state of each world (n, size), with its controls and warm start."""
    import mujoco as mj

    kind = mj.mjtState.mjSTATE_INTEGRATION
    states = np.empty((len(datas), mj.mj_stateSize(model, kind)))
    for state, data in zip(states, datas, strict=True):
        mj.mj_getState(model, data, state, kind)
    return states


def numbers(n=64, steps=50, iterations=None):
    """Return the number of worlds, times [s] of environments and judge, errors (steps, n) [m/s], rejected worlds."""
    envs, model, datas, name = make(n)
    scratch = lv.io.MujocoScratch(model)
    rng = np.random.default_rng(0)
    spent = np.zeros(2)
    errors = np.empty((steps, n))
    envs.reset(seed=0)
    if iterations is not None:
        for own in [model, *(env.unwrapped.model for env in getattr(envs, "envs", ()))]:
            own.opt.iterations = iterations
    for step in range(steps):
        actions = rng.uniform(-1.0, 1.0, (n, model.nu)).astype(np.float32)
        begin = perf_counter()
        envs.step(actions)
        between = perf_counter()
        batch, impulse = lv.io.from_mujoco_many(model, states_of(model, datas), scratch=scratch)
        found = lv.residual_many(batch, impulse, threshold=ACCEPT)
        errors[step] = found.velocity_error
        spent += between - begin, perf_counter() - between
    return {"name": name, "seconds": spent, "errors": errors, "refused": errors > ACCEPT}


def main():
    words = sys.argv[1:]
    if not all(map(str.isdecimal, words)):
        sys.exit(__doc__)
    n, steps, iterations = (*map(int, words), *(64, 50, None)[len(words) :])
    found = numbers(n, steps, iterations)
    own, judge = n * steps / found["seconds"]
    print(f"{n} worlds of {found['name']}, {steps} steps")
    print(f"environments alone  {own:9.0f} steps/s")
    print(f"verdicts alone      {judge:9.0f} steps/s")
    print(f"both                {n * steps / found['seconds'].sum():9.0f} steps/s")
    print(f"worst error         {found['errors'].max():9.1e} m/s")
    print(
        f"above {ACCEPT:g} m/s     {found['refused'].sum():9d} of {n * steps} steps, not to learn from"
    )


if __name__ == "__main__":
    main()
