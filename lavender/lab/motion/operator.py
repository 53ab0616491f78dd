"""M^-1 and J of a problem as the motion error reads them: changes of velocity, norms, and their rounding.

    |x|_A^2 = x.A x = (J^T x).M^-1 (J^T x) + sum theta x^2        A = J M^-1 J^T + diag(theta)       (1)

Half of (1) is an energy [J]: its first part kinetic, its second elastic. Bounds of rounding are those of
Higham (Accuracy and Stability of Numerical Algorithms, 2002, section 3.1): a sum of n products in any
order is off by at most n u / (1 - n u) times the same sum of absolute values, u = 2^-53. J, M^-1 or M, and theta
count as exact as they are stored (`Problem.jacobian`, `Rows.inv_mass`, `Rows.inv_inertia`, `Generalized.mass`,
`Problem.compliance`); a matrix A counts by its symmetric part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem

U = 2.0**-53
# -, of the largest eigenvalue of an inverse inertia: by what rounding may have made one negative
SHIFT = 1e-12
LARGEST_TREE = 2000  # generalised velocities of one tree, whose M is inverted, dense


@dataclass(frozen=True)
class Size:
    """sqrt(1/2 |x|_A^2) of a change of impulse x that is known up to a fuzz [sqrt J]."""

    kinetic: float | None  # as computed; None where M is not known
    energy: float  # as computed, elastic part included
    most: float  # no less than `energy` of any x within the fuzz, rounding included


class Operator:
    """What every kind of operator offers; x (m,) [N s]. Here what a matrix A can tell: nothing of velocities."""

    def __init__(self, problem: Problem) -> None:
        self.b = problem.b
        a = problem.csr
        self.asymmetry = 0.0 if problem.is_symmetric else problem.asymmetry
        self.a = a if problem.asymmetry == 0.0 else sp.csr_array(0.5 * (a + a.T))
        self.size_of_a = abs(self.a)
        self.of_slack = _gamma(int(np.diff(self.a.indptr).max(initial=0)) + 3)
        self.semidefinite = problem.is_semidefinite

    def refusal(self) -> str | None:
        """Why (1) is no energy, or None where it is one."""
        if self.asymmetry > 0.0:
            return f"A is not symmetric (by {self.asymmetry:.1e})"
        return None if self.semidefinite else "A is not positive semidefinite"

    def slack(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """w = A x - b (m,) [m/s] and a bound of its rounding."""
        return self.a @ x - self.b, self.of_slack * (self.size_of_a @ np.abs(x) + np.abs(self.b))

    def size(self, x: FloatArray, fuzz: FloatArray) -> Size:
        """Energy norm of x, every entry known up to `fuzz` (m,)."""
        y = np.abs(x)
        square = max(float(x @ (self.a @ x)), 0.0)
        rounding = (self.of_slack + _gamma(len(x) + 1)) * float(y @ (self.size_of_a @ y))
        wrong = float(fuzz @ (self.size_of_a @ fuzz))
        most = np.sqrt(0.5) * (np.sqrt(square + rounding) + np.sqrt(wrong)) * (1.0 + _gamma(len(x) + 64))
        return Size(None, float(np.sqrt(0.5 * square)), float(most))

    def velocity(self, x: FloatArray, fuzz: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """M^-1 J^T x, (n, 6) or (nv,) [m/s, rad/s], and a bound of what is lost in it; None where M is not known."""
        return None

    def lengths(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Speed and spin of each body, or the size of each generalised velocity and None."""
        raise NotImplementedError

    def name(self, i: int) -> str:
        """Name of body or velocity i."""
        return ""

    def reach(self, energy: float) -> tuple[float, float | None] | None:
        """Largest speed and spin of any body (size of any velocity, None) at a kinetic energy of energy^2 [J]."""
        return None


def make(problem: Problem) -> Operator:
    """The operator of a problem, with what its norms need; O(nnz), and M^-1 by trees in generalised coordinates."""
    if problem.rows is not None:
        return _Bodies(problem)
    return Operator(problem) if problem.generalized is None else _Velocities(problem)


class _Factored(Operator):
    """J and M^-1, which is known up to `off` (same shape, or None where it is as stored)."""

    def __init__(self, problem: Problem, minv: sp.csr_array, off: sp.csr_array | None) -> None:
        assert problem.compliance is not None
        self.b, self.theta = problem.b, problem.compliance
        self.jac, self.minv, self.off = problem.jacobian, minv, off
        self.jac_t = sp.csr_array(self.jac.T)
        self.size_of_jac = abs(self.jac)
        self.size_of_minv = abs(minv) if off is None else sp.csr_array(abs(minv) + off)
        self.size_of_jac_t = sp.csr_array(self.size_of_jac.T)
        self.nv = minv.shape[0]
        column, row, wide = (int(np.diff(x.indptr).max(initial=0)) for x in (self.jac_t, self.jac, minv))
        # Operations on one entry of J^T x, of M^-1 J^T x, and of J M^-1 J^T x + theta x - b.
        self.of_wrench = _gamma(column + 1)
        self.of_velocity = _gamma(column + wide + 1)
        self.of_slack = _gamma(column + row + wide + 5)

    def slack(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = self.jac @ (self.minv @ (self.jac_t @ x)) + self.theta * x - self.b
        y = np.abs(x)
        g = self.size_of_jac_t @ y
        off = self.of_slack * (self.size_of_jac @ (self.size_of_minv @ g) + self.theta * y + np.abs(self.b))
        if self.off is not None:
            off += 1.01 * (self.size_of_jac @ (self.off @ g))
        return w, off

    def size(self, x: FloatArray, fuzz: FloatArray) -> Size:
        g = self.jac_t @ x
        h = np.abs(g)
        off = self.size_of_jac_t @ (self.of_wrench * np.abs(x) + 1.01 * fuzz)  # of g
        square = max(float(g @ (self.minv @ g)), 0.0)
        rounding = _gamma(self.nv + 4) * float(h @ (self.size_of_minv @ h))
        if self.off is not None:
            rounding += 1.01 * float(h @ (self.off @ h))
        wrong = float(off @ (self.size_of_minv @ off))
        elastic = float(np.sum(self.theta * x * x))
        most_elastic = float(np.sum(self.theta * (np.abs(x) + fuzz) ** 2))
        moving = np.sqrt(square + rounding) + np.sqrt(wrong)
        most = np.sqrt(0.5 * (moving * moving + most_elastic)) * (1.0 + _gamma(len(x) + self.nv + 64))
        return Size(float(np.sqrt(0.5 * square)), float(np.sqrt(0.5 * (square + elastic))), float(most))

    def velocity(self, x: FloatArray, fuzz: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        y = np.abs(x)
        g = self.size_of_jac_t @ y
        off = self.size_of_minv @ (self.of_velocity * g + self.size_of_jac_t @ (1.01 * fuzz))
        if self.off is not None:
            off += 1.01 * (self.off @ g)
        return self._shaped(self.minv @ (self.jac_t @ x)), self._shaped(off)

    def _shaped(self, v: FloatArray) -> FloatArray:
        return v


class _Bodies(_Factored):
    """Six velocities a body."""

    def __init__(self, problem: Problem) -> None:
        rows = problem.rows
        assert rows is not None
        super().__init__(problem, rows.inverse_mass_matrix(), None)
        light = np.linalg.eigvalsh(rows.inv_inertia) if rows.n_bodies else np.zeros((0, 3))
        self.fastest = float(np.sqrt(2.0 * rows.inv_mass.max(initial=0.0)))
        self.swiftest = float(np.sqrt(2.0 * light.max(initial=0.0)))
        self.indefinite = bool(
            np.any(light[:, 0] < -SHIFT * np.abs(light).max(axis=1)) if len(light) else False
        )

    def refusal(self) -> str | None:
        return "an inverse inertia has a negative eigenvalue" if self.indefinite else None

    def _shaped(self, v: FloatArray) -> FloatArray:
        return v.reshape(-1, 6)

    def lengths(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        return np.linalg.norm(velocity[:, :3], axis=1), np.linalg.norm(velocity[:, 3:], axis=1)

    def name(self, i: int) -> str:
        return f"body {i}"

    def reach(self, energy: float) -> tuple[float, float | None] | None:
        # 1/2 m |v|^2 <= E^2 on every body; one part in 1e9 for the rounding of eigenvalues.
        return self.fastest * energy * (1.0 + 1e-9), self.swiftest * energy * (1.0 + 1e-9)


class _Velocities(_Factored):
    """Generalised velocities, each a number of its own [m/s or rad/s]; M^-1 = X (1 - R)^-1 with R = 1 - M X."""

    def __init__(self, problem: Problem) -> None:
        general = problem.generalized
        assert general is not None
        self.general = general
        trees, mass = general.trees, general.mass
        sizes = np.bincount(trees) if len(trees) else np.zeros(0, np.int64)
        if sizes.max(initial=0) > LARGEST_TREE:
            raise CapabilityError(
                f"M couples {sizes.max()} velocities; motion errors invert it by trees of up to {LARGEST_TREE}"
            )
        blocks, offs, places = [], [], []
        for tree in range(len(sizes)):
            place = np.flatnonzero(trees == tree)
            m = mass[place][:, place].toarray()
            x = np.linalg.inv(m)
            x = 0.5 * (x + x.T)
            rest = np.abs(np.eye(len(m)) - m @ x) + _gamma(len(m) + 2) * (np.abs(m) @ np.abs(x))
            off = 2.0 * np.abs(x) @ rest  # |X| |R| / (1 - |R|), |R| <= 1/2
            blocks.append(x)
            offs.append(off if rest.sum(axis=1).max(initial=0.0) <= 0.5 else np.full_like(off, np.inf))
            places.append(place)
        back = np.argsort(np.concatenate(places)) if places else np.zeros(0, np.intp)
        empty = sp.csr_array((general.nv, general.nv))
        minv, off = (
            sp.csr_array(sp.csr_array(sp.block_diag(list(map(sp.coo_array, x))))[back][:, back])
            if x
            else empty
            for x in (blocks, offs)
        )
        super().__init__(problem, minv, off)
        self.fast = np.sqrt(2.0 * (minv.diagonal() + off.diagonal()))

    def refusal(self) -> str | None:
        return None if np.isfinite(self.fast).all() else "M is singular to rounding"

    def lengths(self, velocity: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        return np.abs(velocity), None

    def name(self, i: int) -> str:
        return self.general.velocity_name(i)

    def reach(self, energy: float) -> tuple[float, float | None] | None:
        # v_i^2 <= (M^-1)_ii |v|_M^2
        return float(self.fast.max(initial=0.0)) * energy * (1.0 + 1e-9), None


def _gamma(n: int) -> float:
    return 1.01 * n * U  # n u / (1 - n u) for every n below 1e13
