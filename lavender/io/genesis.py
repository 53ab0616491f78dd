"""Convert the last step of a Genesis scene to a batch of problems, with the engine's impulses and its claims.

    scene.step()
    step = lavender.io.from_genesis(scene)
    lavender.residual_many(step.batch, step.impulse, errors="status").velocity_error      # (n,) m/s, judged

The rigid solver of Genesis solves MuJoCo's problem (`lavender.io.efc`) for each environment. Its arrays store the
environment last, and rows in the order equalities, dry friction, contacts, joint limits. Friction cones are pyramids,
or elliptic, and elliptic contacts are solved by one of two laws:

    contact_resolution = convex       MuJoCo's relaxation: the law "cone"
    contact_resolution = signorini    Coulomb's law over softened rows: the law "coulomb"

The velocity before the step is computed as the velocity after it minus dt times the acceleration of the integrator.
This is not qacc with Euler or implicitfast and joint damping D: it solves (M + dt D) a = M qacc, or, in
MuJoCo compatibility mode, the balance of forces. If a step has several substeps, only the last one can be converted.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError, InputError
from lavender.io.efc import ELLIPTIC, EQUALITY, FRICTION, from_efc
from lavender.io.engine_step import Claims, EngineStep

LIMIT, PYRAMIDAL = 3, 6  # Values of mjtConstraint: a joint limit, an edge of a pyramid.
ROWS_OF_NORMAL_AND_TANGENTS = 3
DEFAULT_FRICTION = (
    1.0  # [-] Coefficient of a geom with a material that has none, such as `morphs.Plane()`.
)
GENESIS_ADVICE = "genesis-world 1.4 is known"


def from_genesis(scene: Any) -> EngineStep:
    """Return the problems that a Genesis scene solved in its last step, its impulses and its claims.

    Parameters
    ----------
    scene : genesis.Scene
        Built, with rigid bodies, after `step`.

    Returns
    -------
    EngineStep
        One world for each environment, in float32 or float64 as the engine computed. `claims.converged` is False for
        an environment that used up its iterations.

    Warns
    -----
    UserWarning
        A plane has the default friction of 1, and a body less: the engine uses the larger coefficient of a contact.

    Raises
    ------
    InputError
        `scene` is not a built scene with rigid bodies.
    CapabilityError
        The scene uses noslip iterations, hibernation, or the SAP or IPC coupler; the Signorini condition with torsional
        or rolling friction; attributes of this version are missing; or M qacc_smooth is not the smooth force.
    """
    solver = find_solver(scene)
    try:
        step = _convert_solver_arrays(scene, solver)
        # Coefficients of materials, and whether a plane has none and therefore the default one.
        coefficients = [DEFAULT_FRICTION]
        has_default_plane = False
        for entity in getattr(scene, "entities", ()):
            coefficient = getattr(entity.material, "friction", None)
            if coefficient is not None:
                coefficients.append(float(coefficient))
            has_default_plane |= coefficient is None and type(entity.morph).__name__ == "Plane"
    except AttributeError as error:
        raise CapabilityError(
            f"an attribute of this scene is missing: {error}. {GENESIS_ADVICE}"
        ) from None
    if has_default_plane and min(coefficients) < DEFAULT_FRICTION:
        warnings.warn(
            f"a body has friction {min(coefficients):g}, and a plane the default of {DEFAULT_FRICTION:g}. Genesis "
            "uses the larger coefficient, so contacts of both have the default: give the plane's material a friction",
            stacklevel=2,
        )
    return step


def find_solver(scene: Any) -> Any:
    """Return the rigid solver of a built scene."""
    solver = getattr(getattr(scene, "sim", None), "rigid_solver", None)
    if solver is None or not getattr(scene, "is_built", False):
        raise InputError(
            f"scene is a {type(scene).__name__}; a built genesis.Scene of rigid bodies is needed"
        )
    return solver


def _convert_solver_arrays(scene: Any, solver: Any) -> EngineStep:
    """Read the engine's arrays and build the batch."""
    config = solver.rigid_config
    constraints = solver.constraint_solver.constraint_state
    check_configuration(scene, solver)
    rows = copy_to_host(constraints.n_constraints).astype(np.int32)
    equalities, losses, contact_rows = (
        copy_to_host(getattr(constraints, f"n_constraints_{kind}")).astype(np.int64)
        for kind in ("equality", "frictionloss", "cone")
    )
    n = len(rows)
    m = int(rows.max(initial=0))
    size = int(config.rows_per_contact)
    is_elliptic = bool(config.enable_elliptic_friction)
    if not is_elliptic:
        contact_rows = size * copy_to_host(solver.collider.collider_state.n_contacts).astype(
            np.int64
        )
    index = np.arange(m)
    ends = np.cumsum([equalities, losses, contact_rows], axis=0)[:, :, None]  # Shape (3, n, 1).
    contact_type = ELLIPTIC if is_elliptic else PYRAMIDAL
    row_type = np.select(
        [index < ends[0], index < ends[1], index < ends[2]],
        [EQUALITY, FRICTION[0], contact_type],
        LIMIT,
    )
    loss = copy_to_host(constraints.efc_frictionloss, m).T
    contacts = None
    if is_elliptic:
        # The first row of a contact stores its coefficient of sliding friction in `loss` (n, m), and each row of
        # torsional or rolling friction its own coefficient.
        count = contact_rows // size
        world = np.repeat(np.arange(n), count)
        number = np.arange(len(world)) - np.repeat(np.cumsum(count) - count, count)
        address = ends[1, world, 0] + size * number
        friction = np.repeat(loss[world, address][:, None], 5, axis=1).astype(float)
        for j in range(ROWS_OF_NORMAL_AND_TANGENTS, size):
            friction[:, j - 1] = loss[world, address + j]
        contacts = world, address, np.full(len(world), size), friction
    dofs = solver.dyn_state.dofs
    dt = float(solver.substep_dt)
    jac = np.ascontiguousarray(np.moveaxis(copy_to_host(constraints.jac, m), 2, 0))
    velocity = copy_to_host(dofs.vel).T.astype(float) - dt * copy_to_host(dofs.acc).T
    moved_by = "acceleration"
    if config.enable_mujoco_compatibility:
        from genesis import integrator

        moved_by = "forces" if config.integrator == integrator.implicitfast else moved_by
        if (
            config.integrator == integrator.Euler
            and copy_to_host(solver.dyn_info.dofs.damping).any()
        ):
            raise CapabilityError(
                "enable_mujoco_compatibility with Euler moves trees with damping by forces and others by "
                "accelerations, which is not supported: change one of both"
            )
    result = from_efc(
        efc_J=jac,
        efc_D=copy_to_host(constraints.efc_D, m).T,
        efc_aref=copy_to_host(constraints.aref, m).T,
        efc_type=row_type,
        M=np.ascontiguousarray(np.moveaxis(copy_to_host(solver.rigid_info.mass_mat), 2, 0)),
        qvel=velocity.astype(jac.dtype),
        qacc_smooth=copy_to_host(dofs.acc_smooth).T,
        timestep=dt,
        efc_frictionloss=np.abs(loss),
        nefc=rows,
        contacts=contacts,
        efc_force=copy_to_host(constraints.efc_force, m).T,
        qfrc_smooth=copy_to_host(dofs.qf_smooth).T,
        qacc=copy_to_host(constraints.qacc).T,
        moved_by=moved_by,
        friction="coulomb" if config.enable_signorini_contact else "cone",
    )
    converged = ~copy_to_host(constraints.improved).astype(bool)
    assert result.impulse is not None
    return EngineStep(result.batch, result.impulse, Claims(converged, np.full(n, -1), {}))


def check_configuration(scene: Any, solver: Any) -> None:
    """Raise CapabilityError if an option makes the engine solve another problem."""
    config = solver.rigid_config
    coupler = type(scene.sim.coupler).__name__
    has_more_friction = config.enable_torsional_friction or config.enable_rolling_friction
    for is_used, name in (
        (
            solver._options.noslip_iterations > 0,
            "noslip_iterations changes impulses after the solve",
        ),
        (config.use_hibernation, "use_hibernation leaves bodies out of the problem"),
        (
            coupler != "LegacyCoupler" and coupler != "NoneType",
            f"the {coupler} solves additional contacts",
        ),
        (
            config.enable_signorini_contact and has_more_friction,
            "contact_resolution=signorini with torsional or rolling friction is another friction law",
        ),
    ):
        if is_used:
            raise CapabilityError(
                f"{name}, which is not supported: change this setting of the scene"
            )


def copy_to_host(array: Any, rows: int | None = None) -> Any:
    """Copy the first `rows` rows of an engine's array to host memory, in the array's logical order of dimensions."""
    from genesis.utils.misc import qd_to_torch

    tensor = qd_to_torch(array, copy=None)
    return np.array((tensor if rows is None else tensor[:rows]).cpu().numpy())
