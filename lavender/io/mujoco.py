"""MuJoCo's constraint problem as a `Problem`: what `mj_forward` left in the `efc_*` arrays.

MuJoCo looks for forces f [N, N m] and accelerations; with its Jacobian J, mass matrix M, regularisation R > 0,
unconstrained acceleration a0 and reference acceleration aref it minimises

    1/2 f.(J M^-1 J^T + R) f + f.(J a0 - aref)     over its friction cones and bounds

    mujoco.mj_forward(model, data)
    problem = lavender.io.from_mujoco(model, data)
    lavender.residual(problem, lavender.io.mujoco.impulse(model, data)).relative    # of MuJoCo's own answer

One step dt turns that into impulses and velocities, without changing it:

    lambda = dt f      A = J M^-1 J^T + diag(R)      b = dt (aref - J a0)      w = A lambda - b = dt (J a + R f - aref)

Rows keep MuJoCo's order, so `impulse(model, data)` is `dt efc_force` row by row. What becomes what:

| MuJoCo | here |
|---|---|
| equality | one ROW block of its 1 to 6 rows, unbounded |
| friction loss of a joint or tendon | ROW, abs(lambda) <= dt frictionloss |
| limit of a joint or tendon; `condim="1"` | ROW, or a contact of a normal alone: lambda >= 0 |
| elliptic cone, `condim="3"` | CONTACT: normal (from geom 1 to geom 2), two tangents, mu = friction[0] |
| elliptic cone, `condim="4"` | CONTACT_SPIN, patch radius = friction[2] / friction[0] [m] |
| pyramidal cone, any condim | its edges as ROWs with lambda >= 0: MuJoCo's own linear complementarity problem |

Differences to know:

- MuJoCo's constraints are soft: R is compliance, on the diagonal of A, and no row is rigid. `solref` and `solimp`
  are inside R and aref.
- Its friction is the convex relaxation, so the law is "cone". `problem.relaxed("coulomb")` asks for Coulomb's.
- With condim 4 its cone bounds disk and torque together by an ellipsoid; here each has its own bound. The two
  agree where the contact slides or spins, not both; MuJoCo's forces then leave a residual.
- It evaluates accelerations at the start of the step: v + dt a is the velocity after the step only for the Euler
  integrator without implicit damping. The pass of `noslip_iterations` comes after the problem and is not in it.
- Generalised coordinates have no pair of bodies behind each row, so the problem holds a matrix, not rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray
from lavender.cones import CONTACT, CONTACT_SPIN, ROW, Cones
from lavender.errors import CapabilityError, InputError
from lavender.problem import Problem

__all__ = ["acceleration", "from_mujoco", "impulse", "jacobian"]

CHUNK = 2**22  # numbers of a dense slice of J while it is whitened: 32 MiB


def from_mujoco(model: Any, data: Any, *, name: str = "mujoco") -> Problem:
    """The constraint problem that MuJoCo solved last, in impulses and velocities; see the module.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        After `mj_forward` or `mj_step`.
    name : str
        Name of the problem.

    Returns
    -------
    Problem
        Law "cone" with elliptic friction cones, "lcp" with pyramidal ones or without friction, "linear"
        with equalities alone. Its matrix is A (m, m) in compressed rows, symmetric to the bit.

    Raises
    ------
    InputError
        Not a model and its data.
    CapabilityError
        Elliptic cones with rolling friction (condim 6) or with two different tangential coefficients.
    """
    mj = _mujoco(model, data)
    m, dt = int(data.nefc), float(model.opt.timestep)
    jac = jacobian(model, data)
    half = _whitened(mj, model, data, jac)
    a = sp.csr_array(half @ half.T + sp.diags_array(np.array(data.efc_R[:m], float)))
    b = dt * (np.array(data.efc_aref[:m], float) - jac @ np.array(data.qacc_smooth, float))
    cones, names = _blocks(mj, model, data, dt)
    return Problem(b, cones, a, friction="cone", names=names, name=name, copy=False)


def impulse(model: Any, data: Any) -> FloatArray:
    """MuJoCo's own answer as impulses (m,) [N s, N m s]: dt efc_force.

    Raises
    ------
    InputError
        Not a model and its data.
    """
    _mujoco(model, data)
    return float(model.opt.timestep) * np.array(data.efc_force[: int(data.nefc)], float)


def acceleration(model: Any, data: Any, impulse: Any) -> FloatArray:
    """MuJoCo's `qacc` (nv,) under impulses (m,) [N s] of its constraints: a0 + M^-1 J^T lambda / dt.

    Raises
    ------
    InputError
        Not a model and its data, or another number of impulses than constraints.
    """
    mj = _mujoco(model, data)
    lam = np.asarray(impulse, float)
    if lam.shape != (int(data.nefc),):
        raise InputError(
            f"impulse has shape {lam.shape}; ({int(data.nefc)},) is needed, one for each row of efc_J"
        )
    push = (jacobian(model, data).T @ lam)[None, :] / float(model.opt.timestep)
    change = np.zeros_like(push)
    mj.mj_solveM(model, data, change, np.ascontiguousarray(push))
    return np.array(data.qacc_smooth, float) + change[0]


def jacobian(model: Any, data: Any) -> sp.csr_array:
    """J (m, nv) of all constraints, from either way in which MuJoCo stores it.

    Raises
    ------
    InputError
        Not a model and its data.
    """
    mj = _mujoco(model, data)
    m, nv = int(data.nefc), int(model.nv)
    values = np.array(data.efc_J, float).ravel()
    if not mj.mj_isSparse(model):
        return sp.csr_array(values[: m * nv].reshape(m, nv))
    count = np.array(data.efc_J_rownnz[:m], np.int64)
    first = np.array(data.efc_J_rowadr[:m], np.int64)
    indptr = np.concatenate([[0], np.cumsum(count)])
    at = np.arange(indptr[-1]) + np.repeat(first - indptr[:-1], count)
    columns = np.array(data.efc_J_colind, np.int64).ravel()[at]
    jac = sp.csr_array((values[at], columns, indptr), shape=(m, nv))
    jac.sort_indices()
    return jac


def _mujoco(model: Any, data: Any) -> Any:
    # The module, which whoever holds a model has.
    try:
        import mujoco as mj
    except ImportError:
        raise InputError(
            "mujoco cannot be imported: pip install mujoco; a model and its data come from it"
        ) from None
    if not isinstance(model, mj.MjModel) or not isinstance(data, mj.MjData):
        raise InputError(
            f"got a {type(model).__name__} and a {type(data).__name__}; a mujoco.MjModel and its mujoco.MjData "
            "are needed"
        )
    if len(data.qacc_smooth) != model.nv:
        raise InputError(f"the data has {len(data.qacc_smooth)} degrees of freedom, the model {model.nv}")
    return mj


def _whitened(mj: Any, model: Any, data: Any, jac: sp.csr_array) -> sp.csr_array:
    """Y = J L^-1 D^-1/2 (m, nv) with M = L^T D L, so that Y Y^T = J M^-1 J^T is symmetric to the bit."""
    m, nv = jac.shape
    if m == 0 or nv == 0:
        return jac
    root = np.sqrt(np.array(data.qLDiagInv, float))[None, :]
    step = max(1, CHUNK // nv)
    parts = []
    for i in range(0, m, step):
        y = np.ascontiguousarray(jac[i : i + step].toarray())
        x = np.empty_like(y)
        mj.mj_solveM2(model, data, x, y, root)
        parts.append(sp.csr_array(x))
    whole = sp.csr_array(sp.vstack(parts, format="csr"))
    whole.sort_indices()
    return whole


def _blocks(mj: Any, model: Any, data: Any, dt: float) -> tuple[Cones, list[str]]:
    kinds = mj.mjtConstraint
    m = int(data.nefc)
    # An enumeration equals plain integers, not NumPy's.
    types, ids = [int(x) for x in data.efc_type[:m]], [int(x) for x in data.efc_id[:m]]
    loss = dt * np.array(data.efc_frictionloss[:m], float)
    contact = data.contact
    lower, upper = np.full(m, -np.inf), np.full(m, np.inf)
    first: list[int] = []
    kind: list[int] = []
    mu: list[float] = []
    radius: list[float] = []
    names: list[str] = []
    i = 0
    while i < m:
        of, which = types[i], ids[i]
        size, what, friction, patch = 1, ROW, 0.0, 0.0
        if of == kinds.mjCNSTR_EQUALITY:
            while i + size < m and types[i + size] == of and ids[i + size] == which:
                size += 1
            name = _name(mj, model, "EQUALITY", which, "equality")
        elif of in (kinds.mjCNSTR_FRICTION_DOF, kinds.mjCNSTR_FRICTION_TENDON):
            lower[i], upper[i] = -loss[i], loss[i]
            if of == kinds.mjCNSTR_FRICTION_DOF:
                joint = int(model.dof_jntid[which])
                name = f"friction of {_name(mj, model, 'JOINT', joint, 'joint')}"
                axis = which - int(model.jnt_dofadr[joint])
                name += f", axis {axis}" if int(model.jnt_type[joint]) < int(mj.mjtJoint.mjJNT_SLIDE) else ""
            else:
                name = f"friction of {_name(mj, model, 'TENDON', which, 'tendon')}"
        elif of in (kinds.mjCNSTR_LIMIT_JOINT, kinds.mjCNSTR_LIMIT_TENDON):
            lower[i] = 0.0
            word = "joint" if of == kinds.mjCNSTR_LIMIT_JOINT else "tendon"
            name = f"limit of {_name(mj, model, word.upper(), which, word)}"
        else:
            name = _contact_name(mj, model, contact, which)
            if of == kinds.mjCNSTR_CONTACT_FRICTIONLESS:
                what = CONTACT
            elif of == kinds.mjCNSTR_CONTACT_PYRAMIDAL:
                # An edge each: J_n + mu_j J_j and J_n - mu_j J_j, j = 1 ... condim - 1.
                edges = 2 * (int(contact.dim[which]) - 1)
                lower[i : i + edges] = 0.0
                for edge in range(edges):
                    first.append(i + edge)
                    names.append(f"{name}, edge {edge}")
                kind += [ROW] * edges
                mu += [0.0] * edges
                radius += [0.0] * edges
                i += edges
                continue
            else:
                size = int(contact.dim[which])
                what = CONTACT_SPIN if size == 4 else CONTACT
                friction, patch = _friction(np.array(contact.friction[which], float), size, name)
        first.append(i)
        kind.append(what)
        mu.append(friction)
        radius.append(patch)
        names.append(name)
        i += size
    ptr = np.array([*first, m], np.int32)
    return Cones(ptr, np.array(kind, np.int32), lower, upper, np.array(mu), np.array(radius)), names


def _friction(friction: FloatArray, size: int, name: str) -> tuple[float, float]:
    # mu and patch radius [m]: MuJoCo's torsional coefficient is a length already multiplied by mu.
    if size > 4:
        raise CapabilityError(
            f"{name} has rolling friction (condim {size}), which has no block here: use condim 1, 3 or 4, or "
            "cone='pyramidal', whose edges are plain rows"
        )
    if friction[0] != friction[1]:
        raise CapabilityError(
            f"{name} has two coefficients of friction, {friction[0]:g} and {friction[1]:g}; a disk has one: give "
            "the pair equal ones, or use cone='pyramidal', whose edges are plain rows"
        )
    return float(friction[0]), float(friction[2] / friction[0]) if size == 4 else 0.0


def _name(mj: Any, model: Any, kind: str, which: int, word: str) -> str:
    given = mj.mj_id2name(model, getattr(mj.mjtObj, f"mjOBJ_{kind}"), which)
    return f"{word} {given or which}"


def _contact_name(mj: Any, model: Any, contact: Any, which: int) -> str:
    geoms = [int(g) for g in contact.geom[which]]
    sides = [_name(mj, model, "GEOM", g, "geom").removeprefix("geom ") if g >= 0 else "flex" for g in geoms]
    return f"contact {which} ({sides[0]}, {sides[1]})"
