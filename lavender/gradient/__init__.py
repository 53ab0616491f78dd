"""Derivatives of a solution by the problem's data, and checks of their existence.

A solution lambda with w = A lambda - b is a root of the natural map F(z) = z - Pi(z - D^-1/2 w), z = D^1/2 lambda,
with the projection Pi of lavender_ext/core/block_projection.pxd in each block. If every block is strictly inside one
state (sticks, slides, open, at a bound, free), F is smooth, and with P = dPi

    G dz = P D^-1/2 (db - dA lambda) + D^1/2 dl + (dPi/de) de,    G = I - P + P H,   H = D^-1/2 A D^-1/2      (1)
    dA lambda = dJ v' + J M^-1 (dJ^T lambda - dM v') + dtheta lambda,   v' = M^-1 J^T lambda                  (2)
    dv = dv* + v'',   v'' = M^-1 (J^T dlambda + dJ^T lambda - dM v'),   dw = A dlambda + dA lambda - db        (3)

e are the friction coefficients of rows (mu, mu r, mu_r), l the active bounds. With cotangents c of lambda, x of w and
y of v,

    G^T q = D^-1/2 (c + J M^-1 y + A^T x),   s = D^-1/2 P^T q - x,   p = M^-1 (y - J^T s)                     (4)
    b: s    l: D^1/2 q    e: (dPi/de)^T q    A: -s lambda^T    theta: -s lambda                               (5)
    J: lambda p^T - s v+^T    M: -p v'^T    v*: y - J^T s   (for fixed target and v*: b depends on J and v*)

by the implicit function theorem and its adjoint. G is singular if rows are linearly dependent. Then the iteration

    G_eps = G + eps P,    dz <- dz + G_eps^-1 (r - G dz)                                                      (6)

converges to one of the solutions (Rockafellar 1976), and repeated application of I - G_eps^-1 G projects a random
vector on the null space of G.
"""

from lavender.gradient.batch import Derivatives, derivatives
from lavender.gradient.derivative import Derivative, Tangent, Unique, derivative
from lavender.gradient.result import Gradient

__all__ = [
    "Derivative",
    "Derivatives",
    "Gradient",
    "Tangent",
    "Unique",
    "derivative",
    "derivatives",
]
