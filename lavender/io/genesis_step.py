"""Do one step of a Genesis scene, and return it as a `StepRecord`.

    record = lavender.io.step_from_genesis(scene)       # does scene.step()

The positions, the velocities and the kinematics are read before the step, all other arrays after it. Genesis assembles
MuJoCo's rows (`lavender.io.impedance`), and its integrators differ in where they put the dampings D and the actuators'
derivatives (both diagonal):

    approximate_implicitfast (default)     in the constraint problem, whose matrix is M + h D
    implicitfast, Euler                    outside, (M + h D) a = M qacc; Euler without the actuators

The integrators other than Euler turn free bodies without constraints by the implicit midpoint rule
(`StepRecord.velocity_change`). Velocities and positions have Genesis' order; `lavender.io.align_step` gives those of
another record.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, check_int
from lavender.base.errors import CapabilityError, InputError
from lavender.io.genesis import GENESIS_ADVICE, check_configuration, copy_to_host, find_solver
from lavender.io.impedance import compute_reference
from lavender.io.step_record import ConstraintBlock, GeomSettings, Softness, StepRecord

SMALLEST_COEFFICIENT = 1e-12  # [-] Edges of a pyramid with less friction have no tangents.
MIDPOINT_STEPS = 50  # Newton steps of the midpoint rule; five are needed.


def step_from_genesis(scene: Any, *, world: int = 0, engine: str | None = None) -> StepRecord:
    """Do the next step of a Genesis scene, and return it as a record.

    Parameters
    ----------
    scene : genesis.Scene
        Built, with rigid bodies. It is advanced by one step.
    world : int, default 0
        Environment whose step is returned.
    engine : str, optional
        Name of the engine in sentences; default "Genesis" with its version.

    Returns
    -------
    StepRecord
        Links and joints have Genesis' names, which are those of the file. External forces on links are part of
        `coriolis`.

    Raises
    ------
    InputError
        `scene` is not a built scene with rigid bodies, or has no such environment or no joints.
    CapabilityError
        The scene has several substeps or settings that `lavender.io.from_genesis` refuses; or attributes of this
        version are missing.
    """
    solver = find_solver(scene)
    check_configuration(scene, solver)
    if int(getattr(scene.sim, "substeps", 1)) != 1:
        raise CapabilityError(
            f"the scene has {scene.sim.substeps} substeps, of which only the last one can be read: set substeps=1 and "
            "a smaller dt"
        )
    try:
        reader = GenesisReader(scene, solver, check_int("world", world, 0))
        scene.step()
        return reader.build(engine or _name_engine())
    except AttributeError as error:
        raise CapabilityError(
            f"an attribute of this scene is missing: {error}. {GENESIS_ADVICE}"
        ) from None


def _name_engine() -> str:
    """Return the engine's name and version."""
    import genesis

    return f"Genesis {genesis.__version__}"


class GenesisReader:
    """One environment of a scene: the state before its step, and the record after it."""

    def __init__(self, scene: Any, solver: Any, world: int) -> None:
        self.scene, self.solver = scene, solver
        self.config, self.world = solver.rigid_config, world
        states = solver.dyn_state
        velocities = copy_to_host(states.dofs.vel)
        if not velocities.shape[0]:
            raise InputError("the scene has no joints, so a step changes no velocity")
        if world >= velocities.shape[1]:
            raise InputError(f"world is {world}; the scene has {velocities.shape[1]} environments")
        self.is_compatible = bool(self.config.enable_mujoco_compatibility)
        self.precision = "float32" if velocities.dtype == np.float32 else "float64"
        self.velocity = velocities[:, world].astype(float)
        self.nv, self.dt = len(self.velocity), float(solver.substep_dt)
        self.position = self.read(solver.rigid_info.qpos)
        if (
            not self.is_compatible
        ):  # In this mode the step itself updates the kinematics, before it moves.
            solver.update_forward_pos()
            self.read_kinematics()
        self.name_elements()

    def read(self, array: Any) -> FloatArray:
        """Return this environment's values of an array of states, whose environments are its second or last axis."""
        values = copy_to_host(array)
        taken = values[..., self.world] if values.ndim < 3 else values[:, self.world]
        return np.asarray(taken, float)

    def read_info(self, array: Any, is_batched: bool) -> FloatArray:
        """Return this environment's values of an array of constants."""
        values = np.asarray(copy_to_host(array), float)
        return values[:, self.world] if is_batched else values

    def read_dofs(self, name: str) -> FloatArray:
        """Return constants of the velocities."""
        return self.read_info(
            getattr(self.solver.dyn_info.dofs, name), bool(self.config.batch_dofs_info)
        )

    def name_elements(self) -> None:
        """Find the names of links, joints and velocities."""
        solver = self.solver
        self.links = {int(link.idx): link.name for link in solver.links}
        self.links[-1] = "world"
        for link in solver.links:
            if type(getattr(link.entity, "morph", None)).__name__ == "Plane":
                self.links[int(link.idx)] = "world"
        self.joints = [j for j in solver.joints if len(np.atleast_1d(j.dofs_idx))]
        self.names = [""] * self.nv
        self.angular = np.zeros(self.nv, bool)
        self.owner_of_dof: list[Any] = [None] * self.nv
        self.place_of_dof = np.zeros(self.nv, int)
        count = len(self.position)
        self.position_owner: IntArray = np.zeros(count, np.int64)
        self.is_free = np.zeros(self.nv, bool)
        for joint in self.joints:
            dofs = np.atleast_1d(joint.dofs_idx)
            kind = str(getattr(joint.type, "name", joint.type)).upper()
            self.position_owner[np.atleast_1d(joint.qs_idx)] = int(dofs[0])
            for place, dof in enumerate(map(int, dofs)):
                self.owner_of_dof[dof], self.place_of_dof[dof] = joint, place
                is_free = kind == "FREE"
                suffix = ""
                if is_free or kind == "SPHERICAL":
                    suffix = " " + ("x", "y", "z", "rx", "ry", "rz")[place + 3 * (not is_free)]
                self.names[dof] = joint.name + suffix
                self.is_free[dof] = is_free
                self.angular[dof] = kind in ("REVOLUTE", "SPHERICAL") or (is_free and place >= 3)

    def read_kinematics(self) -> None:
        """Read what depends on the poses before the step."""
        self.gravity_map = self.read_gravity_map()
        links = self.solver.dyn_state.links
        self.poses = self.read(links.pos), self.read(links.quat)

    def read_gravity_map(self) -> FloatArray:
        """Return the force per gravitational acceleration (nv, 3) from the axes of the velocities."""
        solver = self.solver
        states, batched = solver.dyn_state, bool(self.config.batch_links_info)
        mass = self.read_info(solver.dyn_info.links.inertial_mass, batched)
        axes, directions = self.read(states.dofs.cdof_ang), self.read(states.dofs.cdof_vel)
        centres = self.read(states.links.i_pos)
        lightened = np.asarray(copy_to_host(solver.dyn_info.entities.gravity_compensation), float)
        entities = self.read_info(solver.dyn_info.links.entity_idx, batched).astype(int)
        parents = {int(link.idx): int(link.parent_idx) for link in solver.links}
        dofs_of = {int(link.idx): link for link in solver.links}
        result = np.zeros((self.nv, 3))
        for link in solver.links:
            i = int(link.idx)
            weight = mass[i] * (1.0 - float(np.ravel(lightened[entities[i]])[0]))
            at = i
            while at >= 0:
                first = int(dofs_of[at].dof_start)
                for dof in range(first, first + int(dofs_of[at].n_dofs)):
                    result[dof] += weight * (directions[dof] + np.cross(axes[dof], centres[i]))
                at = parents[at]
        return result

    def build(self, engine: str) -> StepRecord:
        """Return the record, after the step."""
        from genesis import integrator as kinds

        solver, dt, nv = self.solver, self.dt, self.nv
        if self.is_compatible:
            self.read_kinematics()
        dofs, kind = solver.dyn_state.dofs, self.config.integrator
        mass = np.asarray(copy_to_host(solver.rigid_info.mass_mat)[:, :, self.world], float)
        mass = np.tril(mass) + np.tril(mass, -1).T
        in_problem = bool(kind == kinds.approximate_implicitfast)
        uses_actuators = bool(kind != kinds.Euler)
        damping = self.read_dofs("damping")
        mode = self.read(dofs.ctrl_mode)
        rate = np.where(mode <= self.read_velocity_mode(), -self.read_dofs("act_bias")[..., 2], 0.0)
        added = dt * (damping + uses_actuators * rate)
        if in_problem:
            mass = mass - np.diag(added)
        bias, smooth = self.read(dofs.qf_bias), self.read(dofs.qf_smooth)
        gravity = np.asarray(copy_to_host(solver.rigid_info.gravity), float)[self.world]
        coriolis = bias + self.gravity_map @ gravity
        damping_force, actuator_force = -damping * self.velocity, self.read(dofs.qf_applied)
        force = smooth - damping_force - actuator_force + bias
        stiffness = np.where(self.is_free, 0.0, self.read_dofs("stiffness"))
        constraints = solver.constraint_solver.constraint_state
        accelerations = self.read(constraints.qacc)
        is_moved_by_forces = self.is_compatible and kind == kinds.implicitfast
        zero = np.zeros((nv, nv))
        return StepRecord(
            engine=engine, dt=dt, velocity=self.velocity, velocity_after=self.read(dofs.vel),
            mass=mass, coriolis=coriolis, gravity_map=self.gravity_map, gravity=gravity, force=force,
            damping_matrix=np.diag(damping), damping_force=damping_force, actuator_matrix=np.diag(rate),
            actuator_force=actuator_force, integrator_matrix=zero, integrator_force=np.zeros(nv),
            stiffness_matrix=np.diag(stiffness), uses_stiffness=False, uses_damping=True,
            uses_actuators=uses_actuators, in_problem=in_problem, implicit_rows=False,
            blocks=tuple(self.read_blocks()),
            law="coulomb" if self.config.enable_signorini_contact else "cone",
            names=tuple(self.names), angular=self.angular, position=self.position,
            position_owner=self.position_owner, acceleration=accelerations,
            moved_by="forces" if is_moved_by_forces else "acceleration",
            velocity_change=self.compute_midpoint(mass, added, smooth, uses_actuators),
            weights=self.read_weights(), softnesses=self.read_softnesses(),
            geom_settings=self.read_geom_settings(), settings=self.read_settings(),
            precision=self.precision,
        )  # fmt: skip

    def read_velocity_mode(self) -> int:
        """Return the largest control mode with a derivative by the velocity."""
        import genesis

        return int(genesis.CTRL_MODE.VELOCITY)

    def read_settings(self) -> dict[str, Any]:
        """Return the options by Genesis' names."""
        options, config = self.solver._options, self.config
        settings: dict[str, Any] = {
            "family": "genesis",
            "cone": "elliptic" if config.enable_elliptic_friction else "pyramidal",
            "impratio": self.impratio,
        }
        for name in ("integrator", "constraint_solver"):
            value = getattr(options, name, None)
            settings[name] = str(getattr(value, "name", value))
        for name in ("iterations", "tolerance", "constraint_timeconst"):
            value = getattr(options, name, None)
            settings[name] = None if value is None else float(value)
        return settings

    @property
    def impratio(self) -> float:
        """Ratio of the impedances of friction and normal rows [-]."""
        return float(np.ravel(copy_to_host(self.solver.rigid_info.impratio))[0])

    def make_softness(self, values: FloatArray) -> Softness:
        """Return the softness of a row with Genesis' seven numbers."""
        return Softness(
            "impedance", values[:2].copy(), np.zeros(2), values[2:7].copy(), self.impratio
        )

    def read_joint_numbers(self) -> tuple[FloatArray, FloatArray]:
        """Return the seven softness numbers of each joint (n, 7), and the inverse mass of each velocity (nv,)."""
        batched = bool(self.config.batch_joints_info)
        numbers = self.read_info(self.solver.dyn_info.joints.sol_params, batched)
        return numbers.reshape(-1, 7), self.read_dofs("invweight")

    def make_limit_keys(self, dof: int) -> list[str]:
        """Return the keys of both limits of a velocity's joint."""
        return [f"{side} limit of {self.owner_of_dof[dof].name}" for side in ("lower", "upper")]

    def make_friction_key(self, dof: int) -> str:
        """Return the key of the dry friction of a velocity."""
        joint = self.owner_of_dof[dof]
        has_many = len(np.atleast_1d(joint.dofs_idx)) > 1
        return f"dry friction of {joint.name}" + (f" {self.place_of_dof[dof]}" if has_many else "")

    def make_equality_key(self, i: int) -> tuple[str, int, FloatArray]:
        """Return key, number of rows, and inverse masses of an equality."""
        import genesis

        equalities, types = self.solver.dyn_info.equalities, genesis.EQUALITY_TYPE
        kind, first, second = (
            int(copy_to_host(getattr(equalities, x))[i, self.world])
            for x in ("eq_type", "eq_obj1id", "eq_obj2id")
        )
        known = list(self.solver.equalities)
        name = known[i].name if i < len(known) else ""
        if kind == int(types.JOINT):
            _, weights = self.read_joint_numbers()
            joints = {int(j.idx): j for j in self.solver.joints}
            pair = [joints[x] for x in (first, second) if x >= 0]
            total = sum(float(weights[int(np.atleast_1d(j.dofs_idx)[0])]) for j in pair)
            text = f"joint between {' and '.join(j.name for j in pair)}"
            return f"equality {name or text}", 1, np.array([total])
        if kind not in (int(types.CONNECT), int(types.WELD)):
            raise CapabilityError("a screw of Genesis is not supported: leave it out")
        both = self.read_link_weights()[[first, second]].sum(axis=0)
        is_weld = kind == int(types.WELD)
        text = f"{'weld' if is_weld else 'connect'} between {self.links[first]} and {self.links[second]}"
        return (
            f"equality {name or text}",
            6 if is_weld else 3,
            np.repeat(both[:2], 3)[: 6 if is_weld else 3],
        )

    def read_link_weights(self) -> FloatArray:
        """Return the inverse masses of each link (n, 2): translation and rotation."""
        return self.read_info(
            self.solver.dyn_info.links.invweight, bool(self.config.batch_links_info)
        )

    def read_weights(self) -> dict[str, float | FloatArray]:
        """Return the inverse masses of links, limits and dry friction."""
        own = self.read_link_weights()
        weights: dict[str, float | FloatArray] = {
            name: float(own[i][0]) for i, name in self.links.items() if i >= 0
        }
        _, of_dofs = self.read_joint_numbers()
        for dof in range(self.nv):
            weights |= dict.fromkeys(self.make_limit_keys(dof), float(of_dofs[dof]))
            weights[self.make_friction_key(dof)] = float(of_dofs[dof])
        return weights | {"world": 0.0}

    def read_softnesses(self) -> dict[str, Softness]:
        """Return the softness of all constraints of joints that may be active."""
        numbers, _ = self.read_joint_numbers()
        result: dict[str, Softness] = {}
        for dof in range(self.nv):
            own = self.make_softness(numbers[int(self.owner_of_dof[dof].idx)])
            result |= dict.fromkeys([*self.make_limit_keys(dof), self.make_friction_key(dof)], own)
        return result

    def read_geom_settings(self) -> dict[str, GeomSettings]:
        """Return the contact settings of the geoms that have a name."""
        result = {}
        for geom in self.solver.geoms:
            name = (getattr(geom, "metadata", None) or {}).get("name")
            numbers = np.ravel(_to_host(geom.get_sol_params()))[-7:]
            friction = np.full(5, float(np.ravel(_to_host(geom.get_friction()))[0]))
            if name:
                result[name] = GeomSettings(3, 0, 1.0, friction, self.make_softness(numbers))
        return result

    def read_blocks(self) -> list[ConstraintBlock]:
        """Return the blocks of all constraint rows, in the engine's order."""
        state = self.solver.constraint_solver.constraint_state
        counts = {
            kind: int(copy_to_host(getattr(state, f"n_constraints{kind}"))[self.world])
            for kind in ("", "_equality", "_frictionloss")
        }
        n, world = counts[""], self.world
        self.jacobian = np.asarray(copy_to_host(state.jac, n)[:, :, world], float)
        self.reference, self.compliance, self.force, self.loss = (
            np.asarray(copy_to_host(getattr(state, name), n)[:, world], float)
            for name in ("aref", "diag", "efc_force", "efc_frictionloss")
        )
        blocks = []
        first, equality = 0, 0
        while first < counts["_equality"]:
            key, size, weight = self.make_equality_key(equality)
            blocks.append(self.read_equality(key, np.arange(first, first + size), weight, equality))
            first, equality = first + size, equality + 1
        numbers, weights = self.read_joint_numbers()
        end = first + counts["_frictionloss"]
        for i in range(first, end):
            dof = int(np.argmax(np.abs(self.jacobian[i])))
            blocks.append(ConstraintBlock(
                self.make_friction_key(dof), "friction", self.jacobian[[i]], np.zeros(1), weights[[dof]],
                self.make_softness(numbers[int(self.owner_of_dof[dof].idx)]), loss=abs(float(self.loss[i])),
                force=self.force[[i]],
            ))  # fmt: skip
        contacts, end = self.read_contacts(end)
        blocks += contacts
        limits = self.read_dofs("limit")
        for i in range(end, n):
            dof = int(np.argmax(np.abs(self.jacobian[i])))
            joint = self.owner_of_dof[dof]
            at = float(self.position[int(np.atleast_1d(joint.qs_idx)[0])])
            is_upper = self.jacobian[i, dof] < 0.0
            gap = limits[dof][1] - at if is_upper else at - limits[dof][0]
            blocks.append(ConstraintBlock(
                self.make_limit_keys(dof)[int(is_upper)], "limit", self.jacobian[[i]], np.array([gap]),
                weights[[dof]], self.make_softness(numbers[int(joint.idx)]), force=self.force[[i]],
            ))  # fmt: skip
        return blocks

    def read_equality(
        self, key: str, rows: np.ndarray, weight: FloatArray, i: int
    ) -> ConstraintBlock:
        """Return the block of an equality; its bias -dJ/dt v is the rest of its reference."""
        equalities = self.solver.dyn_info.equalities
        numbers, places = (
            np.asarray(copy_to_host(getattr(equalities, x)), float)[i, self.world]
            for x in ("sol_params", "eq_data")
        )
        pair = [
            int(copy_to_host(getattr(equalities, x))[i, self.world])
            for x in ("eq_obj1id", "eq_obj2id")
        ]
        jac = self.jacobian[rows]
        block = ConstraintBlock(
            key, "equality", jac, self.measure_equality(pair, places, len(rows)), weight,
            self.make_softness(numbers), force=self.force[rows],
        )  # fmt: skip
        rates, springs = compute_reference(block, block.softness, block.softness, len(rows))
        bias = self.reference[rows] + rates * (jac @ self.velocity) + springs * block.gap
        return replace(block, bias=bias)

    def measure_equality(self, pair: list[int], data: FloatArray, count: int) -> FloatArray:
        """Return how far an equality of two joints or two links is from being satisfied (count,) [m, rad, -]."""
        if count == 1:
            start = np.asarray(copy_to_host(self.solver.rigid_info.qpos0)[:, self.world], float)
            moved = self.position - start
            first, *others = (
                moved[int(np.atleast_1d(j.qs_idx)[0])]
                for x in pair for j in self.solver.joints if int(j.idx) == x
            )  # fmt: skip
            return np.array([first - np.polynomial.polynomial.polyval(sum(others), data[:5])])
        from scipy.spatial.transform import Rotation

        positions, turns = self.poses
        frames = [Rotation.from_quat(turns[x][[1, 2, 3, 0]]) for x in pair]
        anchors = data[:6].reshape(2, 3)
        if count == 6:
            anchors = anchors[::-1]
        first, second = (
            positions[x] + frame.apply(y) for x, frame, y in zip(pair, frames, anchors, strict=True)
        )
        apart = first - second
        if count == 6:
            turn = frames[1].inv() * frames[0] * Rotation.from_quat(data[[7, 8, 9, 6]])
            apart = np.append(apart, data[10] * turn.as_quat(canonical=True)[:3])
        return np.asarray(apart, float)

    def read_contacts(self, first: int) -> tuple[list[ConstraintBlock], int]:
        """Return the blocks of contacts, whose rows begin at `first`, and the row after them."""
        state = self.solver.collider.collider_state
        count = int(copy_to_host(state.n_contacts)[self.world])
        order = copy_to_host(state.contact_sort_idx)[:, self.world].astype(int)
        names = [
            "pos",
            "penetration",
            "friction",
            "sol_params",
            "link_a",
            "link_b",
            "geom_a",
            "geom_b",
        ]
        has = {
            "spin": bool(self.config.enable_torsional_friction),
            "rolling": bool(self.config.enable_rolling_friction),
        }
        names += [f"friction_{'torsional' if x == 'spin' else 'rolling'}" for x in has if has[x]]
        values = {x: copy_to_host(getattr(state.contact_data, x))[:, self.world] for x in names}
        links = self.read_link_weights()
        size = int(self.config.rows_per_contact)
        is_elliptic = bool(self.config.enable_elliptic_friction)
        keys = {
            int(g.idx): (getattr(g, "metadata", None) or {}).get("name") or f"geom {g.idx}"
            for g in self.solver.geoms
        }
        blocks = []
        for k in range(count):
            c = order[k]
            rows = np.arange(first + k * size, first + (k + 1) * size)
            friction = np.full(5, float(values["friction"][c]))
            if has["spin"]:
                friction[2] = float(values["friction_torsional"][c])
            if has["rolling"]:
                friction[3:] = float(values["friction_rolling"][c])
            condim = size if is_elliptic else 1 + size // 2
            jac, force = self.jacobian[rows], self.force[rows]
            if not is_elliptic:
                minus, plus = jac[0::2], jac[1::2]
                mu = np.maximum(friction[: condim - 1], SMALLEST_COEFFICIENT)
                jac = np.vstack(
                    [(plus + minus).mean(axis=0) / 2.0, (plus - minus) / (2.0 * mu[:, None])]
                )
                force = np.append(force.sum(), mu * (force[1::2] - force[0::2]))
            pair = [int(values[x][c]) for x in ("link_a", "link_b")]
            bodies = tuple(self.links[x] for x in pair)
            geoms = tuple(keys.get(int(values[x][c]), "") for x in ("geom_a", "geom_b"))
            weight = sum(float(links[x][0]) for x in pair if x >= 0)
            blocks.append(ConstraintBlock(
                f"contact of {' and '.join(sorted(bodies))}", "contact", jac,
                np.array([-float(values["penetration"][c])]), np.array([weight]),
                self.make_softness(np.asarray(values["sol_params"][c], float)),
                cone="ellipse" if is_elliptic else "pyramid", condim=condim, friction=friction,
                force=force, geoms=geoms, geom_keys=geoms, bodies=bodies,
                position=np.asarray(values["pos"][c], float),
            ))  # fmt: skip
        return blocks, first + count * size

    def compute_midpoint(
        self, mass: FloatArray, added: FloatArray, smooth: FloatArray, is_used: bool
    ) -> FloatArray | None:
        """Return the change of velocities (nv,) by the midpoint rule of free bodies without constraints.

        With the inertia I and the torque t without the gyroscopic one, it solves for the mean angular velocity w_m

            2 (I + E) (w_m - w) / h = t - w_m x I w_m                                                            (1)

        where E are armature, damping and actuators. The centre of mass must be at the origin of the joint.
        """
        state = self.solver.dyn_state.links
        constrained = self.read(state.is_constrained).astype(bool)
        armature = self.read_dofs("armature")
        result = np.zeros(self.nv)
        for joint in self.joints:
            dofs = np.atleast_1d(joint.dofs_idx).astype(int)
            link = joint.link
            tree = [x for x in self.solver.links if int(x.root_idx) == int(link.idx)]
            is_alone = is_used and self.is_free[dofs[0]] and int(link.parent_idx) < 0
            is_alone = is_alone and all(not x.n_dofs or x is link for x in tree)
            if not is_alone or any(constrained[int(x.idx)] for x in tree):
                continue
            turn = dofs[3:]
            extra = np.diag(armature[turn])
            inertia = mass[np.ix_(turn, turn)] - extra
            whole = inertia + extra + np.diag(added[turn])
            if self.is_compatible:
                whole = inertia
            if np.any(mass[np.ix_(dofs[:3], turn)]):
                continue  # The centre of mass is elsewhere: the difference is left in the rest.
            w = self.velocity[turn]
            torque = smooth[turn] + np.cross(w, inertia @ w)
            plain = w + self.dt * np.linalg.solve(whole, smooth[turn])
            mean = w.copy()
            for _ in range(MIDPOINT_STEPS):
                spin = inertia @ mean
                error = 2.0 / self.dt * whole @ (mean - w) - torque + np.cross(mean, spin)
                slope = 2.0 / self.dt * whole + _cross_matrix(mean) @ inertia - _cross_matrix(spin)
                step = np.linalg.solve(slope, error)
                mean = mean - step
                if np.abs(step).max() <= np.finfo(float).eps * max(1.0, float(np.abs(mean).max())):
                    break
            result[turn] = 2.0 * mean - w - plain
        return result if result.any() else None


def _to_host(value: Any) -> FloatArray:
    """Return a number or a tensor as an array on the host."""
    return np.asarray(value.cpu() if hasattr(value, "cpu") else value, float)


def _cross_matrix(a: FloatArray) -> FloatArray:
    """Return the matrix of the cross product with a."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
