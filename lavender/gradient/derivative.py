"""A solution differentiated: prepared once, then both ways, and what says whether it exists."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, as_array, as_csr
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import issparse, lazy_module
from lavender.gradient.chains import Bodies, Parts
from lavender.gradient.result import BODIES, INPUTS, MATRICES, REACHES, Gradient
from lavender.gradient.system import SMALL, System, prepared
from lavender.judge.residuals import residual
from lavender.judge.states import States, linear_of, states_of
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property
from lavender_ext.core.problem import rows_velocity
from lavender_ext.derivative.linear import CASES, Linear, wrench

ACCEPTED = 1e-8  # relative residual of an answer that is differentiated, or its floor
UNMOVED = 1e-6  # of the largest entry of a probe, up to which one is rounding
CONTRADICTS = 1e-3  # of the lengths of a change and of a probe: what the two have in common
MANY = 10.0  # errors of the answer within which a switch counts as one: they are estimates of first order
U = 2.0**-53

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Unique:
    """What of an answer, and of its derivative, the problem determines. `str()` says what it does not."""

    impulse: Flags  # (m,) the row's impulse
    slack: Flags  # (m,) the row's slack, and velocity along it
    velocity: bool  # every body's; of a matrix that of all slacks
    target: Flags  # (m,) whether b of this row may change alone with no block changing its state
    _problem: Problem = field(repr=False)

    def __bool__(self) -> bool:
        return bool(self.impulse.all() and self.slack.all() and self.target.all())

    def __str__(self) -> str:
        lines = []
        for name, flags in (("impulse", self.impulse), ("slack", self.slack), ("target", self.target)):
            off = np.flatnonzero(~flags)
            if len(off):
                some = ", ".join(self._problem.row_name(int(i)) for i in off[:3])
                lines.append(f"{name}: not of {len(off)} rows ({some}{', ...' if len(off) > 3 else ''})")
        return "; ".join(lines) or "all of it is unique"


@dataclass(frozen=True, eq=False)
class Tangent:
    """How a solution changes along a change of the data: `Derivative.jvp`."""

    slack: FloatArray  # (m,) m/s, of w
    _velocity: FloatArray | None
    _impulse: FloatArray
    _of: Derivative = field(repr=False)

    @property
    def impulse(self) -> FloatArray:
        """(m,) N s; CapabilityError where rows repeat others, so that it is not unique."""
        if not self._of.unique.impulse.all():
            raise CapabilityError(f"impulses are not unique here: {self._of.unique}; slack and velocity are")
        return self._impulse

    @property
    def velocity(self) -> FloatArray:
        """v+ (nv,) or (n, 6) [m/s, rad/s]; CapabilityError of a matrix."""
        if self._velocity is None:
            raise CapabilityError("this problem was given as a matrix; velocities need J and M")
        return self._velocity


class Derivative:
    """The derivative of a solution, prepared once: gradients by `vjp`, directions by `jvp`, and whether it exists.

    Made by `lavender.derivative`.
    """

    def __init__(self, problem: Problem, linear: Linear) -> None:
        self.problem, self._linear, self.m = problem, linear, problem.m
        if not linear.tried and linear.rows <= SMALL:
            prepared(problem.disk, linear)
        regular = linear.regular if linear.rows <= SMALL else self._system.of_kernel
        general = problem.generalized
        # The kernel has all that `vjp` needs, in the order given.
        self._plain = regular and not problem.cones.has_ellipse and (general is None or general.order is None)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is prepared anew."""
        return derivative, (self.problem, self._impulse)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the data that this problem has, by which there are gradients."""
        return tuple(name for name, of in INPUTS.items() if self.problem.operator in of)

    @cached_property
    def _system(self) -> System:
        return System(self.problem.disk, self._linear)

    @cached_property
    def _impulse(self) -> FloatArray:
        impulse: FloatArray = self._linear.impulse
        return impulse * self.problem.cones.stretch if self.problem.cones.has_ellipse else impulse

    @cached_property
    def _root(self) -> FloatArray:
        root: FloatArray = self._linear.root
        return root / self.problem.cones.stretch if self.problem.cones.has_ellipse else root

    @cached_property
    def _slack(self) -> FloatArray:
        w: FloatArray = self._linear.slack
        return w / self.problem.cones.stretch if self.problem.cones.has_ellipse else w

    @cached_property
    def _places(self) -> Any:
        return np.flatnonzero(self._linear.place >= 0)

    def _velocities(self) -> tuple[int, ...]:
        """Shape of the velocities; CapabilityError of a matrix."""
        p = self.problem
        if p.generalized is not None:
            return (p.generalized.nv,)
        if p.rows is None:
            raise CapabilityError("this problem was given as a matrix; velocities need J and M")
        return p.rows.n_bodies, 6

    # -- products --------------------------------------------------------------------------------

    def _through_mass(self, y: FloatArray) -> FloatArray:
        """M^-1 y (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.solve(y)
        rows = p.rows
        assert rows is not None
        out, y = np.empty((rows.n_bodies, 6)), y.reshape(-1, 6)
        out[:, :3] = rows.inv_mass[:, None] * y[:, :3]
        out[:, 3:] = np.einsum("ijk,ik->ij", rows.inv_inertia, y[:, 3:])
        return out.ravel()

    def _along(self, v: FloatArray) -> FloatArray:
        """J v (m,) of velocities (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.velocity_of(v)
        out = np.empty(p.m)
        rows_velocity(p.data, v.reshape(-1, 6), out)
        return out

    def _wrench(self, x: FloatArray) -> FloatArray:
        """J^T x (nv,)."""
        p = self.problem
        if p.rows is None:
            return np.asarray(p.jacobian.T @ x)
        out = np.empty((p.rows.n_bodies, 6))
        wrench(p.data, np.ascontiguousarray(x), out)
        return out.ravel()

    def _moved(self, x: FloatArray) -> FloatArray:
        """M^-1 J^T x (nv,)."""
        if self.problem.generalized is not None:
            return self.problem.generalized.change(x)
        return self._through_mass(self._wrench(x))

    def _a(self, x: FloatArray, back: bool = False) -> FloatArray:
        """A x, or A^T x."""
        p = self.problem
        if p.matrix is not None:
            return np.asarray((p.matrix.T if back else p.matrix) @ x)
        assert p.compliance is not None
        return self._along(self._moved(x)) + p.compliance * x

    @cached_property
    def _change(self) -> FloatArray:
        return self._moved(self._impulse)

    @cached_property
    def _velocity(self) -> FloatArray:
        p = self.problem
        free = p.generalized.v_free if p.generalized is not None else p.rows.v_free.ravel()  # type: ignore[union-attr]
        return free + self._change

    @cached_property
    def _parts(self) -> Parts:
        return Parts(self.problem)

    @cached_property
    def _acting(self) -> FloatArray:
        # (2, m) how much lower and upper bounds act: of lower = upper, which move together, half each
        case, c = self._linear.case, self.problem.cones
        acts = np.array([case == CASES["low"], case == CASES["high"]], np.float64)
        return np.where(acts.any(axis=0) & (c.lower == c.upper), 0.5, acts)

    @cached_property
    def _axes(self) -> tuple[Any, FloatArray, FloatArray]:
        # Rows of ellipses, where root_j = c / e_j: what de_j changes in z and, through P, in y.
        rows = np.flatnonzero(np.repeat(self._parts.ellipse, np.diff(self.problem.cones.ptr)))
        rows = rows[self.problem.cones.friction_rows[rows]]
        root, e = self._root[rows], self.problem.cones.reach[rows]
        lam, w = self._impulse[rows], self._slack[rows]
        live = e > 0.0
        e = np.where(live, e, 1.0)
        return rows, np.where(live, root * lam / e, 0.0), np.where(live, (root * lam + w / root) / e, 0.0)

    @cached_property
    def _bodies(self) -> Any:
        return Bodies(self)

    def _solve(self, r: FloatArray, exactly: bool = False) -> FloatArray:
        """G x = r of all rows; `exactly`: or an error where there is no x."""
        out, at = r.copy(), self._places
        out[at] = 0.0
        known = self._linear.times(self._a(out / self._root) / self._root) if out.any() else 0.0
        right = (r - known)[at]
        if exactly and self._system.singular and self._contradicts(right):
            self._refuse_alone("no derivative along this change exists")
        out[at] = self._system.solve(right)
        return out

    def _contradicts(self, right: FloatArray) -> bool:
        """Whether G x = r has no solution."""
        size = CONTRADICTS * float(np.linalg.norm(right))
        return any(abs(float(q @ right)) > size * float(np.linalg.norm(q)) for q in self._system.probes(True))

    def _refuse_alone(self, words: str) -> None:
        """Of what changes one row of several that share a load."""
        if not self._system.singular:
            return
        off = np.flatnonzero(~self.unique.target)
        if len(off):
            some = ", ".join(self.problem.row_name(int(i)) for i in off[:3])
            raise CapabilityError(
                f"{words}: {some}{', ...' if len(off) > 3 else ''} share a load with other rows and cannot change "
                "alone, where one of them would open. By v_free and masses there is one, under Coulomb's law by mu; "
                "with a compliance on these rows by all data"
            )

    def _refuse_reach(self, name: str) -> None:
        """Of a coefficient: under the cone law w_n = mu |w_t| + mu r |w_s| + mu_r |w_r|, a target that it moves."""
        if self.problem.law != "cone" or not self._system.singular:
            return
        cones, at = self.problem.cones, self._places
        all_at_once = np.ones(cones.n_blocks)
        r = self._by_reach(self._parts.reaches(*(all_at_once if name == key else None for key in REACHES)))[
            at
        ]
        block = np.repeat(np.arange(cones.n_blocks), np.diff(cones.ptr))[at]  # r is of each block's own reach
        size = CONTRADICTS * np.sqrt(np.bincount(block, r * r))
        for q in self._system.probes(True):
            if (np.abs(np.bincount(block, q * r)) > size * float(np.linalg.norm(q))).any():
                self._refuse_alone(f"no derivative by {name} of one contact exists here (jvp: of several)")

    # -- both ways -------------------------------------------------------------------------------

    def vjp(self, *, velocity: Any = None, impulse: Any = None, slack: Any = None) -> Gradient:
        """Gradients of velocity . v+ + impulse . lambda + slack . w by all data, at the cost of one linear solve.

        Parameters
        ----------
        velocity : (nv,) or (n, 6), optional
            Cotangent of the velocities after the step, its unit the scalar's over m/s (rad/s).
        impulse : (m,), optional
            Cotangent of the impulses, per N s.
        slack : (m,), optional
            Cotangent of w, per m/s.

        Raises
        ------
        InputError
            A cotangent of another shape, not finite, or none at all.
        CapabilityError
            `velocity` of a matrix; an `impulse` that weighs what is not unique (`unique` says which rows).
        """
        p = self.problem
        if velocity is None and impulse is None and slack is None:
            raise InputError("give velocity=, impulse= or slack=: what the scalar weighs of the solution")
        made = self._linear.adjoint(velocity, impulse, slack) if self._plain else None
        if made is not None:
            return Gradient(self, made)
        y = None if velocity is None else as_array("velocity", velocity, self._velocities()).reshape(-1)
        c = np.zeros(p.m) if impulse is None else as_array("impulse", impulse, (p.m,))
        x = None if slack is None else as_array("slack", slack, (p.m,))
        return Gradient(self, (self._linear.adjoint if self._plain else self._adjoint)(y, c, x))

    def _adjoint(self, y: FloatArray | None, c: FloatArray, x: FloatArray | None) -> FloatArray:
        """(q, s (m), f (nv), c (m)) of (4), end to end, with f = y - J^T s; no f of a matrix."""
        p, right = self.problem, c.copy()
        if x is not None:
            right += self._a(x, True)
        if y is not None:
            right += self._along(self._through_mass(y))
        scaled, q = (right / self._root)[self._places], np.zeros(p.m)
        # Slacks and velocities are unique where A is that of bodies and the law is convex.
        if p.matrix is not None or p.law == "coulomb" or c.any():
            self._refuse_undetermined(scaled)
        q[self._places] = self._system.solve(scaled, True)
        s = self._linear.times(q, True) / self._root
        if x is not None:
            s -= x
        if p.matrix is not None:
            return np.concatenate([q, s, c])
        return np.concatenate([q, s, (0.0 if y is None else y) - self._wrench(s), c])

    def _refuse_undetermined(self, c: FloatArray) -> None:
        if not self._system.singular:
            return
        size = float(np.linalg.norm(c))
        if any(abs(float(x @ c)) > UNMOVED * size for x in self._null):
            raise CapabilityError(
                f"what is asked for is not unique here: {self.unique}. Ask for velocities, slacks, or sums of impulses "
                "that are"
            )

    def jvp(self, **changes: Any) -> Tangent:
        """How the solution changes along changes of the data, at the cost of one solve.

        Parameters
        ----------
        b, target, v_free, lower, upper, mu, patch_radius, rolling, compliance, A, J, M : array-like, optional
            Changes of the data that bear these names, of their shapes; mu also (k, 2). b= is a change of b itself;
            with target=, v_free= and J= b = target - J v* follows. M must be symmetric.
        jac, normal, tangent, arm_a, arm_b, inv_mass, inv_inertia : array-like, optional
            Changes of the arrays of bodies, `Rows`.

        Returns
        -------
        Tangent
            `.impulse` (m,) [N s], `.slack` (m,) [m/s], `.velocity` [m/s, rad/s], each per unit of the change.

        Raises
        ------
        InputError
            A name that this problem has no data of, another shape, numbers that are not finite, or none at all.
        """
        p, n = self.problem, self._linear
        given = self._checked(changes)
        r, push = np.zeros(p.m), np.zeros(p.m)  # push: dA lambda - db
        for name in ("b", "target"):
            push -= given.get(name, 0.0)
        for name, acts in zip(("lower", "upper"), self._acting, strict=True):
            r += acts * self._root * given.get(name, 0.0)
        wanted = [given.get(name) for name in REACHES]
        if any(x is not None for x in wanted):
            r += self._by_reach(self._parts.reaches(*wanted))
        dv: Any = None if p.matrix is not None else np.zeros(self._velocity.shape)
        if "A" in given:
            push += given["A"] @ self._impulse
        if "compliance" in given:
            push += given["compliance"] * self._impulse
        dj = self._bodies.jacobian(given) if p.rows is not None else given.get("J")
        if p.rows is not None and "J" in given:
            dj = given["J"] if dj is None else dj + given["J"]
        pulled = None  # dJ^T lambda - dM v'
        if dj is not None:
            push += dj @ self._velocity
            pulled = dj.T @ self._impulse
        if "M" in given:
            pulled = (0.0 if pulled is None else pulled) - given["M"] @ self._change
        if pulled is not None:
            dv += self._through_mass(pulled)
        if "inv_mass" in given or "inv_inertia" in given:
            dv += self._bodies.through(given, self._wrench(self._impulse))
        if dv is not None and dv.any():
            push += self._along(dv)
        if "v_free" in given:
            free = given["v_free"].ravel()
            push += self._along(free)
            dv = dv + free
        dz = self._solve(r - n.times(push / self._root), True)
        impulse = dz / self._root
        slack = self._a(impulse) + push
        if dv is not None:
            dv = (dv + self._moved(impulse)).reshape(self._velocities())
        return Tangent(slack, dv, impulse, self)

    def _by_reach(self, de: FloatArray) -> FloatArray:
        n = self._linear
        if not self.problem.cones.has_ellipse:
            return n.times(de, False, True)
        rows, own, through = self._axes
        x, y, rest = np.zeros(len(de)), np.zeros(len(de)), de.copy()
        x[rows], y[rows], rest[rows] = own * de[rows], through * de[rows], 0.0
        return n.times(rest, False, True) + x - n.times(y)

    def _checked(self, changes: dict[str, Any]) -> dict[str, Any]:
        p, out = self.problem, {}
        known = [name for name in self.inputs if name != "coefficients"]
        for name, value in changes.items():
            if name not in known:
                raise InputError(
                    f"{name!r} is no data of this problem ({p.operator}): there are {', '.join(known)}"
                )
            if name in MATRICES:
                like = p.matrix if name == "A" else p.jacobian if name == "J" else p.generalized.mass  # type: ignore[union-attr]
                out[name] = as_csr(name, value) if issparse(value) else as_array(name, value, like.shape)
                if out[name].shape != like.shape:
                    raise InputError(f"{name} has shape {out[name].shape}; {like.shape} is needed")
                if name == "M" and abs(out[name] - out[name].T).max() > 1e-12 * abs(out[name]).max():
                    raise InputError("the change of M is not symmetric; M is: give both triangles")
            elif name in REACHES:
                shape: tuple[int, ...] = (p.n_blocks,)
                out[name] = as_array(
                    name, value, (*shape, 2) if name == "mu" and np.ndim(value) == 2 else shape
                )
            elif name in BODIES or name == "v_free":
                like = getattr(p.rows if p.rows is not None else p.generalized, name)
                out[name] = as_array(name, value, like.shape)
            else:
                out[name] = as_array(name, value, (p.m,))
        if not out:
            raise InputError(f"give a change of the data: {', '.join(known)}")
        return out

    # -- whether it exists -----------------------------------------------------------------------

    @cached_property
    def _null(self) -> FloatArray:
        return self._system.probes(False)

    @cached_property
    def unique(self) -> Unique:
        """What is unique of the solution, row by row: rows that repeat others share their impulse in many ways."""
        p, m = self.problem, self.problem.m
        impulse, slack, target, velocity = np.ones((3, m), bool)[0], np.ones(m, bool), np.ones(m, bool), True
        at = self._places
        for z in self._null:
            x = np.zeros(m)
            x[at] = z
            size = np.abs(x).max()
            moved = np.abs(self._a(x / self._root) / self._root)
            impulse &= np.abs(x) <= UNMOVED * size
            slack &= moved <= UNMOVED * size
            velocity = velocity and bool(moved.max() <= UNMOVED * size)
        for q in self._system.probes(True):
            x = np.zeros(m)
            x[at] = q
            target &= np.abs(self._linear.times(x, True)) <= UNMOVED * np.abs(x).max()
        return Unique(impulse, slack, velocity, target, p)

    @cached_property
    def states(self) -> States:
        """What each block does, as `solution.states`, with a bound of the error that `distance_in_errors` estimates."""
        return states_of(self.problem, self._impulse, self._linear)

    @cached_property
    def _estimated_error(self) -> FloatArray:
        """(k,) N s: how far the next step of Newton's method would move each block, and rounding."""
        n, p = self._linear, self.problem
        with np.errstate(all="ignore"):
            size = np.abs(self._a_of_sizes()) + np.abs(p.b)
            rounding = U * size / self._root * np.random.default_rng(0).choice([-1.0, 1.0], p.m)
            error = np.zeros(p.m)
            for r in (-n.residual, n.times(rounding)):
                dz = self._solve(r)
                ds = self._a(dz / self._root) / self._root
                error += np.abs(dz - ds) / self._root
            error += 4.0 * U * size / self._root**2
        first = p.cones.ptr[:-1]
        return np.maximum.reduceat(np.nan_to_num(error, nan=np.inf), first) if len(first) else error

    def _a_of_sizes(self) -> FloatArray:
        """|A| |lambda|, or no less where A is not formed."""
        p, x = self.problem, np.abs(self._impulse)
        if p.matrix is not None or p.rows is not None:
            return np.asarray(abs(p.csr) @ x)
        y = abs(p.whitened)
        assert p.compliance is not None
        return np.asarray(y @ (y.T @ x) + p.compliance * x)

    @property
    def distance(self) -> FloatArray:
        """(k,) N s (N m s on angular rows): of each block to its nearest other state, inf without one."""
        return self.states.margin

    @property
    def distance_in_errors(self) -> FloatArray:
        """(k,) the same over an estimate of the solution's error there: one step of Newton's method, and rounding."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found: FloatArray = np.where(self.distance == 0.0, 0.0, self.distance / self._estimated_error)
        return found

    @cached_property
    def switching(self) -> tuple[int, ...]:
        """Blocks within ten estimated errors of another state: there are several derivatives, this one is of
        `states[i].name`.
        """
        return tuple(int(i) for i in np.flatnonzero(self.distance_in_errors <= MANY))

    @property
    def exists(self) -> bool:
        """No block is about to switch, and every target may change alone."""
        return not self.switching and bool(self.unique.target.all())

    @property
    def motions(self) -> Any:
        """The `SolutionSet` that solve this problem, as `lavender.find_solutions` finds them when first asked.

        Under Coulomb's law there may be several: a gradient is then of this one, whose choice it does not know.
        """
        return lazy_module("lavender.lab.motion").get_solutions(self.problem.disk)

    def __repr__(self) -> str:
        return f"<Derivative of {self.m} rows: {self}>"

    def __str__(self) -> str:
        words = [repr(self.states)]
        if self.switching:
            names = ", ".join(
                self.problem.row_name(int(self.problem.cones.ptr[i])) for i in self.switching[:3]
            )
            words.append(f"{len(self.switching)} about to switch ({names}): one of several derivatives")
        if not self.unique:
            words.append(f"not unique: {self.unique}")
        return "; ".join(words)


def derivative(problem: Problem, solution: Any) -> Derivative:
    """The derivative of a problem's solution by all of its data, prepared once.

    Parameters
    ----------
    problem : Problem
    solution : Solution, or (m,) N s
        Any solver's answer, or an impulse; the judge must accept it to 1e-8, or to its floor.

    Returns
    -------
    Derivative
        `.vjp(velocity=, impulse=)` gives gradients by all data, `.jvp(b=, mu=, ...)` changes of the answer; `.states`,
        `.distance`, `.switching`, `.unique` and `.motions` say where it is one of several or does not exist.

    Raises
    ------
    InputError
        An impulse of the wrong length, or an answer with a larger residual: of another problem, or not solved.

    References
    ----------
    Dontchev, Rockafellar, Implicit Functions and Solution Mappings, 2009; the derivation is in docs/derivatives.md.

    Examples
    --------
    A box of 1 kg slides and its friction takes mu times its weight: dv/dmu = -1 N s / 1 kg.

    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.contact(np.eye(3), [1.0, -5.0, 0.0], mu=[0.5])  # w = v + A lambda
    >>> d = lv.derivative(problem, lv.solve(problem, tol=1e-12))
    >>> d.states, d.switching
    (1 slides, ())
    >>> d.vjp(slack=[0.0, 1.0, 0.0]).mu.tolist()  # m/s
    [-1.0]
    """
    check_problem(problem)
    x = problem.impulse_array(getattr(solution, "impulse", solution))
    linear = linear_of(problem, x, SMALL)
    if not linear.above_floor <= ACCEPTED:
        found = residual(problem, x, "float64")
        if not (found.nothing_to_do and found.rounds):
            raise InputError(
                f"this is no solution of this problem: its relative residual is {found.relative:.2e}; a derivative "
                f"needs {ACCEPTED:g} or the floor ({found.roundoff_floor:.1e}): solve with tol=1e-10, or give the "
                "problem that it solves"
            )
    return Derivative(problem, linear)
