"""Convert the last step of newton's `SolverMuJoCo` to a batch of problems, with the engine's impulses and its claims.

    velocity = solver.mjw_data.qvel.numpy().copy()          # before the step
    solver.step(state_in, state_out, control, contacts, dt)
    step = lavender.io.from_newton_mujoco(solver, velocity)

The solver runs MuJoCo Warp; `lavender.io.efc` describes its problem. A step overwrites the velocity, so the caller
must copy it before the step. If the engine has no memory for all contacts or rows, it drops some:
`claims.residuals["dropped_contacts"]` and `["dropped_rows"]` count them, and the converted problem does not contain
them either.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import to_numpy
from lavender.base.errors import CapabilityError, InputError
from lavender.io.efc import from_efc
from lavender.io.engine_step import Claims, EngineStep

NEWTON_ADVICE = "newton 1.8 with mujoco-warp 3.17 to 4.0 is supported"


def from_newton_mujoco(solver: Any, velocity: Any) -> EngineStep:
    """Return the problems that a `SolverMuJoCo` solved in its last step, its impulses and its claims.

    Parameters
    ----------
    solver : newton.solvers.SolverMuJoCo
        After `step`, with MuJoCo Warp (not use_mujoco_cpu).
    velocity : (n, nv) m/s, rad/s
        `solver.mjw_data.qvel` before the step, copied.

    Returns
    -------
    EngineStep
        In float32. `claims.converged` is False in worlds that used up the iterations. For lack of memory, the engine
        dropped `claims.residuals["dropped_rows"]` rows (n,) of each world, and `["dropped_contacts"]` contacts of all
        worlds together, which it does not count by world: the number is repeated (n,).

    Raises
    ------
    InputError
        `solver` is not a SolverMuJoCo with MuJoCo Warp, or the velocity has another shape.
    CapabilityError
        The Jacobian is sparse, attributes of this version are missing, or M qacc_smooth is not the smooth force.
    """
    data, model = getattr(solver, "mjw_data", None), getattr(solver, "mj_model", None)
    if data is None or model is None:
        raise InputError(
            f"solver is a {type(solver).__name__}; a newton.solvers.SolverMuJoCo that runs MuJoCo Warp is needed"
        )
    try:
        return _convert_solver_arrays(solver, data, model, to_numpy("velocity", velocity))
    except AttributeError as error:
        raise CapabilityError(
            f"an attribute of this solver is missing: {error}. {NEWTON_ADVICE}"
        ) from None


def _convert_solver_arrays(solver: Any, data: Any, model: Any, velocity: Any) -> EngineStep:
    """Read the engine's arrays and build the batch."""
    rows = data.nefc.numpy().astype(np.int64)
    contact = data.contact
    count = int(data.nacon.numpy()[0])
    capacity = int(data.efc.D.shape[1])
    nv = int(model.nv)
    jac = data.efc.J.numpy()
    if jac.ndim != 3 or jac.shape[1] < capacity or jac.shape[2] < nv:
        raise CapabilityError(
            f"efc.J has shape {jac.shape} for {capacity} rows of {nv} velocities: the Jacobian is sparse; set "
            "opt.jacobian to dense"
        )
    used = np.minimum(rows, capacity)
    m = int(used.max(initial=0))
    names = "D", "aref", "type", "frictionloss", "force"
    arrays = {f"efc_{name}": getattr(data.efc, name).numpy()[:, :m] for name in names}
    arrays |= {name: getattr(data, name).numpy() for name in ("qacc_smooth", "qfrc_smooth", "qacc")}
    dropped_contacts = max(count - len(contact.dim), 0)
    count -= dropped_contacts
    world, address, dim, friction = (
        getattr(contact, name).numpy()[:count]
        for name in ("worldid", "efc_address", "dim", "friction")
    )
    mass = data.M.numpy()
    if mass.ndim == 2:  # M is given as lower triangles in compressed rows.
        mass = (
            mass[:, : len(model.M_colind)],
            model.M_colind,
            np.append(model.M_rowadr, len(model.M_colind)),
        )
    else:
        mass = mass[:, :nv, :nv]
    result = from_efc(
        efc_J=jac[:, :m, :nv].copy(),
        M=mass,
        qvel=velocity.astype(jac.dtype),
        **arrays,
        nefc=used,
        timestep=solver.mjw_model.opt.timestep.numpy(),
        contacts=(world, address[:, 0], dim, friction),
    )
    assert result.impulse is not None
    iterations = data.solver_niter.numpy().astype(np.int64)
    limit = int(np.max(to_numpy("iterations", solver.mjw_model.opt.iterations)))
    dropped = {
        "dropped_rows": (rows - used).astype(float),
        "dropped_contacts": np.full(len(rows), float(dropped_contacts)),
    }
    return EngineStep(result.batch, result.impulse, Claims(iterations < limit, iterations, dropped))
