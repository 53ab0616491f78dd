"""The part of the time step in the difference of an engine from the rigid laws.

The ideal twin does the step of length h again as n steps of h / n from the same state. MuJoCo gives the masses, the
forces and the contacts at each state on the way, with controls and applied forces held. With v_T(h) the twin after one
step and v_T(h / n) after n steps,

    time step = v_T(h) - v_T(h / n)                                                                              (1)

so that this part and the parts of one step sum to the difference from v_T(h / n). Exchanged first, it would be
v(h) - v(h / n) of the engine itself. Its interval contains both.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.causes.difference import Part
from lavender.causes.ideal import make_ideal_twin
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import step_from_mujoco
from lavender.io.start_states import without_sleep
from lavender.io.step_record import StepRecord

COUNT = 16  # Smaller steps. Methods of first order leave about 1/16 of the part.


def measure_time_step(
    record: StepRecord, twin: StepRecord, model: Any, data: Any
) -> tuple[FloatArray, Part]:
    """Return v_T(h / n) (nv,) [m/s, rad/s] and the part of the time step, equation (1).

    Parameters
    ----------
    record, twin : StepRecord
        One step, and its ideal twin.
    model : mujoco.MjModel
    data : mujoco.MjData
        The state before the step. It is not changed.

    Raises
    ------
    InputError
        The state is another one.
    CapabilityError
        The simulation diverges.
    """
    mj = import_mujoco()
    known = ((data.qpos, record.position), (data.qvel, record.velocity))
    if not all(y is not None and np.array_equal(x, y) for x, y in known):
        raise InputError("simulation has another state than the one before the step of a")
    finer = copy.copy(without_sleep(mj, model))
    finer.opt.timestep = record.dt / COUNT
    ideal, own = mj.MjData(finer), mj.MjData(finer)
    for state in (ideal, own):
        mj.mj_copyData(state, finer, data)
    for _ in range(COUNT):
        mj.mj_step(finer, own)
        position = ideal.qpos.copy()
        velocity = make_ideal_twin(step_from_mujoco(finer, ideal)).velocity_after
        mj.mj_step(finer, ideal)  # For the time, and the activations of actuators.
        mj.mj_integratePos(finer, position, velocity, finer.opt.timestep)
        ideal.qpos[:], ideal.qvel[:] = position, velocity
    last, first = twin.velocity_after - velocity, record.velocity_after - own.qvel
    return velocity, Part("time step", last, np.stack([last, first]), last, first)
