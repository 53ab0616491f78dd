"""M^-1 and J of a problem for the motion error: changes of velocity, norms, and bounds of their rounding.

    |x|_A^2 = x.A x = (J^T x).M^-1 (J^T x) + sum theta x^2        A = J M^-1 J^T + diag(theta)       (1)

Half of (1) is an energy [J]: its first part kinetic, its second elastic. Bounds of rounding follow Higham
(Accuracy and Stability of Numerical Algorithms, 2002, section 3.1): a sum of n products in any order is wrong by at
most n u / (1 - n u) times the same sum of absolute values, u = 2^-53. J, M^-1 or M, and theta count as exact as they
are stored (`Problem.jacobian`, `Rows.inv_mass`, `Rows.inv_inertia`, `Generalized.mass`, `Problem.compliance`); a
matrix A is replaced by its symmetric part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem

U = 2.0**-53  # Unit round-off of float64.
# Rounding may make an eigenvalue of an inverse inertia negative by up to this fraction of the largest one; a more
# negative eigenvalue makes the inverse inertia indefinite.
NEGATIVE_EIGENVALUE_TOL = 1e-12
# Largest number of generalised velocities of one tree: its M is inverted as a dense matrix.
MAX_TREE_VELOCITIES = 2000


@dataclass(frozen=True)
class Size:
    """Energy norm sqrt(1/2 |x|_A^2) [sqrt J] of an impulse difference x that is known up to a given uncertainty.

    Parameters
    ----------
    kinetic : float or None
        Root of the kinetic part, as computed; None if M is not known.
    energy : float
        Root of the kinetic and elastic part, as computed.
    upper_bound : float
        Upper bound of `energy` of any x within the uncertainty, rounding included.
    """

    kinetic: float | None
    energy: float
    upper_bound: float


class Operator:
    """Interface of all operators, with x (m,) [N s]; this class implements it for a matrix A, without velocities."""

    def __init__(self, problem: Problem) -> None:
        self.b = problem.b
        a = problem.csr
        self.asymmetry = 0.0 if problem.is_symmetric else problem.asymmetry
        self.a = a if problem.asymmetry == 0.0 else sp.csr_array(0.5 * (a + a.T))
        self.abs_a = abs(self.a)
        self.slack_gamma = _bound_sum_rounding(int(np.diff(self.a.indptr).max(initial=0)) + 3)
        self.semidefinite = problem.is_semidefinite

    def explain_refusal(self) -> str | None:
        """Return the reason why (1) is not an energy, or None if it is."""
        if self.asymmetry > 0.0:
            return f"A is not symmetric (by {self.asymmetry:.1e})"
        return None if self.semidefinite else "A is not positive semidefinite"

    def compute_slack_with_rounding_bound(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute w = A x - b (m,) [m/s] and a bound of its rounding."""
        return self.a @ x - self.b, self.slack_gamma * (self.abs_a @ np.abs(x) + np.abs(self.b))

    def compute_energy_norm(self, x: FloatArray, uncertainty: FloatArray) -> Size:
        """Compute sqrt(1/2 x.A x) [sqrt J], and its upper bound for every impulse within `uncertainty` (m,) of x."""
        y = np.abs(x)
        square = max(float(x @ (self.a @ x)), 0.0)
        rounding = (self.slack_gamma + _bound_sum_rounding(len(x) + 1)) * float(y @ (self.abs_a @ y))
        uncertain_part = float(uncertainty @ (self.abs_a @ uncertainty))
        upper_bound = (
            np.sqrt(0.5)
            * (np.sqrt(square + rounding) + np.sqrt(uncertain_part))
            * (1.0 + _bound_sum_rounding(len(x) + 64))
        )
        return Size(None, float(np.sqrt(0.5 * square)), float(upper_bound))

    def compute_velocity(
        self, x: FloatArray, uncertainty: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Compute M^-1 J^T x, (n, 6) or (nv,) [m/s, rad/s], and a bound of its error; None if M is not known."""
        return None

    def compute_speeds(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Compute speed and spin of each body, or (magnitude of each generalised velocity, None)."""
        raise NotImplementedError

    def get_name(self, i: int) -> str:
        """Return the name of body or generalised velocity i."""
        return ""

    def bound_speeds(self, energy: float) -> tuple[float, float | None] | None:
        """Return the largest speed and spin of a body (or velocity, None) at a kinetic energy of energy^2 [J]."""
        return None


def make_operator(problem: Problem) -> Operator:
    """Build the operator of a problem by its form: A, J and M^-1 of bodies, or J and M in generalised coordinates."""
    if problem.rows is not None:
        return _Bodies(problem)
    return Operator(problem) if problem.generalized is None else _Velocities(problem)


class _Factored(Operator):
    """Operator of J and M^-1. `off` is an entrywise error bound of M^-1, or None if M^-1 is exact as stored."""

    def __init__(self, problem: Problem, minv: sp.csr_array, off: sp.csr_array | None) -> None:
        assert problem.compliance is not None
        self.b, self.theta = problem.b, problem.compliance
        self.jac, self.minv, self.off = problem.jacobian, minv, off
        self.jac_t = sp.csr_array(self.jac.T)
        self.abs_jac = abs(self.jac)
        self.abs_minv = abs(minv) if off is None else sp.csr_array(abs(minv) + off)
        self.abs_jac_t = sp.csr_array(self.abs_jac.T)
        self.nv = minv.shape[0]
        column, row, minv_entries = (
            int(np.diff(x.indptr).max(initial=0)) for x in (self.jac_t, self.jac, minv)
        )
        # Relative rounding bounds of one entry of J^T x, of M^-1 J^T x, and of J M^-1 J^T x + theta x - b.
        self.wrench_gamma = _bound_sum_rounding(column + 1)
        self.velocity_gamma = _bound_sum_rounding(column + minv_entries + 1)
        self.slack_gamma = _bound_sum_rounding(column + row + minv_entries + 5)

    def compute_slack_with_rounding_bound(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = self.jac @ (self.minv @ (self.jac_t @ x)) + self.theta * x - self.b
        y = np.abs(x)
        g = self.abs_jac_t @ y
        off = self.slack_gamma * (self.abs_jac @ (self.abs_minv @ g) + self.theta * y + np.abs(self.b))
        if self.off is not None:
            off += 1.01 * (self.abs_jac @ (self.off @ g))
        return w, off

    def compute_energy_norm(self, x: FloatArray, uncertainty: FloatArray) -> Size:
        g = self.jac_t @ x
        h = np.abs(g)
        off = self.abs_jac_t @ (self.wrench_gamma * np.abs(x) + 1.01 * uncertainty)  # Error bound of J^T x.
        square = max(float(g @ (self.minv @ g)), 0.0)
        rounding = _bound_sum_rounding(self.nv + 4) * float(h @ (self.abs_minv @ h))
        if self.off is not None:
            rounding += 1.01 * float(h @ (self.off @ h))
        uncertain_part = float(off @ (self.abs_minv @ off))
        elastic = float(np.sum(self.theta * x * x))
        max_elastic = float(np.sum(self.theta * (np.abs(x) + uncertainty) ** 2))
        root = np.sqrt(square + rounding) + np.sqrt(uncertain_part)
        upper_bound = np.sqrt(0.5 * (root * root + max_elastic)) * (
            1.0 + _bound_sum_rounding(len(x) + self.nv + 64)
        )
        return Size(
            float(np.sqrt(0.5 * square)), float(np.sqrt(0.5 * (square + elastic))), float(upper_bound)
        )

    def compute_velocity(
        self, x: FloatArray, uncertainty: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        y = np.abs(x)
        g = self.abs_jac_t @ y
        off = self.abs_minv @ (self.velocity_gamma * g + self.abs_jac_t @ (1.01 * uncertainty))
        if self.off is not None:
            off += 1.01 * (self.off @ g)
        return self._reshape_velocities(self.minv @ (self.jac_t @ x)), self._reshape_velocities(off)

    def _reshape_velocities(self, v: FloatArray) -> FloatArray:
        """Return a vector of velocities in the shape of the public result."""
        return v


class _Bodies(_Factored):
    """Operator of bodies, with six velocities each."""

    def __init__(self, problem: Problem) -> None:
        rows = problem.rows
        assert rows is not None
        super().__init__(problem, rows.inverse_mass_matrix(), None)
        inv_inertia_eigenvalues = np.linalg.eigvalsh(rows.inv_inertia) if rows.n_bodies else np.zeros((0, 3))
        self.speed_per_root_energy = float(np.sqrt(2.0 * rows.inv_mass.max(initial=0.0)))
        self.spin_per_root_energy = float(np.sqrt(2.0 * inv_inertia_eigenvalues.max(initial=0.0)))
        self.indefinite = bool(
            np.any(
                inv_inertia_eigenvalues[:, 0]
                < -NEGATIVE_EIGENVALUE_TOL * np.abs(inv_inertia_eigenvalues).max(axis=1)
            )
            if len(inv_inertia_eigenvalues)
            else False
        )

    def explain_refusal(self) -> str | None:
        return "an inverse inertia has a negative eigenvalue" if self.indefinite else None

    def _reshape_velocities(self, v: FloatArray) -> FloatArray:
        return v.reshape(-1, 6)

    def compute_speeds(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        return np.linalg.norm(velocity[:, :3], axis=1), np.linalg.norm(velocity[:, 3:], axis=1)

    def get_name(self, i: int) -> str:
        return f"body {i}"

    def bound_speeds(self, energy: float) -> tuple[float, float | None] | None:
        # 1/2 m |v|^2 <= energy^2 holds for every body. The factor 1 + 1e-9 covers the rounding of eigenvalues.
        return self.speed_per_root_energy * energy * (1.0 + 1e-9), self.spin_per_root_energy * energy * (
            1.0 + 1e-9
        )


class _Velocities(_Factored):
    """Operator of generalised velocities, each in m/s or rad/s; M^-1 = X (1 - R)^-1 with R = 1 - M X."""

    def __init__(self, problem: Problem) -> None:
        general = problem.generalized
        assert general is not None
        self.general = general
        trees, mass = general.trees, general.mass
        sizes = np.bincount(trees) if len(trees) else np.zeros(0, np.int64)
        if sizes.max(initial=0) > MAX_TREE_VELOCITIES:
            raise CapabilityError(
                f"M couples {sizes.max()} velocities of one tree; motion errors invert M tree by tree, for "
                f"up to {MAX_TREE_VELOCITIES} velocities: use the residual of such a problem"
            )
        blocks, offs, tree_indices = [], [], []
        for tree in range(len(sizes)):
            indices = np.flatnonzero(trees == tree)
            m = mass[indices][:, indices].toarray()
            x = np.linalg.inv(m)
            x = 0.5 * (x + x.T)
            remainder = np.abs(np.eye(len(m)) - m @ x) + _bound_sum_rounding(len(m) + 2) * (
                np.abs(m) @ np.abs(x)
            )
            off = 2.0 * np.abs(x) @ remainder  # |X| |R| / (1 - |R|), |R| <= 1/2
            blocks.append(x)
            offs.append(off if remainder.sum(axis=1).max(initial=0.0) <= 0.5 else np.full_like(off, np.inf))
            tree_indices.append(indices)
        inverse_order = np.argsort(np.concatenate(tree_indices)) if tree_indices else np.zeros(0, np.intp)
        empty = sp.csr_array((general.nv, general.nv))
        minv, off = (
            sp.csr_array(
                sp.csr_array(sp.block_diag(list(map(sp.coo_array, x))))[inverse_order][:, inverse_order]
            )
            if x
            else empty
            for x in (blocks, offs)
        )
        super().__init__(problem, minv, off)
        self.velocity_per_root_energy = np.sqrt(2.0 * (minv.diagonal() + off.diagonal()))

    def explain_refusal(self) -> str | None:
        return None if np.isfinite(self.velocity_per_root_energy).all() else "M is singular to rounding"

    def compute_speeds(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        return np.abs(velocity), None

    def get_name(self, i: int) -> str:
        return self.general.velocity_name(i)

    def bound_speeds(self, energy: float) -> tuple[float, float | None] | None:
        # v_i^2 <= (M^-1)_ii |v|_M^2
        return float(self.velocity_per_root_energy.max(initial=0.0)) * energy * (1.0 + 1e-9), None


def _bound_sum_rounding(n: int) -> float:
    """Bound n u / (1 - n u) from above for every n below 1e13."""
    return 1.01 * n * U
