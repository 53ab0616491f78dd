"""M^-1 and J of a problem as the motion error reads them: changes of velocity, norms, and their rounding.

    |x|_A^2 = x.A x = (J^T x).M^-1 (J^T x) + sum theta x^2        A = J M^-1 J^T + diag(theta)       (1)

Half of (1) is an energy [J]: its first part kinetic, its second elastic. Bounds of rounding are those of
Higham (Accuracy and Stability of Numerical Algorithms, 2002, section 3.1): a sum of n products in any
order is off by at most n u / (1 - n u) times the same sum of absolute values, u = 2^-53. J, M^-1 and theta
count as exact as they are stored (`Problem.jacobian`, `Rows.inv_mass`, `Rows.inv_inertia`,
`Problem.compliance`); a matrix A counts by its symmetric part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray
from lavender.problem import Problem

__all__ = ["Operator", "Size", "make"]

U = 2.0**-53
# A matrix counts as positive semidefinite where A + SHIFT D has a Cholesky factor, D = diag(d): entries that were
# rounded leave negative eigenvalues of about m 2^-53.
SHIFT = 1e-12


@dataclass(frozen=True)
class Size:
    """sqrt(1/2 |x|_A^2) of a change of impulse x that is known up to a fuzz [sqrt J]."""

    kinetic: float | None  # as computed; None where M is not known
    energy: float  # as computed, elastic part included
    most: float  # no less than `energy` of any x within the fuzz, rounding included


class Operator(Protocol):
    """What both kinds of operator offer; x (m,) [N s]."""

    def refusal(self) -> str | None:
        """Why (1) is no energy, or None where it is one."""
        ...

    def slack(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """w = A x - b (m,) [m/s] and a bound of its rounding."""
        ...

    def size(self, x: FloatArray, fuzz: FloatArray) -> Size:
        """Energy norm of x, every entry known up to `fuzz` (m,)."""
        ...

    def velocity(self, x: FloatArray, fuzz: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """M^-1 J^T x (n, 6) [m/s, rad/s] and a bound of what is lost in it, or None where M is not known."""
        ...

    def reach(self, energy: float) -> tuple[float, float] | None:
        """Largest speed [m/s] and spin [rad/s] of any body at a kinetic energy of energy^2 [J], or None."""
        ...


def make(problem: Problem) -> Operator:
    """The operator of a problem, with what its norms need; O(nnz)."""
    return _Factored(problem) if problem.rows is not None else _Matrix(problem)


class _Factored:
    def __init__(self, problem: Problem) -> None:
        rows = problem.rows
        assert rows is not None and problem.compliance is not None
        self.b, self.theta = problem.b, problem.compliance
        self.jac = problem.jacobian
        self.minv = rows.inverse_mass_matrix()
        self.jac_t = sp.csr_array(self.jac.T)
        self.size_of_jac, self.size_of_minv = abs(self.jac), abs(self.minv)
        self.size_of_jac_t = sp.csr_array(self.size_of_jac.T)
        self.inertia = rows.inv_inertia
        self.n = rows.n_bodies
        column = int(np.diff(self.jac_t.indptr).max(initial=0))
        row = int(np.diff(self.jac.indptr).max(initial=0))
        # Operations on one entry of J^T x, of M^-1 J^T x, and of J M^-1 J^T x + theta x - b.
        self.of_wrench = _gamma(column + 1)
        self.of_velocity = _gamma(column + 4)
        self.of_slack = _gamma(column + row + 8)
        light = np.linalg.eigvalsh(self.inertia) if self.n else np.zeros((0, 3))
        self.fastest = float(np.sqrt(2.0 * rows.inv_mass.max(initial=0.0)))
        self.swiftest = float(np.sqrt(2.0 * light.max(initial=0.0)))
        self.indefinite = bool(np.any(light[:, 0] < -SHIFT * np.abs(light).max(axis=1)) if self.n else False)

    def refusal(self) -> str | None:
        return "an inverse inertia has a negative eigenvalue" if self.indefinite else None

    def slack(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = self.jac @ (self.minv @ (self.jac_t @ x)) + self.theta * x - self.b
        y = np.abs(x)
        size = self.size_of_jac @ (self.size_of_minv @ (self.size_of_jac_t @ y))
        return w, self.of_slack * (size + self.theta * y + np.abs(self.b))

    def size(self, x: FloatArray, fuzz: FloatArray) -> Size:
        g = self.jac_t @ x
        h = np.abs(g)
        off = self.size_of_jac_t @ (self.of_wrench * np.abs(x) + 1.01 * fuzz)  # of g
        square = max(float(g @ (self.minv @ g)), 0.0)
        rounding = _gamma(6 * self.n + 4) * float(h @ (self.size_of_minv @ h))
        wrong = float(off @ (self.size_of_minv @ off))
        elastic = float(np.sum(self.theta * x * x))
        most_elastic = float(np.sum(self.theta * (np.abs(x) + fuzz) ** 2))
        moving = np.sqrt(square + rounding) + np.sqrt(wrong)
        most = np.sqrt(0.5 * (moving * moving + most_elastic)) * (1.0 + _gamma(len(x) + 6 * self.n + 64))
        return Size(float(np.sqrt(0.5 * square)), float(np.sqrt(0.5 * (square + elastic))), float(most))

    def velocity(self, x: FloatArray, fuzz: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        y = np.abs(x)
        off = self.size_of_minv @ (self.size_of_jac_t @ (self.of_velocity * y + 1.01 * fuzz))
        return (self.minv @ (self.jac_t @ x)).reshape(self.n, 6), off.reshape(self.n, 6)

    def reach(self, energy: float) -> tuple[float, float] | None:
        # 1/2 m |v|^2 <= E^2 on every body; one part in 1e9 for the rounding of eigenvalues.
        return self.fastest * energy * (1.0 + 1e-9), self.swiftest * energy * (1.0 + 1e-9)


class _Matrix:
    def __init__(self, problem: Problem) -> None:
        self.b = problem.b
        a = problem.csr
        self.asymmetry = 0.0 if problem.is_symmetric else problem.asymmetry
        self.a = a if problem.asymmetry == 0.0 else sp.csr_array(0.5 * (a + a.T))
        self.size_of_a = abs(self.a)
        self.of_slack = _gamma(int(np.diff(self.a.indptr).max(initial=0)) + 3)
        self.d = problem.d

    def refusal(self) -> str | None:
        if self.asymmetry > 0.0:
            return f"A is not symmetric (by {self.asymmetry:.1e})"
        return None if _is_semidefinite(self.a, self.d) else "A is not positive semidefinite"

    def slack(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.a @ x - self.b, self.of_slack * (self.size_of_a @ np.abs(x) + np.abs(self.b))

    def size(self, x: FloatArray, fuzz: FloatArray) -> Size:
        y = np.abs(x)
        square = max(float(x @ (self.a @ x)), 0.0)
        rounding = (self.of_slack + _gamma(len(x) + 1)) * float(y @ (self.size_of_a @ y))
        wrong = float(fuzz @ (self.size_of_a @ fuzz))
        most = np.sqrt(0.5) * (np.sqrt(square + rounding) + np.sqrt(wrong)) * (1.0 + _gamma(len(x) + 64))
        return Size(None, float(np.sqrt(0.5 * square)), float(most))

    def velocity(self, x: FloatArray, fuzz: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        return None

    def reach(self, energy: float) -> tuple[float, float] | None:
        return None


def _gamma(n: int) -> float:
    return 1.01 * n * U  # n u / (1 - n u) for every n below 1e13


def _is_semidefinite(a: sp.csr_array, d: FloatArray) -> bool:
    """Whether D^-1/2 A D^-1/2 + SHIFT has a Cholesky factor (few rows), or positive pivots (many)."""
    m = a.shape[0]
    scale = 1.0 / np.sqrt(d)
    scaled: Any = sp.diags_array(scale) @ a @ sp.diags_array(scale) + SHIFT * sp.eye_array(m)
    if m <= 400:
        try:
            np.linalg.cholesky(scaled.toarray())
        except np.linalg.LinAlgError:
            return False
        return True
    import qdldl

    try:
        _, pivot, _ = qdldl.Solver(sp.csc_matrix(sp.triu(scaled)), upper=True).factors()
    except (ValueError, RuntimeError):  # a pivot of zero
        return False
    return bool(np.all(pivot > 0.0))
