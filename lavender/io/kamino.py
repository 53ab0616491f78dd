"""Convert the last step of newton's `SolverKamino` to a batch of problems, with the engine's impulses and its claims.

    solver.step(state_in, state_out, control, contacts, dt)
    step = lavender.io.from_kamino(solver)                  # before the next step or reset
    lavender.residual_many(step.batch, step.impulse, errors="status").relative      # (n,), judged
    step.claims.converged                                   # (n,), as the engine reports it

Kamino (Tsounis et al. 2025) solves, for each world, the dual problem of one time step

    w = D lambda + v_f + Gamma(w)    D = J M^-1 J^T + diag(compliance),   v_f = J u_f + biases

with Coulomb's law in De Saxce's form: w + mu |w_t| n lies in the dual cone. It stores the rows scaled by a diagonal P.
Without the scaling and with the normal row first, this is the problem of this package:

    J, M     rows of all joints, bounded multipliers, limits and contacts over 6 velocities of each body
    v*       u_f, the velocity of the bodies without constraint impulses
    target   J u_f - v_f / P, so that b = -v_f / P (stabilisation and restitution are contained in it)
    bounds   joints: none; bounded multipliers (joint friction, effort limits): P times the stored bounds;
             limits: lambda >= 0; contacts: a disk of radius mu lambda_n
    compliance  of joint dynamics and effort rows, and of soft limits and contacts

Bodies that cannot move (inverse mass and inertia 0) keep their velocity: their columns of J are zero, and their motion
is part of the target.

The matrix D that the engine built is compared with J M^-1 J^T + diag(compliance). This proves that the attributes of
the installed version have the meaning assumed here. The comparison runs for the first step of a solver, again if its
layout changes, and with `verify=True`. Supported are the dynamics solvers PADMM and DVI, over a dense or sparse
Jacobian. Rejected are LOX, which solves another problem, and sparse dynamics, which never form D.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lavender.base.arrays import FloatArray, check_bool
from lavender.base.errors import CapabilityError, InputError
from lavender.batch.data import Batch
from lavender.io.engine_step import Claims, EngineStep
from lavender.problem.cones import CONTACT, ROW, Cones

# Largest accepted difference of the engine's D and J M^-1 J^T + compliance, relative to the largest entry of the
# world: 200 roundings of float32. Observed: up to 4e-7. A wrong row or a missing term differs by 1e-2 or more.
MATRIX_TOLERANCE = 2.4e-5
# At the first step, up to this number of worlds are compared, the ones with the largest numbers of rows.
# `verify=True` compares all worlds.
MAX_VERIFIED_WORLDS = 64
ROWS_PER_CONTACT, COLUMNS_PER_BODY = 3, 6
# Position of each row of a contact in the engine, which stores both tangents before the normal.
NORMAL_FIRST = np.array([2, 0, 1])
# Entries of the lower triangle of a body's M that can differ from 0: the mass three times, then the inertia.
BODY_ROW, BODY_COLUMN = np.array([0, 1, 2, 3, 4, 4, 5, 5, 5]), np.array([0, 1, 2, 3, 3, 4, 3, 4, 5])
BODY_ROW_ENTRIES = np.array([1, 1, 1, 1, 2, 3])
INERTIA_ENTRIES = np.tril_indices(3)
# Residuals that the engine compares with its tolerances; see its PADMMStatus and DVIStatus.
RESIDUAL_NAMES = ("r_p", "r_d", "r_c", "r_b")
DYNAMICS_SOLVERS = ("padmm", "dvi")
KAMINO_ADVICE = (
    "newton 1.8 is supported; the class is experimental and its attributes change between versions"
)


_LAYOUTS: WeakKeyDictionary[Any, _Layout] = WeakKeyDictionary()  # The layout of each solver.
# For each solver: its numbers of bodies and rows, and the kinds of rows that have been compared with D.
_VERIFIED: WeakKeyDictionary[Any, tuple[Any, frozenset[str]]] = WeakKeyDictionary()


@np.errstate(
    over="ignore", invalid="ignore", divide="ignore"
)  # A diverged world has NaN or huge numbers.
def from_kamino(solver: Any, *, verify: bool = False) -> EngineStep:
    """Return the problems that a `SolverKamino` solved in its last step, its impulses and its claims.

    Parameters
    ----------
    solver : newton.solvers.SolverKamino
        After `step`, and before the next step or reset. Configured with PADMM or DVI, and without sparse dynamics.
    verify : bool, default False
        Compare the engine's matrix of every world with J M^-1 J^T + diag(compliance) at this step, too. By default
        this is done only at the first step.

    Returns
    -------
    EngineStep
        Worlds of any sizes, with Coulomb's law. Numbers of the engine are float32, and the batch has that precision. A
        world with a number that is not finite has v_free = NaN: `residual_many(..., errors="status")` and
        `solve_many(..., errors="status")` report it by its number and judge all others.

    Raises
    ------
    InputError
        `solver` is not a SolverKamino, or has no constraints.
    CapabilityError
        The solver is configured with LOX or sparse dynamics; the installed version of newton lacks attributes; a
        body's inverse inertia is singular; or the engine's matrix differs from J M^-1 J^T + diag(compliance).
    """
    verify = check_bool("verify", verify)
    engine = getattr(solver, "_solver_kamino", None)
    if engine is None:
        raise InputError(
            f"solver is a {type(solver).__name__}; a newton.solvers.SolverKamino is needed"
        )
    try:
        _check_configuration(engine)
        layout = _LAYOUTS.get(solver)
        if layout is None or layout.info is not engine._model.info:
            layout = _LAYOUTS[solver] = _Layout(engine._model)
        worlds = _Worlds(engine, layout, solver._contacts_kamino)
        step = worlds.convert()
        status = solver.status.numpy()
        residuals = {
            name: status[name].astype(float)
            for name in status.dtype.names
            if name in RESIDUAL_NAMES
        }
        claims = Claims(status["converged"] != 0, status["iterations"].astype(np.int64), residuals)
        _verify_delassus_matrix(solver, engine, worlds, verify)
    except AttributeError as error:
        raise CapabilityError(
            f"this SolverKamino lacks an attribute: {error}. {KAMINO_ADVICE}"
        ) from None
    return EngineStep(*step, claims)


def _check_configuration(engine: Any) -> None:
    """Raise an error unless the engine solves the dual problem, forms its matrix and has constraints."""
    config = engine._config
    if config.dynamics_solver not in DYNAMICS_SOLVERS:
        raise CapabilityError(
            f"dynamics_solver={config.dynamics_solver!r} solves another problem; dynamics_solver="
            f"{' or '.join(map(repr, DYNAMICS_SOLVERS))} of SolverKamino.Config is supported"
        )
    if config.sparse_dynamics:
        raise CapabilityError("sparse_dynamics=True of SolverKamino.Config is not supported")
    if engine.problem_fd is None or (
        not config.sparse_jacobian and engine._jacobians.data.J_cts_data is None
    ):
        raise InputError(
            "this model has no joints, limits or contacts, so it has no constraint problem"
        )


class _Layout:
    """The bodies and joints of each world. A model fixes them, so they are read once for each solver."""

    def __init__(self, model: Any) -> None:
        info, joints = model.info, model.joints
        self.info = info
        self.bodies = _as_int(info.num_bodies)
        self.n = n = len(self.bodies)
        self.has_equal_bodies = bool((self.bodies == self.bodies[0]).all())
        self.columns = COLUMNS_PER_BODY * self.bodies
        # Indices and row pointers of M's lower triangle if all worlds have the bodies of the first one.
        n_bodies = int(self.bodies[0])
        offset = COLUMNS_PER_BODY * np.repeat(np.arange(n_bodies), len(BODY_COLUMN))
        indptr = _cumulate_counts(np.tile(BODY_ROW_ENTRIES, n_bodies))
        self.mass_pattern = np.tile(BODY_COLUMN, n_bodies) + offset, indptr
        self.velocity_ptr = _cumulate_counts(self.columns)
        self.velocity_world = np.repeat(np.arange(n), self.columns)
        # Position of each velocity in the engine's array of all bodies.
        self.first_body = _as_int(info.bodies_offset)[:n]
        within = np.arange(self.velocity_ptr[-1]) - self.velocity_ptr[self.velocity_world]
        self.velocity_position = COLUMNS_PER_BODY * self.first_body[self.velocity_world] + within
        # For each row of joint dynamics and each effort row: world, index within the world, index in the joints'
        # arrays.
        self.soft_rows = {}
        for kind in ("dynamic", "effort"):
            names = (
                f"num_joint_{kind}_cts",
                f"joint_{kind}_cts_offset",
                f"joint_{kind}_cts_group_offset",
            )
            count, offset, group = (_as_int(getattr(info, name))[:n] for name in names)
            world = np.repeat(np.arange(n), count)
            k = np.arange(len(world)) - _cumulate_counts(count)[world]
            self.soft_rows[kind] = world, group[world] + k, offset[world] + k
        # For each joint: index within its world of its first kinematic row, and the number of its kinematic rows.
        world, count = _as_int(joints.wid), _as_int(joints.num_kinematic_cts)
        per_world: Any = np.bincount(world, count, minlength=n).astype(np.int64)
        group = _as_int(info.joint_kinematic_cts_group_offset)[:n]
        before = _cumulate_counts(count)
        self.joint_rows = group + per_world
        self.joint_world, self.joint_size = world[count > 0], count[count > 0]
        self.joint_begin = (group[world] + before[:-1] - _cumulate_counts(per_world)[world])[
            count > 0
        ]


class _Worlds:
    """The engine's arrays of one step, with the positions of each world's rows and velocities in them."""

    def __init__(self, engine: Any, layout: _Layout, stored_contacts: Any) -> None:
        self.stored_contacts = stored_contacts
        self.engine = engine
        self.problem = engine.problem_fd.data
        self.layout = layout
        self.bodies, self.columns, self.n = layout.bodies, layout.columns, layout.n
        problem, n = self.problem, layout.n
        self.joints, self.bounded, self.limits, self.contacts = (
            _as_int(x)[:n] for x in (problem.njc, problem.nbc, problem.nl, problem.nc)
        )
        self.before_contacts = self.joints + self.bounded + self.limits
        self.rows = self.before_contacts + ROWS_PER_CONTACT * self.contacts
        stored = _as_int(problem.dim)[:n]
        if (self.rows != stored).any():
            world = int(np.flatnonzero(self.rows != stored)[0])
            raise CapabilityError(
                f"world {world} has {stored[world]} rows; its joints, bounded rows, limits and contacts have "
                f"{self.rows[world]}. {KAMINO_ADVICE}"
            )
        self.row_ptr = _cumulate_counts(self.rows)
        self.velocity_ptr = layout.velocity_ptr
        self.world = np.repeat(np.arange(n), self.rows)  # World of each row.
        # Index of each row within its world.
        self.index = np.arange(self.row_ptr[-1]) - self.row_ptr[self.world]
        # Index of the same row in the engine's order: both tangents of a contact, then its normal.
        self.source = self.index.copy()
        self.is_contact_row = self.index >= self.before_contacts[self.world]
        rank = (self.index - self.before_contacts[self.world])[
            self.is_contact_row
        ] % ROWS_PER_CONTACT
        self.source[self.is_contact_row] += NORMAL_FIRST[rank] - rank
        self.begins_contact = np.zeros(len(self.index), bool)
        self.begins_contact[self.is_contact_row] = rank == 0
        # Position of each row in the engine's vectors over the rows of all worlds.
        self.position = _as_int(problem.vio)[self.world] + self.source
        self.jacobian_values, self.jacobian_start = self._read_jacobian()

    def _read_jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all entries of J, world after world with rows in the engine's order, and each world's first entry."""
        if not self.engine._config.sparse_jacobian:
            data = self.engine._jacobians.data
            return data.J_cts_data.numpy(), _as_int(data.J_cts_offsets)
        blocks = (
            self.engine._jacobians._J_cts.bsm
        )  # Each block has one row and the six columns of a body.
        count = _as_int(blocks.num_nzb)
        start = _cumulate_counts(self.rows * self.columns)
        world = np.repeat(np.arange(self.n), count)
        block = (
            _as_int(blocks.nzb_start)[world]
            + np.arange(len(world))
            - _cumulate_counts(count)[world]
        )
        row, column = _as_int(blocks.nzb_coords)[block].T
        first = start[world] + row * self.columns[world] + column
        values = np.zeros(start[-1], np.float32)
        values[first[:, None] + np.arange(COLUMNS_PER_BODY)] = blocks.nzb_values.numpy()[block]
        return values, start[:-1]

    def convert(self) -> tuple[Batch, FloatArray]:
        """Build the batch and the impulses."""
        scale = _copy_as_float64(self.problem.P)[self.position]
        velocity_position = self.layout.velocity_position
        free = _copy_as_float64(self.problem.u_f).reshape(-1)[velocity_position]
        mass, is_fixed = self._form_mass_matrix()
        moves = ~np.repeat(is_fixed, COLUMNS_PER_BODY)[velocity_position]
        jac, products = self._form_jacobian(free, moves)
        target = products - _copy_as_float64(self.problem.v_f)[self.position] / scale
        stored = self.problem.compliance
        joints = self.engine.data.joints
        soft = (
            np.zeros(len(self.index)) if stored is None else _copy_as_float64(stored)[self.position]
        )
        for kind, values in (("dynamic", joints.inv_m_j), ("effort", joints.inv_m_a)):
            world, row, position = self.layout.soft_rows[kind]
            if len(world):
                soft[self.row_ptr[world] + row] += _copy_as_float64(values)[position]
        self.compliance = soft  # [1/kg, 1/(kg m^2)]
        lower, upper, mu = self._compute_row_bounds(scale)
        wrong = self._find_worlds_of_rows(
            ~np.isfinite(target) | ~np.isfinite(self.compliance) | ~(scale > 0.0)
        )
        wrong |= self._find_worlds_of_rows(
            np.isnan(lower) | np.isnan(upper) | (lower > upper) | ~(mu >= 0.0)
        )
        is_wrong_row = wrong[self.world]
        lower[is_wrong_row] = -np.inf
        upper[is_wrong_row] = np.inf
        mu[is_wrong_row] = 0.0
        free[wrong[self.layout.velocity_world]] = np.nan
        begins = ~self.is_contact_row | self.begins_contact
        layout = self.layout
        if (layout.joint_rows != self.joints).any():
            raise CapabilityError(
                "the joint rows of the solver are not its dynamic rows followed by its kinematic rows, "
                f"which this importer needs. {KAMINO_ADVICE}"
            )
        # All kinematic rows of a joint form one block.
        start = self.row_ptr[layout.joint_world] + layout.joint_begin
        size = layout.joint_size
        begins[np.repeat(start - _cumulate_counts(size)[:-1], size) + np.arange(size.sum())] = False
        begins[start] = True
        first = np.flatnonzero(begins)
        cones = Cones(
            ptr=np.append(first, len(begins)).astype(np.int32),
            kind=np.where(self.begins_contact[first], CONTACT, ROW).astype(np.int32),
            lower=lower,
            upper=upper,
            mu=mu[first],
            patch_radius=np.zeros(len(first)),
        )
        ragged = {"velocity_ptr": self.velocity_ptr} if jac.ndim == 1 else {}
        batch = Batch(
            jac,
            mass,
            free if jac.ndim == 1 else free.reshape(self.n, -1),
            target=target,
            cones=cones,
            compliance=self.compliance,
            friction="coulomb",
            row_ptr=self.row_ptr,
            **ragged,
        )
        batch.precision = "float32"
        batch.names_of = self._make_block_namer(first)
        ends = np.cumsum(np.append(0, self.columns[self.world]))

        def find_angular_rows_of_world(i: int) -> Any:
            begin = self.row_ptr[i]
            end = self.row_ptr[i + 1]
            own = jac[begin:end] if jac.ndim == 2 else jac[ends[begin] : ends[end]]
            linear, angular = np.abs(own).reshape(end - begin, -1, 2, 3).sum(axis=(1, 3)).T
            return (linear == 0.0) & (angular > 0.0)

        batch.angular_of = find_angular_rows_of_world
        batch.contact_counts = self.contacts
        return batch, _copy_as_float64(self.engine.solver_fd.data.solution.lambdas)[self.position]

    def _find_worlds_of_rows(self, rows: np.ndarray) -> np.ndarray:
        """Return the worlds (n,) bool that have one of the given rows (bool)."""
        return np.bincount(self.world[rows], minlength=self.n) > 0

    def _form_jacobian(self, free: FloatArray, moves: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Return J and J v* (rows,) [m/s].

        J is (rows, nv) if all worlds have equal numbers of bodies, else a flat array of all entries.
        """
        values, start = self.jacobian_values, self.jacobian_start
        first = (
            start[self.world] + self.source * self.columns[self.world]
        )  # First entry of each row.
        if self.layout.has_equal_bodies:
            nv = int(self.columns[0])
            jac = values[first[:, None] + np.arange(nv)].astype(float)
            if not moves.all():
                jac *= moves.reshape(self.n, nv)[self.world]
            return jac, np.einsum("ij,ij->i", jac, free.reshape(self.n, nv)[self.world])
        width = self.columns[self.world]
        ptr = _cumulate_counts(width)
        entry = np.arange(ptr[-1])
        velocity = entry + np.repeat(self.velocity_ptr[self.world] - ptr[:-1], width)
        jac = np.where(moves[velocity], values[entry + np.repeat(first - ptr[:-1], width)], 0.0)
        row = np.repeat(np.arange(len(width)), width)
        products: Any = np.bincount(row, jac * free[velocity], minlength=len(width))
        return jac, products

    def _form_mass_matrix(self) -> tuple[Any, np.ndarray]:
        """Return M, and a mask (bodies,) of the bodies that cannot move.

        M is given as lower triangles with a common sparsity pattern, or as a flat array of all entries.
        """
        inv_mass = _copy_as_float64(self.engine._model.bodies.inv_m_i)
        inv_inertia = _copy_as_float64(self.engine.data.bodies.inv_I_i)
        is_fixed = (inv_mass == 0.0) & (inv_inertia == 0.0).all(axis=(1, 2))
        # Bodies that are fixed or have numbers that are not finite get the identity. J is 0 on the former, so M does
        # not matter; the latter make J v*, and thus the world, NaN.
        is_ordinary = np.isfinite(inv_mass) & np.isfinite(inv_inertia).all(axis=(1, 2)) & ~is_fixed
        inv_mass = np.where(is_ordinary, inv_mass, 1.0)
        inv_inertia = np.where(is_ordinary[:, None, None], inv_inertia, np.eye(3))
        is_singular = (inv_mass <= 0.0) | (np.linalg.det(inv_inertia) <= 0.0)
        if is_singular.any():
            body = int(np.flatnonzero(is_singular)[0])
            raise CapabilityError(
                f"body {body} ({self.engine._model.bodies.label[body]!r}) has a singular inverse mass or inertia, "
                "so it moves in some directions only; only free and static bodies are supported"
            )
        inertia = np.linalg.inv(inv_inertia)
        values = np.concatenate(
            [
                np.repeat(1.0 / inv_mass[:, None], 3, axis=1),
                inertia[(slice(None), *INERTIA_ENTRIES)],
            ],
            axis=1,
        )
        if self.layout.has_equal_bodies:
            return (values.reshape(self.n, -1), *self.layout.mass_pattern), is_fixed
        ptr = _cumulate_counts(self.columns**2)
        mass = np.zeros(ptr[-1])
        world = np.repeat(np.arange(self.n), self.bodies)
        corner = COLUMNS_PER_BODY * (np.arange(len(world)) - _cumulate_counts(self.bodies)[world])
        nv = self.columns[world]
        for row, column, entry in zip(BODY_ROW, BODY_COLUMN, values.T, strict=True):
            mass[ptr[world] + (corner + row) * nv + corner + column] = entry
            mass[ptr[world] + (corner + column) * nv + corner + row] = entry
        return mass, is_fixed

    def _compute_row_bounds(self, scale: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return lower bounds, upper bounds [N s] and friction coefficients of all rows; 0 on rows of joints."""
        problem, world, index = self.problem, self.world, self.index
        lower = np.full(len(index), -np.inf)
        upper = np.full(len(index), np.inf)
        mu = np.zeros(len(index))
        is_bounded = (index >= self.joints[world]) & (index < (self.joints + self.bounded)[world])
        if is_bounded.any():
            k = (_as_int(problem.bcio)[world] + index - self.joints[world])[is_bounded]
            lower[is_bounded] = scale[is_bounded] * _copy_as_float64(problem.bound_lower)[k]
            upper[is_bounded] = scale[is_bounded] * _copy_as_float64(problem.bound_upper)[k]
        is_limit = (index >= (self.joints + self.bounded)[world]) & ~self.is_contact_row
        lower[is_limit] = 0.0
        at = self.begins_contact
        k = (
            _as_int(problem.cio)[world] + (index - self.before_contacts[world]) // ROWS_PER_CONTACT
        )[at]
        mu[at] = _copy_as_float64(problem.mu)[k]
        return lower, upper, mu

    def _make_block_namer(self, first: np.ndarray) -> Callable[[int], list[str]]:
        """Return a function that returns the names of a world's blocks, given the first row of each block."""
        model = self.engine._model
        # World (c,), number within the world (c,) and bodies (c, 2) of each contact; body -1 is the ground.
        pairs = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2), int)
        if self.stored_contacts is not None and self.contacts.any():
            data = self.stored_contacts.data
            count = int(data.model_active_contacts.numpy()[0])
            pairs = tuple(x.numpy()[:count].copy() for x in (data.wid, data.cid, data.bid_AB))

        def name_blocks_of_world(i: int) -> list[str]:
            joints = model.joints
            own = np.flatnonzero(_as_int(joints.wid) == i).tolist()
            names = []
            for kind, stored, is_joined in (
                (", dynamics", joints.num_dynamic_cts, False),
                ("", joints.num_kinematic_cts, True),
                (", friction", joints.num_friction_cts, False),
                (", effort", joints.num_effort_cts, False),
            ):
                count = _as_int(stored)
                for joint in own:
                    repeats = min(int(count[joint]), 1) if is_joined else int(count[joint])
                    names += [f"joint {joints.label[joint]}{kind}"] * repeats
            names += [f"limit {k}" for k in range(int(self.limits[i]))]
            world, number, bodies = pairs
            for k in range(int(self.contacts[i])):
                pair = bodies[(world == i) & (number == k)].reshape(-1)[:2].tolist()
                sides = [model.bodies.label[b] if b >= 0 else "ground" for b in pair]
                names.append(f"contact {k}" + (f" ({', '.join(sides)})" if sides else ""))
            blocks = np.count_nonzero((first >= self.row_ptr[i]) & (first < self.row_ptr[i + 1]))
            return names if len(names) == blocks else [f"block {k}" for k in range(blocks)]

        return name_blocks_of_world

    def compare_delassus_matrix(self, i: int) -> float:
        """Return the largest difference of the engine's D from J M^-1 J^T in world i, relative to D's largest entry."""
        size = int(self.rows[i])
        first_body = int(self.layout.first_body[i])
        bodies = slice(first_body, first_body + int(self.bodies[i]))
        if size == 0:
            return 0.0
        start = int(_as_int(self.problem.mio)[i])
        stored = _copy_as_float64(self.problem.D[start : start + size * size]).reshape(size, size)
        sigma = float(self.engine.solver_fd.data.state.sigma.numpy()[i][0])
        first = int(_as_int(self.problem.vio)[i])
        scale = _copy_as_float64(self.problem.P[first : first + size])
        nv, begin = int(self.columns[i]), int(self.jacobian_start[i])
        jac = self.jacobian_values[begin : begin + size * nv].astype(float).reshape(size, nv)
        blocks = jac.reshape(size, -1, 2, 3)
        inv_mass, inv_inertia = (
            _copy_as_float64(x[bodies])
            for x in (self.engine._model.bodies.inv_m_i, self.engine.data.bodies.inv_I_i)
        )
        linear = np.einsum("ibk,b->ibk", blocks[:, :, 0], inv_mass)
        angular = np.einsum("ibk,bkl->ibl", blocks[:, :, 1], inv_inertia)
        product = np.stack([linear, angular], axis=2).reshape(size, nv) @ jac.T
        rows = slice(int(self.row_ptr[i]), int(self.row_ptr[i + 1]))
        product[self.source[rows], self.source[rows]] += self.compliance[rows]
        matrix = (stored - sigma * np.eye(size)) / np.outer(scale, scale)
        largest = np.abs(product).max(initial=0.0)
        return float(np.abs(matrix - product).max(initial=0.0) / largest) if largest > 0.0 else 0.0


def _verify_delassus_matrix(solver: Any, engine: Any, worlds: _Worlds, complete: bool) -> None:
    """Compare the engine's matrix D with J M^-1 J^T + diag(compliance), unless it was compared in an earlier step.

    `complete` compares the matrices of all worlds in any case.
    """
    soft = np.bincount(worlds.world, worlds.compliance != 0.0, minlength=worlds.n)
    kinds = {"joint": worlds.joints, "bounded": worlds.bounded, "limit": worlds.limits}
    kinds |= {"contact": worlds.contacts, "soft": soft}
    layout = worlds.bodies.tobytes(), _as_int(worlds.problem.maxdim).tobytes()
    known = _VERIFIED.get(solver)
    verified = known[1] if known is not None and known[0] == layout else frozenset()
    new = [name for name, count in kinds.items() if count.any() and name not in verified]
    if complete:
        chosen = np.arange(worlds.n)
    elif new:
        most_rows = np.argsort(-worlds.rows, kind="stable")[:MAX_VERIFIED_WORLDS]
        chosen = np.unique([*most_rows, *(int(np.argmax(kinds[name])) for name in new)])
    else:
        return
    for i in chosen.tolist():
        difference = worlds.compare_delassus_matrix(i)
        if difference > MATRIX_TOLERANCE:
            raise CapabilityError(
                f"world {i}: the engine's matrix differs from J M^-1 J^T + compliance by {difference:.1e} of its "
                f"largest entry (rows: {', '.join(name for name, count in kinds.items() if count[i])}). The arrays are "
                f"not those of one step, or this version stores them otherwise. {KAMINO_ADVICE}"
            )
    _VERIFIED[solver] = layout, verified | frozenset(new)


def _as_int(array: Any) -> np.ndarray:
    """Copy an integer array of the engine to the host as int64."""
    return array.numpy().astype(np.int64)


def _copy_as_float64(array: Any) -> FloatArray:
    """Copy an array of the engine to the host as float64."""
    return array.numpy().astype(float)


def _cumulate_counts(counts: np.ndarray) -> np.ndarray:
    """Return 0 and the sums of the first 1, 2, ... counts."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
