"""Read the next step of a MuJoCo simulation as a `StepRecord`.

    record = lavender.io.step_from_mujoco(model, data)          # `data` is not changed

Copies of the data run `mj_forward` and `mj_step`. The matrix that the integrator adds to M is found by running the
integrator with unit forces, or from MuJoCo's own arrays with "discrete".
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import sparse as sp
from lavender.io import mujoco as single
from lavender.io.impedance import compute_compliance, compute_reference
from lavender.io.mujoco_discrete import compute_discrete_matrix
from lavender.io.mujoco_memory import (
    CHANGED_ADVICE,
    OTHER_MODEL_ADVICE,
    import_mujoco,
    read_step,
)
from lavender.io.start_states import without_sleep
from lavender.io.step_record import ConstraintBlock, GeomSettings, Softness, StepRecord

EQUALITY, FRICTION_DOF, FRICTION_TENDON, LIMIT_JOINT, LIMIT_TENDON = range(5)
PYRAMIDAL = 6  # Values of mjtConstraint: 5 is a contact without friction, 7 an elliptic one.
# [-] Largest relative difference of a reference or compliance from the impedance model, above which the rows are stored
# as numbers. Both are sums and products of a few numbers.
MODEL_TOLERANCE = 1e-9
SMALL_ENTRY = (
    1e-12  # [-] Entries of H below this part of the largest mass are rounding of an inverse.
)
EQUALITY_ROWS = 6  # Most rows of an equality: a weld.
ROTATIONS = (1, 3)  # Values of mjtJoint: ball and hinge.


def step_from_mujoco(model: Any, data: Any, *, engine: str | None = None) -> StepRecord:
    """Return the step that MuJoCo will do next from a state.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        With the state before the step, its controls and its warm start. It is not changed.
    engine : str, optional
        Name of the engine in sentences; default "MuJoCo" with its version.

    Returns
    -------
    StepRecord

    Raises
    ------
    InputError
        The arguments are not a model and its data, the data belong to another model, or the model has no velocities.
    CapabilityError
        The integrator is RK4, which solves the constraints four times in a step; or the simulation diverges.
    """
    mj = import_mujoco()
    if not isinstance(model, mj.MjModel) or not isinstance(data, mj.MjData):
        raise InputError(
            f"model and data are {type(model).__name__} and {type(data).__name__}; mujoco.MjModel and "
            "mujoco.MjData are needed"
        )
    if model.nv == 0:
        raise InputError("the model has no joints, so a step changes no velocity")
    if int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_RK4):
        raise CapabilityError(
            "integrator RK4 solves the constraints four times in each step, so that one step has no causes: compare "
            "with another integrator"
        )
    read_step(model, data)  # Data of another size are refused.
    try:
        reader = StepReader(mj, without_sleep(mj, model), data)
    except mj.FatalError as error:
        raise InputError(
            f"data do not belong to the model ({error}). {OTHER_MODEL_ADVICE}"
        ) from None
    return reader.read(engine or f"MuJoCo {mj.__version__}")


@dataclass
class _Rows:
    """A block and the rows of MuJoCo that belong to it."""

    block: ConstraintBlock
    rows: IntArray


class StepReader:
    """One model and the state before its step.

    `data` has the arrays of the step, and `host` is the MjData of the same positions.
    """

    # [-] Largest relative difference of R and of references from the impedance model.
    tolerance = MODEL_TOLERANCE
    precision = "float64"

    def __init__(self, mj: Any, model: Any, data: Any) -> None:
        self.mj, self.model = mj, model
        self.start = data
        self.data = self.copy(data)
        mj.mj_forward(model, self.data)
        self.host = self.data
        if not np.isfinite(self.data.qacc).all():
            raise CapabilityError(single.DIVERGED_TEXT)
        self.is_discrete = read_step(model, self.data).is_discrete
        self.jacobian = single.jacobian(model, self.data).toarray()
        self.name_elements()

    def name_elements(self) -> None:
        """Find the names of bodies, geoms and joints."""
        model = self.model
        self.dt, self.nv = float(model.opt.timestep), int(model.nv)
        self.joints, self.bodies = name_bodies_and_joints(model)
        self.geoms = [model.geom(i).name or str(i) for i in range(model.ngeom)]
        self.geom_keys = [model.geom(i).name for i in range(model.ngeom)]
        for i in range(model.ngeom):
            b = model.geom_bodyid[i]
            place = i - model.body_geomadr[b]
            self.geom_keys[i] = self.geom_keys[i] or f"geom {place} of {self.bodies[b]}"

    def copy(self, data: Any) -> Any:
        """Return a copy of the data."""
        result = self.mj.MjData(self.model)
        self.mj.mj_copyData(result, self.model, data)
        return result

    def read(self, engine: str) -> StepRecord:
        """Build the record."""
        mj, model, data = self.mj, self.model, self.data
        after = self.copy(self.start)  # With the same warm start.
        mj.mj_step(model, after)
        moved_by = single.find_mover_of_step(read_step(model, data), False)
        return self.build(engine, np.array(after.qvel), moved_by)

    def build(self, engine: str, velocity_after: FloatArray, moved_by: str) -> StepRecord:
        """Build the record of a step with a known result."""
        mj, model, data, dt, nv = self.mj, self.model, self.data, self.dt, self.nv
        mass = self.read_mass()
        smooth = np.array(data.qfrc_smooth)
        integrator_force = np.zeros(nv)
        if self.is_discrete:
            matrix = compute_discrete_matrix(mj, model, data, CHANGED_ADVICE)
            indptr, indices, values = matrix.lower
            lower = sp.csr_array((values, indices, indptr), shape=(nv, nv)).toarray()
            whole = lower + np.tril(lower, -1).T
            change = 0.0 if matrix.change is None else matrix.change
            # The integrator turns free bodies without constraints by implicit gyroscopic forces.
            response = np.linalg.solve(whole, self.jacobian.T)
            is_free = ~response.any(axis=1)
            free = np.where(is_free, data.qacc, data.qacc_smooth + change)
            integrator_force = whole @ free - smooth
            added = whole - mass
        else:
            added = self.measure_added_matrix(mass)
        added[np.abs(added) < SMALL_ENTRY * np.abs(mass).max()] = 0.0
        damping, actuators = self.read_damping(), self.read_actuator_matrix()
        is_euler = int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_EULER)
        bits = mj.mjtDisableBit
        is_damped = not int(model.opt.disableflags) & int(bits.mjDSBL_EULERDAMP)
        uses_damping, uses_actuators = not is_euler or is_damped, not is_euler
        stiffness = self.read_stiffness()
        fluid = self.read_fluid(mass, added)
        rest = added - dt * (uses_damping * damping + uses_actuators * (actuators + fluid))
        turning = self.read_coriolis_matrix()
        uses_coriolis = self.find_used_coriolis(rest, dt * turning)
        if uses_coriolis is not None:
            rest -= dt * np.where(uses_coriolis, turning, 0.0)
        if self.is_discrete:
            rest -= dt**2 * stiffness
            integrator_force += dt * stiffness @ data.qvel
        rest[np.abs(rest) < SMALL_ENTRY * np.abs(mass).max()] = 0.0
        gravity_map, gravity = self.read_gravity()
        damping_force, fluid_force = np.array(data.qfrc_damper), np.array(self.host.qfrc_fluid)
        actuator_force = np.array(data.qfrc_actuator) - self.read_compensation()
        coriolis = np.array(data.qfrc_bias) + self.bias_map @ gravity
        force = (
            smooth
            - damping_force
            - fluid_force
            - actuator_force
            - (gravity_map @ gravity - coriolis)
        )
        groups = self.read_blocks(mass, added)
        names, angular = self.name_velocities()
        return StepRecord(
            engine=engine, dt=dt, velocity=np.array(data.qvel), velocity_after=velocity_after,
            mass=mass, coriolis=coriolis, gravity_map=gravity_map, gravity=gravity, force=force,
            damping_matrix=damping, damping_force=damping_force, actuator_matrix=actuators,
            actuator_force=actuator_force, integrator_matrix=rest, integrator_force=integrator_force,
            stiffness_matrix=stiffness, uses_stiffness=self.is_discrete,
            uses_damping=uses_damping, uses_actuators=uses_actuators, in_problem=self.is_discrete,
            fluid=self.list_fluid(), fluid_force=fluid_force, fluid_matrix=fluid, uses_fluid=not is_euler,
            coriolis_matrix=turning, uses_coriolis=uses_coriolis, reference_position=np.array(model.qpos0),
            implicit_rows=self.is_discrete, blocks=tuple(g.block for g in groups), law="cone",
            names=names, angular=angular, position=np.array(data.qpos), position_owner=self.find_position_owner(),
            acceleration=np.array(data.qacc), moved_by=moved_by,
            before_noslip=self.read_forces_before_noslip(groups), weights=self.read_weights(),
            softnesses=self.read_softnesses(), geom_settings=self.read_geom_settings(), settings=self.read_settings(),
            precision=self.precision,
        )  # fmt: skip

    def find_position_owner(self) -> IntArray:
        """Return the first velocity of the joint of each position (nq,)."""
        model = self.model
        counts = np.diff(np.append(model.jnt_qposadr, model.nq))
        return np.repeat(model.jnt_dofadr, counts).astype(np.int64)

    def read_mass(self) -> FloatArray:
        """Return M (nv, nv)."""
        return read_mass(self.mj, self.model, self.data)

    def measure_added_matrix(self, mass: FloatArray) -> FloatArray:
        """Return H (nv, nv): columns of (M + H)^-1 by the engine's own integrator, from unit forces."""
        mj, model = self.mj, self.model
        is_euler = int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_EULER)
        advance = mj.mj_Euler if is_euler else mj.mj_implicit
        inverse = np.empty((self.nv, self.nv))
        scratch = self.mj.MjData(model)
        accelerations = np.linalg.inv(mass)
        for i in range(self.nv):
            mj.mj_copyData(scratch, model, self.host)
            scratch.qfrc_constraint[:] = 0.0
            scratch.qfrc_constraint[i] = 1.0
            scratch.qfrc_smooth[:] = 0.0
            scratch.qacc[:] = accelerations[:, i]
            advance(model, scratch)
            inverse[:, i] = (scratch.qvel - self.host.qvel) / self.dt
        return np.linalg.inv(inverse) - mass

    def read_fluid(self, mass: FloatArray, added: FloatArray) -> FloatArray:
        """Return minus the derivative of the forces of a fluid by the velocity (nv, nv) [N s/m, N m s].

        It is the part of H that leaves without the fluid. Euler's method, which does not use it, has the one of
        implicitfast.
        """
        mj, option = self.mj, self.model.opt
        if not (option.viscosity or option.density):
            return np.zeros((self.nv, self.nv))
        if self.is_discrete:
            fluid = self.host.efm_fluid
            matrix = np.zeros((self.nv, self.nv))
            if len(fluid):
                rows = np.repeat(np.arange(self.nv), self.model.M_rownnz)
                matrix[rows, self.model.M_colind] = fluid
            return (matrix + np.tril(matrix, -1).T) / self.dt
        own, known = self.model, (int(option.integrator), added)
        self.model = copy.copy(own)
        try:
            if known[0] == int(mj.mjtIntegrator.mjINT_EULER):
                self.model.opt.integrator = int(mj.mjtIntegrator.mjINT_IMPLICITFAST)
                known = (0, self.measure_added_matrix(mass))
            self.model.opt.viscosity = self.model.opt.density = 0.0
            return (known[1] - self.measure_added_matrix(mass)) / self.dt
        finally:
            self.model = own

    def list_fluid(self) -> FloatArray:
        """Return what a user sets for a fluid: its numbers, and the shapes that replace inertias."""
        model, option = self.model, self.model.opt
        shaped = model.geom_fluid[:, 0] > 0.0
        return np.concatenate([
            [option.density, option.viscosity], option.wind, model.geom_fluid[shaped].ravel(),
            model.geom_size[shaped].ravel(), np.flatnonzero(shaped),
        ])  # fmt: skip

    def read_coriolis_matrix(self) -> FloatArray:
        """Return the derivative of the Coriolis and gyroscopic forces by the velocity (nv, nv) [N s/m, N m s].

        They are quadratic in the velocity, so that central differences have no error but rounding.
        """
        mj, model = self.mj, self.model
        scratch = mj.MjData(model)
        mj.mj_copyData(scratch, model, self.host)
        forces = np.empty((2, self.nv))
        matrix = np.empty((self.nv, self.nv))
        for i in range(self.nv):
            for row, side in zip(forces, (1.0, -1.0), strict=True):
                scratch.qvel[:] = self.host.qvel
                scratch.qvel[i] += side
                mj.mj_comVel(model, scratch)
                mj.mj_rne(model, scratch, 0, row)
            matrix[:, i] = 0.5 * (forces[0] - forces[1])
        return matrix

    def find_used_coriolis(self, rest: FloatArray, terms: FloatArray) -> np.ndarray | None:
        """Return which entries (nv, nv) of H contain Coriolis terms: all, or only those of free bodies."""
        kinds, model = self.mj.mjtIntegrator, self.model
        kind = int(model.opt.integrator)
        used = np.full((self.nv, self.nv), kind == int(kinds.mjINT_IMPLICIT))
        if kind == int(kinds.mjINT_IMPLICITFAST):
            counts = np.bincount(model.dof_treeid)
            for dof in model.jnt_dofadr[model.jnt_type == int(self.mj.mjtJoint.mjJNT_FREE)]:
                if counts[model.dof_treeid[dof]] == 6:
                    used[dof : dof + 6, dof : dof + 6] = True
        own = np.where(used, terms, 0.0)
        # Older versions leave those of free bodies out.
        is_used = np.abs(np.where(used, rest, 0.0) - own).max() <= 1e-6 * np.abs(own).max()
        return used if used.any() and is_used else None

    def read_compensation(self) -> FloatArray:
        """Return the part of the actuators' forces (nv,) that compensates gravity, which belongs to the masses."""
        by_actuators = self.model.jnt_actgravcomp[self.model.dof_jntid].astype(bool)
        return np.where(by_actuators, self.host.qfrc_gravcomp, 0.0)

    def read_damping(self) -> FloatArray:
        """Return the damping matrix (nv, nv) of joints and tendons [N s/m, N m s]."""
        model, bits = self.model, self.mj.mjtDisableBit
        off = int(getattr(bits, "mjDSBL_DAMPER", getattr(bits, "mjDSBL_PASSIVE", 0)))
        if int(model.opt.disableflags) & off:
            return np.zeros((self.nv, self.nv))
        matrix = np.diag(np.array(model.dof_damping, float))
        tendons = np.flatnonzero(model.tendon_damping)
        if len(tendons):
            rows = self.read_tendon_jacobian()
            for i in tendons:
                matrix += model.tendon_damping[i] * np.outer(rows[i], rows[i])
        return matrix

    def read_stiffness(self) -> FloatArray:
        """Return the stiffness matrix (nv, nv) of the springs of joints and stretched tendons [N/m, N m].

        Ball and free joints have the stiffness on each of their velocities, as in MuJoCo's "discrete".
        """
        model, bits = self.model, self.mj.mjtDisableBit
        off = int(getattr(bits, "mjDSBL_SPRING", getattr(bits, "mjDSBL_PASSIVE", 0)))
        if int(model.opt.disableflags) & off:
            return np.zeros((self.nv, self.nv))
        stiffness = np.array(model.jnt_stiffness, float).reshape(model.njnt, -1)[:, 0]
        matrix = np.diag(stiffness[model.dof_jntid])
        springs = np.flatnonzero(model.tendon_stiffness)
        rows = self.read_tendon_jacobian() if len(springs) else matrix
        for i in springs:
            low, high = model.tendon_lengthspring[i]
            if not low <= self.host.ten_length[i] <= high:
                matrix += model.tendon_stiffness[i] * np.outer(rows[i], rows[i])
        return matrix

    def read_tendon_jacobian(self) -> FloatArray:
        """Return the Jacobian of tendon lengths (ntendon, nv)."""
        model, data = self.model, self.host
        values = np.ravel(data.ten_J)
        if len(values) == model.ntendon * self.nv:
            return values.reshape(model.ntendon, self.nv)
        owner = model if hasattr(model, "ten_J_rowadr") else data
        result = np.zeros((model.ntendon, self.nv))
        for i in range(model.ntendon):
            entries = slice(owner.ten_J_rowadr[i], owner.ten_J_rowadr[i] + owner.ten_J_rownnz[i])
            result[i, np.ravel(owner.ten_J_colind)[entries]] = values[entries]
        return result

    def read_actuator_matrix(self) -> FloatArray:
        """Return minus the derivative of actuator forces by the velocity (nv, nv), for affine gains and biases."""
        model, data = self.model, self.host
        if not model.nu:
            return np.zeros((self.nv, self.nv))
        moment = np.zeros((len(data.moment_rownnz), self.nv))
        for i in range(len(moment)):
            first = data.moment_rowadr[i]
            entries = slice(first, first + data.moment_rownnz[i])
            moment[i, data.moment_colind[entries]] = data.actuator_moment[entries]
        if len(moment) != model.nu:
            return np.zeros((self.nv, self.nv))
        affine = model.actuator_biastype == int(self.mj.mjtBias.mjBIAS_AFFINE)
        rate = np.where(affine, model.actuator_biasprm[:, 2], 0.0)
        affine = model.actuator_gaintype == int(self.mj.mjtGain.mjGAIN_AFFINE)
        control = np.array(data.ctrl)
        rate = rate + np.where(affine, model.actuator_gainprm[:, 2] * control, 0.0)
        result: FloatArray = -(moment.T * rate) @ moment
        return result

    def read_gravity(self) -> tuple[FloatArray, FloatArray]:
        """Return the force per gravitational acceleration (nv, 3) and the acceleration (3,)."""
        mj, model, data = self.mj, self.model, self.host
        per_body = np.zeros((3, self.nv))
        mj.mj_jacSubtreeCom(model, data, per_body, 0)
        total = float(model.body_mass.sum())
        result = total * per_body.T
        self.bias_map = result.copy()
        for b in np.flatnonzero(model.body_gravcomp):
            mj.mj_jacBodyCom(model, data, per_body, None, int(b))
            result -= model.body_gravcomp[b] * model.body_mass[b] * per_body.T
        is_off = int(model.opt.disableflags) & int(mj.mjtDisableBit.mjDSBL_GRAVITY)
        gravity = np.zeros(3) if is_off else np.array(model.opt.gravity)
        return result, gravity

    def name_velocities(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Return the names of the velocities, and which are in rad/s."""
        model = self.model
        names: list[str] = []
        angular = np.zeros(self.nv, bool)
        for k in range(self.nv):
            j = int(model.dof_jntid[k])
            place = k - int(model.jnt_dofadr[j])
            kind = int(model.jnt_type[j])
            suffix = (
                f" {('x', 'y', 'z', 'rx', 'ry', 'rz')[place + 3 * (kind == 1)]}" if kind < 2 else ""
            )
            owner = self.joints[j]
            if kind == 0 and not model.joint(j).name:
                owner = self.bodies[int(model.jnt_bodyid[j])]
            names.append(owner + suffix)
            angular[k] = kind in ROTATIONS or (kind == 0 and place >= 3)
        return tuple(names), angular

    def read_weights(self) -> dict[str, float | FloatArray]:
        """Return the inverse masses of bodies, of equalities, and of limits and dry friction of joints and tendons."""
        model = self.model
        weights: dict[str, float | FloatArray] = {
            n: float(model.body_invweight0[i][0]) for i, n in enumerate(self.bodies)
        }
        for j in range(model.njnt):
            first = float(model.dof_invweight0[model.jnt_dofadr[j]])
            weights |= dict.fromkeys(self.make_limit_keys(j), first)
        for k in range(self.nv):
            weights[self.make_friction_key(k)] = float(model.dof_invweight0[k])
        for i in range(model.ntendon):
            weight = float(model.tendon_invweight0[i])
            weights |= dict.fromkeys(self.make_tendon_keys(i), weight)
        for i in range(model.neq):
            weights[self.make_equality_key(i)] = self.weigh_equality(i, EQUALITY_ROWS)
        return weights

    def make_limit_keys(self, j: int) -> list[str]:
        """Return the keys of the limits of a joint."""
        if int(self.model.jnt_type[j]) in (0, 1):
            return [f"limit of {self.joints[j]}"]
        return [f"{side} limit of {self.joints[j]}" for side in ("lower", "upper")]

    def make_friction_key(self, dof: int) -> str:
        """Return the key of the dry friction of a velocity."""
        j = int(self.model.dof_jntid[dof])
        place = dof - int(self.model.jnt_dofadr[j])
        return f"dry friction of {self.joints[j]}" + (
            f" {place}" if self.model.jnt_type[j] < 2 else ""
        )

    def make_tendon_keys(self, i: int) -> list[str]:
        """Return the keys of friction and limits of a tendon."""
        name = _name(self.model.tendon(i), "tendon", i)
        return [f"dry friction of {name}", f"lower limit of {name}", f"upper limit of {name}"]

    def read_softnesses(self) -> dict[str, Softness]:
        """Return the softness of all constraints that may be active, but for contacts."""
        model = self.model
        result: dict[str, Softness] = {}
        for j in range(model.njnt):
            own = self.make_softness(model.jnt_solref[j], model.jnt_solimp[j])
            result |= dict.fromkeys(self.make_limit_keys(j), own)
        for k in range(self.nv):
            own = self.make_softness(model.dof_solref[k], model.dof_solimp[k])
            result[self.make_friction_key(k)] = own
        for i in range(model.ntendon):
            friction, *limits = self.make_tendon_keys(i)
            result[friction] = self.make_softness(
                model.tendon_solref_fri[i], model.tendon_solimp_fri[i]
            )
            own = self.make_softness(model.tendon_solref_lim[i], model.tendon_solimp_lim[i])
            result |= dict.fromkeys(limits, own)
        for i in range(model.neq):
            own = self.make_softness(model.eq_solref[i], model.eq_solimp[i])
            result.setdefault(self.make_equality_key(i), own)
        return result

    def read_geom_settings(self) -> dict[str, GeomSettings]:
        """Return the contact settings of geoms or of the override; none if pairs of geoms have their own."""
        model = self.model
        if model.npair:
            return {}
        friction = np.array(model.geom_friction)[:, [0, 0, 1, 2, 2]]
        softnesses = [
            self.make_softness(*x) for x in zip(model.geom_solref, model.geom_solimp, strict=True)
        ]
        if int(model.opt.enableflags) & int(self.mj.mjtEnableBit.mjENBL_OVERRIDE):
            option = model.opt
            own = self.make_softness(option.o_solref, option.o_solimp, option.o_solref)
            softnesses = [own] * model.ngeom
            friction[:] = option.o_friction
        friction = np.maximum(friction, self.mj.mjMINMU)
        return {
            name: GeomSettings(
                int(model.geom_condim[i]), int(model.geom_priority[i]), float(model.geom_solmix[i]),
                friction[i], softnesses[i],
            )
            for i, name in enumerate(self.geom_keys)
        }  # fmt: skip

    def make_softness(self, solref: Any, solimp: Any, friction: Any = (0.0, 0.0)) -> Softness:
        """Return the softness of a row."""
        off = int(self.model.opt.disableflags) & int(self.mj.mjtDisableBit.mjDSBL_REFSAFE)
        return Softness(
            "impedance", np.array(solref, float), np.array(friction, float), np.array(solimp, float),
            float(self.model.opt.impratio), 0.0 if off else 2.0 * self.dt,
        )  # fmt: skip

    def read_settings(self) -> dict[str, Any]:
        """Return the options by the names of MJCF."""
        model, mj = self.model, self.mj
        option = model.opt
        kinds = {"integrator": mj.mjtIntegrator, "cone": mj.mjtCone, "solver": mj.mjtSolver}
        settings: dict[str, Any] = {"family": "mujoco"}
        for name, kind in kinds.items():
            word = kind(int(getattr(option, name))).name.partition("_")[2]
            settings[name] = (
                word if name == "solver" else "Euler" if word == "EULER" else word.lower()
            )
        for name in ("impratio", "tolerance"):
            settings[name] = float(getattr(option, name))
        for name in ("iterations", "noslip_iterations"):
            settings[name] = int(getattr(option, name))
        settings["control"] = tuple(map(float, self.host.ctrl))
        settings["activation"] = tuple(map(float, self.host.act))
        return settings

    def read_blocks(self, mass: FloatArray, added: FloatArray) -> list[_Rows]:
        """Return the blocks of all constraint rows."""
        groups: list[_Rows] = []
        for kind, which, rows in self.list_rows():
            group = self.read_contact(rows) if kind >= 5 else self.read_joint(rows, kind, which)
            groups.append(self.check(group, mass, added))
        return groups

    def list_rows(self) -> Iterator[tuple[int, int, IntArray]]:
        """Yield each constraint's kind (mjtConstraint), its number among those of this kind, and its rows."""
        data = self.data
        i = 0
        while i < data.nefc:
            kind, which = int(data.efc_type[i]), int(data.efc_id[i])
            is_alike = (data.efc_type == kind) & (data.efc_id == which)
            size = 1
            if kind == EQUALITY or kind >= 5:
                different = np.flatnonzero(~is_alike[i:])
                size = int(different[0]) if len(different) else data.nefc - i
            yield kind, which, np.arange(i, i + size, dtype=np.int32)
            i += size

    def read_joint(self, rows: IntArray, kind: int, which: int) -> _Rows:
        """Return the block of an equality, a limit or dry friction."""
        model, data = self.model, self.data
        jac = self.jacobian[rows]
        weight, position = np.full(len(rows), np.nan), np.zeros(3)
        if kind == EQUALITY:
            key, position = self.make_equality_key(which), self.place_equality(which)
            softness = self.make_softness(model.eq_solref[which], model.eq_solimp[which])
            weight = self.weigh_equality(which, len(rows))
        elif kind == FRICTION_DOF:
            key = self.make_friction_key(which)
            softness = self.make_softness(model.dof_solref[which], model.dof_solimp[which])
            weight[:] = model.dof_invweight0[which]
        elif kind == LIMIT_JOINT:
            keys = self.make_limit_keys(which)
            is_upper = jac[0, model.jnt_dofadr[which]] < 0.0
            key = keys[int(is_upper)] if len(keys) > 1 else keys[0]
            softness = self.make_softness(model.jnt_solref[which], model.jnt_solimp[which])
            weight[:] = model.dof_invweight0[model.jnt_dofadr[which]]
        else:
            friction, lower, upper = self.make_tendon_keys(which)
            if kind == FRICTION_TENDON:
                key = friction
                values = model.tendon_solref_fri, model.tendon_solimp_fri
            else:
                is_upper = data.efc_pos[rows[0]] == (
                    model.tendon_range[which][1] - self.host.ten_length[which]
                )
                key = upper if is_upper else lower
                values = model.tendon_solref_lim, model.tendon_solimp_lim
            softness = self.make_softness(values[0][which], values[1][which])
            weight[:] = model.tendon_invweight0[which]
        role = {EQUALITY: "equality", FRICTION_DOF: "friction", FRICTION_TENDON: "friction"}.get(
            kind, "limit"
        )
        gap = np.array(data.efc_pos[rows] - data.efc_margin[rows])
        block = ConstraintBlock(
            key, role, jac, gap, weight, softness, margin=float(data.efc_margin[rows[0]]),
            loss=float(data.efc_frictionloss[rows[0]]), force=np.array(data.efc_force[rows]), position=position,
        )  # fmt: skip
        return _Rows(block, rows)

    def make_equality_key(self, i: int) -> str:
        """Return the key of an equality: its name, or its kind and what it connects, which no other one changes."""
        mj, model = self.mj, self.model
        if model.equality(i).name:
            return f"equality {model.equality(i).name}"
        kind = mj.mjtEq(int(model.eq_type[i])).name.partition("_")[2].lower()
        types = {int(mj.mjtObj.mjOBJ_SITE): "site", int(mj.mjtObj.mjOBJ_TENDON): "tendon",
                 int(mj.mjtObj.mjOBJ_FLEX): "flex"}  # fmt: skip
        known = {int(mj.mjtObj.mjOBJ_BODY): self.bodies, int(mj.mjtObj.mjOBJ_JOINT): self.joints}
        object_type = int(model.eq_objtype[i])
        if kind == "joint":  # Engines that make such a model themselves may leave the type out.
            object_type = int(mj.mjtObj.mjOBJ_JOINT)
        names = []
        for number in (int(model.eq_obj1id[i]), int(model.eq_obj2id[i])):
            if number >= 0 and object_type in known:
                names.append(known[object_type][number])
            elif number >= 0:
                word = types.get(object_type, "object")
                name = mj.mj_id2name(model, object_type, number)
                names.append(name or f"{word} {number}")
        return f"equality {kind} between {' and '.join(names)}"

    def place_equality(self, i: int) -> FloatArray:
        """Return the position of an equality (3,) [m], by which those of the same bodies are matched."""
        mj, model, data = self.mj, self.model, self.host
        kinds = int(mj.mjtEq.mjEQ_CONNECT), int(mj.mjtEq.mjEQ_WELD)
        first = int(model.eq_obj1id[i])
        if int(model.eq_type[i]) not in kinds:
            return np.zeros(3)
        if int(model.eq_objtype[i]) == int(mj.mjtObj.mjOBJ_SITE):
            return np.array(data.site_xpos[first])
        frame = np.array(data.xmat[first]).reshape(3, 3)
        place: FloatArray = data.xpos[first] + frame @ model.eq_data[i, :3]
        return place

    def weigh_equality(self, which: int, count: int) -> FloatArray:
        """Return the inverse masses (count,) of the rows of an equality; nan if the kind is not known here."""
        mj, model = self.mj, self.model
        kind = int(model.eq_type[which])
        pair = [int(model.eq_obj1id[which]), int(model.eq_obj2id[which])]
        if kind in (int(mj.mjtEq.mjEQ_CONNECT), int(mj.mjtEq.mjEQ_WELD)):
            if int(model.eq_objtype[which]) == int(mj.mjtObj.mjOBJ_SITE):
                pair = [int(model.site_bodyid[i]) for i in pair]
            translation, rotation = model.body_invweight0[pair].sum(axis=0)
            return np.where(np.arange(count) < 3, translation, rotation)
        if kind == int(mj.mjtEq.mjEQ_JOINT):
            return np.full(count, sum(
                float(model.dof_invweight0[model.jnt_dofadr[i]]) for i in pair if i >= 0
            ))  # fmt: skip
        if kind == int(mj.mjtEq.mjEQ_TENDON):
            return np.full(count, sum(float(model.tendon_invweight0[i]) for i in pair if i >= 0))
        return np.full(count, np.nan)

    def read_contact(self, rows: IntArray) -> _Rows:
        """Return the block of a contact."""
        model, data = self.model, self.data
        contact = data.contact[int(data.efc_id[rows[0]])]
        condim = int(contact.dim)
        is_pyramid = int(data.efc_type[rows[0]]) == PYRAMIDAL
        numbers = [int(g) for g in contact.geom]
        friction = np.array(contact.friction)
        if min(numbers) >= 0:
            pair = [int(model.geom_bodyid[g]) for g in numbers]
            jac = self.compute_contact_jacobian(contact, pair)
            geoms, keys, bodies = (
                tuple(names[i] for i in ids)
                for names, ids in (
                    (self.geoms, numbers), (self.geom_keys, numbers), (self.bodies, pair),
                )
            )  # fmt: skip
            weight = np.array([model.body_invweight0[pair, 0].sum()])
        else:  # A flex, whose vertices are bodies: the engine's own rows.
            jac, geoms, keys, bodies = self.jacobian[rows], (), (), ("flex", "flex")
            if is_pyramid:
                plus, minus = jac[0::2], jac[1::2]
                mu = friction[: condim - 1, None]
                jac = np.vstack([(plus + minus).mean(axis=0) / 2.0, (plus - minus) / (2.0 * mu)])
            weight = np.array([np.nan])
        surface = np.zeros(len(jac))
        if getattr(model, "flg_surfacevel", False):
            moving = self.jacobian[rows] @ data.qvel - data.efc_vel[rows]
            if is_pyramid:
                surface[1:condim] = (moving[0::2] - moving[1::2]) / (2.0 * friction[: condim - 1])
            else:
                surface[:condim] = moving
        block = ConstraintBlock(
            f"contact of {' and '.join(sorted(bodies))}", "contact", jac,
            np.array([float(data.efc_pos[rows[0]] - data.efc_margin[rows[0]])]), weight,
            self.make_softness(contact.solref, contact.solimp, contact.solreffriction),
            margin=float(data.efc_margin[rows[0]]),
            cone="" if condim == 1 else "pyramid" if is_pyramid else "ellipse", condim=condim,
            friction=friction, surface_velocity=surface,
            force=_gather_force(data.efc_force[rows], condim, is_pyramid, friction),
            geoms=geoms, geom_keys=keys, bodies=bodies, position=np.array(contact.pos),
        )  # fmt: skip
        return _Rows(block, rows)

    def compute_contact_jacobian(self, contact: Any, bodies: list[int]) -> FloatArray:
        """Return the rows of a contact (6, nv): normal, tangents, spin and rolling, second body minus first."""
        frame = np.array(contact.frame).reshape(3, 3)
        total = np.zeros((6, self.nv))
        part = np.zeros((6, self.nv))
        for sign, body in zip((-1.0, 1.0), bodies, strict=True):
            self.mj.mj_jac(self.model, self.host, part[:3], part[3:], np.array(contact.pos), body)
            total += sign * part
        return np.vstack([frame @ total[:3], frame @ total[3:]])

    def read_rates(
        self, block: ConstraintBlock, rows: IntArray, rates: FloatArray, springs: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the engine's own B [1/s], K d [1/s^2] and d [-] of rows; `rates` and `springs` are the model's."""
        own = self.data.efc_KBIP.reshape(-1, 4)[rows]
        return own[:, 1].copy(), own[:, 0] * own[:, 2], own[:, 2].copy()

    def check(self, group: _Rows, mass: FloatArray, added: FloatArray) -> _Rows:
        """Return the rows, with a softness of plain numbers if MuJoCo's arrays do not follow its impedance model."""
        data, block, rows = self.data, group.block, group.rows
        is_pyramid = block.has_friction and block.cone == "pyramid"
        count = block.condim if block.role == "contact" else len(rows)
        rates, springs = compute_reference(
            block, block.softness, block.softness, count, self.is_discrete
        )
        at = np.zeros(len(rows), int) if is_pyramid else np.arange(len(rows))
        rate, spring, impedance = self.read_rates(block, rows, rates[at], springs[at])
        fits = np.allclose(rate, rates[at], rtol=MODEL_TOLERANCE, atol=0.0)
        fits &= np.allclose(spring, springs[at], rtol=MODEL_TOLERANCE, atol=0.0)
        scale = np.ones(len(rows))
        if self.is_discrete:
            scale = 1.0 / (1.0 + self.dt * rates + self.dt**2 * springs)[at]
            jac = self.jacobian[rows]
            size = jac**2 @ (1.0 / np.diag(mass))
            whole = jac**2 @ (1.0 / np.diag(mass + added))
            ratio = np.where(size > 0.0, whole / np.where(size > 0.0, size, 1.0), 1.0)
            scale = scale * ratio
            if block.role == "contact":
                scale[:] = scale[0]
        if np.isnan(block.weight).any():
            d = impedance[0]
            weight = data.efc_R[rows] / scale * d / (1.0 - d)
            if block.role == "contact":
                mu = block.friction[0]
                factor = 2.0 * mu**2 / block.softness.impratio * (1.0 + mu**2)
                weight = weight[:1] / (factor if is_pyramid else 1.0)
            block = replace(block, weight=weight)
        cone = block.cone if block.has_friction else ""
        made = compute_compliance(
            block, block.softness, block.weight, block.friction[: max(block.condim - 1, 0)], cone
        )
        fits &= np.allclose(made * scale, data.efc_R[rows], rtol=self.tolerance, atol=1e-15)
        block = replace(block, bias=self.read_bias(block, rows, rate, spring))
        if not fits:
            block = replace(
                block, softness=self.copy_numbers(block, rows, scale, count, rate, spring)
            )
        return _Rows(block, rows)

    def read_bias(
        self, block: ConstraintBlock, rows: IntArray, rate: FloatArray, spring: FloatArray
    ) -> FloatArray | None:
        """Return the reference acceleration (k,) that does not follow from gap and velocity; None without it."""
        data, dt = self.data, self.dt
        if self.is_discrete:
            phi = 1.0 / (1.0 + dt * rate + dt**2 * spring)
            rate, spring = (rate + dt * spring) * phi, spring * phi
        else:
            phi = np.ones(len(rows))
        model = -rate * data.efc_vel[rows] - spring * (data.efc_pos[rows] - data.efc_margin[rows])
        bias = np.array(data.efc_aref[rows] - model) / phi
        size = np.abs(model) + np.abs(rate * data.efc_vel[rows])
        if (np.abs(bias) <= self.tolerance * np.maximum(size, size.max())).all():
            return None
        if block.has_friction and block.cone == "pyramid":
            halves = bias[0::2] - bias[1::2]
            return np.append(bias.mean(), halves / (2.0 * block.friction[: len(halves)]))
        return bias

    def copy_numbers(
        self,
        block: ConstraintBlock,
        rows: IntArray,
        scale: FloatArray,
        count: int,
        rate: FloatArray,
        spring: FloatArray,
    ) -> Softness:
        """Return a softness of MuJoCo's own numbers."""
        compliance = self.data.efc_R[rows] / scale
        if block.has_friction and block.cone == "pyramid":
            rate = np.full(count, rate[0])
            spring = np.append(spring[0], np.zeros(count - 1))
            compliance = np.full(count, compliance[0] / (2.0 * (count - 1)))
        return replace(
            block.softness, rule="rates", rate=rate, stiffness=spring, compliance=compliance
        )

    def read_forces_before_noslip(self, groups: list[_Rows]) -> tuple[FloatArray, ...] | None:
        """Return the forces of the blocks before MuJoCo's pass against slip; None without it."""
        if not self.model.opt.noslip_iterations or not self.data.nefc:
            return None
        without = copy.copy(self.model)
        without.opt.noslip_iterations = 0
        data = self.mj.MjData(without)
        self.mj.mj_copyData(data, without, self.data)
        self.mj.mj_forward(without, data)
        forces = data.efc_force
        return tuple(
            _gather_force(forces[g.rows], g.block.condim, g.block.cone == "pyramid", g.block.friction)
            if g.block.role == "contact" else np.array(forces[g.rows])
            for g in groups
        )  # fmt: skip


def _gather_force(
    force: FloatArray, condim: int, is_pyramid: bool, friction: FloatArray
) -> FloatArray:
    """Return the forces (condim,) along normal and tangents of a contact."""
    if not is_pyramid or condim == 1:
        return np.array(force)
    return np.append(force.sum(), friction[: condim - 1] * (force[0::2] - force[1::2]))


def read_mass(mj: Any, model: Any, data: Any) -> FloatArray:
    """Return M (nv, nv) of MuJoCo's data."""
    full = np.zeros((model.nv, model.nv))
    try:
        mj.mj_fullM(model, full, data.qM)
    except (TypeError, AttributeError):  # MuJoCo 4 stores M in compressed rows only.
        mj.mj_fullM(model, data, full)
    return full


def name_bodies_and_joints(model: Any) -> tuple[list[str], list[str]]:
    """Return names of joints and bodies. Without a name, they are known by their places, which few others change.

    A body without a name has the one of its first joint, or its number among the bodies of the same parent that have
    neither a name nor a joint with a name and the same number of joints. A joint has its number in the body.
    """
    joints = [model.joint(i).name for i in range(model.njnt)]
    bodies: list[str] = []
    counts: dict[tuple[str, int], int] = {}
    for b in range(model.nbody):
        name, first, count = (
            model.body(b).name,
            int(model.body_jntadr[b]),
            int(model.body_jntnum[b]),
        )
        if not name and count and joints[first]:
            name = f"body of {joints[first]}"
        if not name:
            parent = bodies[int(model.body_parentid[b])]
            place = counts[parent, count] = counts.get((parent, count), -1) + 1
            kind = "moving" if count else "fixed"
            name = f"{parent}/{kind} body {place}"
        bodies.append(name)
        for k in range(count):
            joints[first + k] = joints[first + k] or f"{name}/joint {k}"
    return joints, bodies


def _name(element: Any, kind: str, number: int) -> str:
    return element.name or f"{kind} {number}"


class ContactReader(StepReader):
    """Contacts of the forward passes of one MjData, without masses and softness: much cheaper than a whole step."""

    def __init__(self, mj: Any, model: Any, data: Any) -> None:
        self.mj, self.model = mj, model
        self.data = self.host = data
        self.name_elements()

    def read_contacts(self) -> list[ConstraintBlock]:
        """Return the blocks of the contacts after a forward pass; their softness is not checked."""
        needs_rows = bool(getattr(self.model, "flg_surfacevel", False)) or self.model.nflex > 0
        if needs_rows:
            self.jacobian = single.jacobian(self.model, self.data).toarray()
        return [self.read_contact(rows).block for kind, _, rows in self.list_rows() if kind >= 5]
