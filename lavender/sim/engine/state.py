"""The engine's buffers with named arrays, which are built from a scene and enlarged if they are too small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.problem.derived import cached_property
from lavender.sim.engine.layout import HEAD, JOINT, JOINT_KINDS, ORDER_NUMBER, SETTING, SIZE
from lavender.sim.engine.loops import find_loop_joints
from lavender.sim.engine.values import SolverValues
from lavender.sim.scene import Box, Plane, Scene, Sphere, arithmetic
from lavender.sim.scene.parameters import SCENE_ORDERS, Parameters
from lavender.sim.scene.parts import Body, Joint
from lavender_ext.driver import memory
from lavender_ext.engine import substep
from lavender_ext.engine.arrays import (
    BOX,
    CAP_CONTACT,
    CAP_PAIR,
    MAX_PAIRS,
    N_SIZES,
    NO_SHAPE,
    PAIR_COUNT_OVERFLOW,
    PLANE,
    SPHERE,
    compute_buffer_lengths,
)
from lavender_ext.engine.newton_substep import Substep

CONTACT_ARRAYS = ("contact_pair", "point", "normal", "tangent")

assert set(ORDER_NUMBER) == set(SCENE_ORDERS)

# Up to this many shapes, collision detection tests all pairs; with more shapes a grid is faster and is used instead.
BRUTE_FORCE_MAX_SHAPES = 32
BETA = 0.2  # [-] Fraction of a position error that a substep removes.
MAX_PUSH = 0.2  # [m] A substep corrects at most this much of a position error.
# [-] Compliance of the rigid joints of closed loops relative to d, for solvers that solve all rows: the position
# projection leaves errors of about 1e-6 m in a loop, so that its redundant rows no longer depend on the others and
# would stop its motion.
JOINT_GIVE = 1e-5
MAX_BUFFER_BYTES = 2**32  # [bytes] Larger buffers (the three together) are rejected.


class State:
    """Buffers of the engine: one of floats, one of integers, one of keys.

    `a` holds the arrays in the buffers by name, as `lavender_ext/engine/arrays.pyx` defines them.
    """

    def __init__(self, size: np.ndarray) -> None:
        self.size = np.ascontiguousarray(size, np.int32)
        used = compute_buffer_lengths(self.size)
        if min(used) < 0 or 8 * used[0] + 4 * used[1] + 8 * used[2] > MAX_BUFFER_BYTES:
            raise InputError(
                f"{self.size[SIZE['bodies']]} bodies with memory for {self.size[CAP_PAIR]} pairs and "
                f"{self.size[CAP_CONTACT]} contacts need more than the {MAX_BUFFER_BYTES >> 30} GiB that a simulation "
                "may take: move the bodies apart, or use fewer bodies"
            )
        self.real = np.zeros(used[0])
        self.index = np.zeros(used[1], np.int32)
        self.keys = np.zeros(max(used[2], 1), np.uint64)
        self.kernel = substep.Buffers(self.size, self.real, self.index, self.keys)
        self.a: dict[str, Any] = self.kernel.arrays()
        self.head, self.setting = self.a["head"], self.a["setting"]
        self._views: tuple[int, int, tuple[Any, ...]] = -1, -1, ()

    @cached_property
    def warm_start_phase(self) -> Substep:
        """The compiled first phase of the solver `newton`, bound to these buffers."""
        return Substep(self.size, self.real, self.index, self.keys, False)

    def get_observation_views(self, contacts: int, rows: int) -> tuple[Any, ...]:
        """Return what an observation copies; it is cached while the numbers of contacts and contact rows do not change.

        Functions that copy positions, quaternions, velocities, joint impulses, the eight solver values, and pair,
        point, normal, tangent of the contacts; their gaps (c,) [m]; a function that copies the contact impulses, or
        None if contacts have different numbers of rows.
        """
        if self._views[0] != contacts or self._views[1] != rows:
            a = self.a
            first = int(self.size[SIZE["joint_rows"]])
            per = int(self.size[SIZE["rows_per_contact"]])
            even = rows == contacts * per
            self._views = (
                contacts,
                rows,
                (
                    *(a[name].copy for name in ("x", "q", "v", "joint_impulse")),
                    self.setting[SETTING["out"] : SETTING["out"] + 8].view(SolverValues).copy,
                    *(a[name][:contacts].copy for name in CONTACT_ARRAYS),
                    a["gap"][:contacts],
                    a["impulse"][first : first + rows].reshape(contacts, per).copy
                    if even
                    else None,
                ),
            )
        return self._views[2]

    @property
    def nbytes(self) -> int:
        """Size of the three buffers [bytes]."""
        return int(self.real.nbytes + self.index.nbytes + self.keys.nbytes)

    def copy(self) -> State:
        """Return a copy with its own buffers."""
        other = State(self.size)
        other.copy_from(self)
        return other

    def copy_from(self, other: State) -> None:
        """Copy the buffers of a state of the same sizes, bit for bit."""
        self.real[:] = other.real
        self.index[:] = other.index
        self.keys[:] = other.keys

    def with_larger_buffers(self) -> State:
        """Return a copy with buffers of the sizes that the last substep needed."""
        if self.head[HEAD["need_pairs"]] == PAIR_COUNT_OVERFLOW:
            raise InputError(
                f"more than {MAX_PAIRS} pairs of bodies are close together ({self.size[SIZE['bodies']]} bodies): "
                "move them apart"
            )
        own = (self.size, self.real, self.index, self.keys)
        other = State(memory.compute_grown_workspace_sizes(*own))
        memory.move_engine_state(*own, other.size, other.real, other.index, other.keys)
        return other

    @classmethod
    def from_scene(cls, scene: Scene) -> State:
        """Build the initial state of a scene."""
        p, bodies, joints = scene.parameters, scene.bodies, scene.joints
        n = len(bodies)
        # `even` bodies have an inertia I that is exactly a multiple of the identity, which rotation does not change.
        even = (np.array_equal(b.inertia, np.eye(3) * b.inertia[0, 0]) for b in bodies)
        uneven = [not b.is_static and not same for b, same in zip(bodies, even, strict=True)]
        frames = any(uneven) or bool(joints) or any(isinstance(b.shape, Box) for b in bodies)
        mu = np.array([p.friction if b.friction is None else b.friction for b in bodies])
        patch = np.array(
            [p.patch_radius if b.patch_radius is None else b.patch_radius for b in bodies]
        )
        restitution = np.array(
            [p.restitution if b.restitution is None else b.restitution for b in bodies]
        )
        shaped = np.array([b.shape is not None for b in bodies], bool)
        rough = bool((mu[shaped] > 0.0).any())
        spin = rough and bool((patch[shaped] > 0.0).any())
        rolling = rough and p.rolling_radius > 0.0
        per = 1 + 2 * rough + spin + 2 * rolling
        if p.friction_shape == "box" and (spin or rolling):
            raise InputError(
                "friction_shape is 'box' and patch_radius or rolling_radius > 0: a box has neither torsional nor "
                "rolling friction; leave one of the two out"
            )
        excluded = sorted(
            {tuple(sorted((j.a, j.b))) for j in joints if not j.collide and min(j.a, j.b) >= 0}
        )
        n_shapes = int(shaped.sum())
        size = np.zeros(N_SIZES, np.int32)
        size[SIZE["bodies"]] = n
        size[SIZE["dynamic"]] = sum(not b.is_static for b in bodies)
        size[SIZE["joints"]] = len(joints)
        size[SIZE["joint_rows"]] = sum(j.n_rows for j in joints)
        size[SIZE["excluded"]] = len(excluded)
        size[SIZE["buckets"]] = (
            0 if n_shapes <= BRUTE_FORCE_MAX_SHAPES else 1 << int(np.ceil(np.log2(2 * n_shapes)))
        )
        size[SIZE["frames"]] = n if frames else 0
        size[SIZE["rows_per_contact"]] = per
        size[CAP_PAIR] = 4 * n_shapes if n_shapes > 1 else 0
        size[CAP_CONTACT] = 4 * n_shapes if n_shapes > 1 else 0
        state = cls(size)
        _put_parameters(state, p)
        a: dict[str, Any] = state.a
        _put_bodies(a, bodies, uneven)
        a["restitution"][:], a["friction"][:], a["patch"][:] = restitution, mu, patch
        _put_joints(a, joints)
        if excluded:
            a["excluded"][:] = excluded
        return state


def _put_parameters(state: State, p: Parameters) -> None:
    """Write the parameters of a scene to `head` and `setting`."""
    head, setting = state.head, state.setting
    setting[SETTING["gravity"] : SETTING["gravity"] + 3] = p.gravity
    numbers = {
        "h": p.dt / p.substeps,
        "slop": p.slop,
        "margin": p.margin,
        "skin": 5.0 * p.margin,
        "beta": BETA,
        "max_push": MAX_PUSH,
        "bounce": p.restitution_threshold,
        "match": 5.0 * p.margin,
        "rolling": p.rolling_radius,
        "recycle": p.recycle,
        "joint_give": JOINT_GIVE
        if p.solver != "sequential_impulses" and p.position_iterations
        else 0.0,
    }
    for name, x in numbers.items():
        setting[SETTING[name]] = x
    head[HEAD["iterations"]] = p.solver_iterations
    head[HEAD["warm_start"]] = p.warm_start
    head[HEAD["position_iterations"]] = p.position_iterations
    head[HEAD["order"]] = ORDER_NUMBER[p.order]
    head[HEAD["seed"]] = p.seed
    head[HEAD["friction_shape"]] = p.friction_shape == "box"
    head[HEAD["substeps"]] = p.substeps
    head[HEAD["lost"]] = -1
    setting[SETTING["out"] : SETTING["out"] + 2] = p.solver_iterations, p.warm_start


def _put_bodies(a: dict[str, Any], bodies: Sequence[Body], uneven: Sequence[bool]) -> None:
    """Write poses, velocities, masses and shapes; the inertia of bodies in `uneven` changes under rotation."""
    dynamic = 0
    for i, b in enumerate(bodies):
        a["x"][i], a["q"][i] = b.position, b.quaternion
        a["v"][i, :3], a["v"][i, 3:] = b.velocity, b.angular_velocity
        a["dyn"][i] = -1
        if not b.is_static:
            inverse = arithmetic.invert_definite_3x3(b.inertia)
            a["dyn"][i] = dynamic
            a["body_of"][dynamic] = i
            a["inv_mass_body"][i] = a["inv_mass"][dynamic] = 1.0 / b.mass
            a["inertia"][i] = b.inertia
            a["inv_inertia_body"][i] = a["inv_inertia"][dynamic] = inverse
            a["uneven"][i] = uneven[i]
            dynamic += 1
        if isinstance(b.shape, Plane):
            a["kind_of_shape"][i] = PLANE
            a["shape"][i] = [*b.shape.normal, b.shape.offset]
        elif isinstance(b.shape, Sphere):
            a["kind_of_shape"][i] = SPHERE
            a["shape"][i, :3] = b.shape.radius
        elif isinstance(b.shape, Box):
            a["kind_of_shape"][i] = BOX
            a["shape"][i, :3] = 0.5 * np.array(b.shape.size)
        else:
            a["kind_of_shape"][i] = NO_SHAPE


def _put_joints(a: dict[str, Any], joints: Sequence[Joint]) -> None:
    """Write the joints and the first row of each."""
    row = 0
    for i, j in enumerate(joints):
        values = a["joint"][i]
        for name in ("anchor_a", "anchor_b", "axis_a", "axis_b"):
            values[JOINT[name] : JOINT[name] + 3] = getattr(j, name)
        side = np.cross(j.axis_a, np.eye(3)[np.argmin(np.abs(j.axis_a))])
        values[JOINT["side_a"] : JOINT["side_a"] + 3] = side / arithmetic.compute_norm(side)  # pyright: ignore[reportArgumentType]
        for name in ("length", "hertz", "damping"):
            values[JOINT[name]] = getattr(j, name)
        values[JOINT["speed"]] = j.motor_speed or 0.0
        values[JOINT["torque"]] = j.motor_torque
        a["joint_kind"][i] = JOINT_KINDS[j.kind]
        a["joint_motor"][i] = j.motor_speed is not None
        a["joint_bodies"][i] = j.a, j.b
        a["joint_body"][i] = [a["dyn"][k] if k >= 0 else -1 for k in (j.a, j.b)]
        row += j.n_rows
        a["ptr"][i + 1] = row
    # The static bodies and the world are one body of the loops.
    rigid = [j.hertz == 0.0 for j in joints]
    a["joint"][:, JOINT["loop"]] = find_loop_joints(a["joint_body"], rigid)
