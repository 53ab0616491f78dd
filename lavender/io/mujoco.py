"""MuJoCo's constraint problem as a `Problem`: what `mj_forward` left in the `efc_*` arrays.

MuJoCo looks for forces f [N, N m] and accelerations; with its Jacobian J, mass matrix M, regularisation R > 0,
unconstrained acceleration a0 and reference acceleration aref it minimises

    1/2 f.(J M^-1 J^T + R) f + f.(J a0 - aref)     over its friction cones and bounds

    mujoco.mj_forward(model, data)
    problem = lavender.io.from_mujoco(model, data)
    lavender.residual(problem, lavender.io.mujoco.impulse(model, data)).relative    # of MuJoCo's own answer

One step dt turns that into impulses and velocities, without changing it:

    lambda = dt f      A = J M^-1 J^T + diag(R)      b = dt (aref - J a0)      w = A lambda - b = dt (J a + R f - aref)

The problem holds J and M as they are (`Problem.generalized`), R as its compliance. Rows keep MuJoCo's order; what
becomes what:

| MuJoCo | here |
|---|---|
| equality | one ROW block of its 1 to 6 rows, unbounded; a flex: a block for each edge |
| friction loss of a joint or tendon | ROW, abs(lambda) <= dt frictionloss |
| limit of a joint or tendon; `condim="1"` | ROW, or a contact of a normal alone: lambda >= 0 |
| elliptic cone, `condim="3"` | CONTACT: normal (from geom 1 to geom 2), two tangents, mu = friction[0] |
| elliptic cone, `condim="4"`, `"6"` | ROUND: normal, two tangents, spin, then two that roll, in one cone |
| pyramidal cone, any condim | its edges as ROWs with lambda >= 0: MuJoCo's own linear complementarity problem |

Coefficients of friction that differ make an ellipsoid; rows of tangents are scaled by friction[j] / friction[0], which
makes it round without changing the problem: `scaling(model, data)` has the factors, `impulse` heeds them.

Differences to know:

- MuJoCo's constraints are soft: R is compliance, and no row is rigid. `solref` and `solimp` are inside R and aref.
- Its friction is the convex relaxation, so the law is "cone". `problem.relaxed("coulomb")` asks for Coulomb's where no
  contact has more than two tangents.
- It evaluates accelerations at the start of the step: v + dt a is the velocity after the step only for the Euler
  integrator without implicit damping. The pass of `noslip_iterations` comes after the problem and is not in it.

What MuJoCo holds is checked against itself: M a0 must be its smooth force, 1 / R its efc_D, and J (a - a0) must be
J M^-1 J^T f as far as its solver has come. Data of another problem than M's are refused, with the option that makes
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray, IntArray, read_only
from lavender.cones import Cones
from lavender.errors import CapabilityError, InputError
from lavender.generalized import Generalized
from lavender.problem import Names, Problem
from lavender_ext.core.generalized import lower_of_dense
from lavender_ext.generalized import export

__all__ = ["acceleration", "from_mujoco", "impulse", "jacobian", "scaling"]

ROUNDING = 2.0**-46  # 64 roundings: M a0 against the smooth force, which MuJoCo solved for by the same factor
UNSOLVED = (
    1e-2  # J (a - a0) against J M^-1 J^T f, of their size: primal solvers stop where the cost hardly falls
)
SAME = 1e-9  # -, R D - 1
UNSEEN = 1e-8  # m/s: what differs by less is nothing that happens (six boxes at rest: about 1e-9)
_CODES = (
    "mjCNSTR_EQUALITY",
    "mjCNSTR_FRICTION_DOF",
    "mjCNSTR_FRICTION_TENDON",
    "mjCNSTR_LIMIT_JOINT",
    "mjCNSTR_LIMIT_TENDON",
    "mjCNSTR_CONTACT_FRICTIONLESS",
    "mjCNSTR_CONTACT_PYRAMIDAL",
    "mjCNSTR_CONTACT_ELLIPTIC",
)


def from_mujoco(model: Any, data: Any, *, name: str = "mujoco") -> Problem:
    """The constraint problem that MuJoCo solved last, in impulses and velocities; see the module.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        After `mj_forward` or `mj_step`.
    name : str
        Name of the problem; "(noslip)" is added where `noslip_iterations` moved MuJoCo's impulses off its solution.

    Returns
    -------
    Problem
        In generalised coordinates, with v*, keys of blocks (geoms and number of a contact, joint, tendon, equality)
        and, without `noslip_iterations`, MuJoCo's own impulses as `guess`. Law "cone" with elliptic friction cones,
        "lcp" with pyramidal ones or without friction, "linear" with equalities alone.

    Raises
    ------
    InputError
        Not a model and its data, or before `mj_forward`.
    CapabilityError
        The data belong to another problem than J, M and R: an integrator that treats damping inside M
        (`integrator="discrete"`), or a copy that lacks what the problem needs.
    """
    mj = _mujoco(model, data)
    m, n, dt = int(data.nefc), int(model.nv), float(model.opt.timestep)
    smooth, force = data.qacc_smooth, data.efc_force[:m]
    mass = _mass(mj, model, data)
    held = _Held.of(data, m)
    cones, scale, key = _blocks(mj, data, held, m, dt)
    jac = _rows(mj, model, data, m, n, scale)
    _check_smooth(model, data, mass, smooth)
    free = dt * smooth
    general = Generalized.compressed(jac, mass, data.qvel + free)
    own, target, softness, gap = export.numbers(
        force, data.efc_aref[:m], data.efc_R[:m], data.efc_D[:m], scale, dt
    )
    noslip = int(model.opt.noslip_iterations) > 0
    if m and not noslip:
        _check_forces(model, data, general, jac, own, smooth, dt)
    return Problem(
        target - general.velocity_of(free),
        cones,
        generalized=general,
        compliance=softness if gap <= SAME else _compliance(data, m) * scale * scale,
        friction="cone",
        guess=None if noslip else own,
        key=key,
        names=Names(cones.n_blocks, lambda: _words(mj, model, held)),
        name=f"{name} (noslip)" if noslip else name,
        copy=False,
    )


def impulse(model: Any, data: Any) -> FloatArray:
    """MuJoCo's own answer as impulses of the problem's rows (m,) [N s]: dt efc_force over `scaling`.

    After `noslip_iterations` it is no solution of the problem.

    Raises
    ------
    InputError
        Not a model and its data.
    """
    mj = _mujoco(model, data)
    m, dt = int(data.nefc), float(model.opt.timestep)
    scale = _blocks(mj, data, _Held.of(data, m), m, dt)[1]
    return np.divide(dt * data.efc_force[:m], scale, out=np.zeros(m), where=scale != 0.0)


def scaling(model: Any, data: Any) -> FloatArray:
    """Factor of each row (m,) of the problem: row of the problem = factor times MuJoCo's row.

    1, and friction[j] / friction[0] on the tangents of an elliptic cone. Impulses are MuJoCo's over it.

    Raises
    ------
    InputError
        Not a model and its data.
    """
    mj = _mujoco(model, data)
    m = int(data.nefc)
    return _blocks(mj, data, _Held.of(data, m), m, float(model.opt.timestep))[1]


def acceleration(model: Any, data: Any, impulse: Any) -> FloatArray:
    """MuJoCo's `qacc` (nv,) under impulses (m,) [N s] of the problem's rows: a0 + M^-1 J^T lambda / dt.

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
    push = (jacobian(model, data).T @ (scaling(model, data) * lam))[None, :] / float(model.opt.timestep)
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


@cache
def _codes(mj: Any) -> Any:
    return read_only(np.array([int(getattr(mj.mjtConstraint, name)) for name in _CODES], np.int32))


def _mass(mj: Any, model: Any, data: Any) -> Any:
    """(indptr, indices, data) of M's lower triangle."""
    if hasattr(data, "M") and hasattr(model, "M_rownnz"):
        indptr = export.row_pointers(model.M_rowadr, model.M_rownnz)
        if indptr is not None:
            return indptr, np.array(model.M_colind, np.int32), np.array(data.M, float)
    whole = np.zeros((int(model.nv), int(model.nv)))
    if hasattr(data, "qM"):
        mj.mj_fullM(model, whole, data.qM)
    else:
        mj.mj_fullM(model, data, whole)
    return lower_of_dense(whole)[0]


def _rows(mj: Any, model: Any, data: Any, m: int, n: int, scale: FloatArray) -> Any:
    """(indptr, indices, data) of J, scaled by row."""
    if not mj.mj_isSparse(model):
        return export.rows_of_dense(np.ravel(data.efc_J), m, n, scale)
    count = np.ascontiguousarray(data.efc_J_rownnz[:m], np.int32)
    first = np.ascontiguousarray(data.efc_J_rowadr[:m], np.int32)
    columns = np.ascontiguousarray(np.ravel(data.efc_J_colind), np.int32)
    found = export.rows_of_sparse(np.ravel(data.efc_J), count, first, columns, scale)
    if found is None:
        whole = sp.csr_array(sp.diags_array(scale) @ jacobian(model, data))
        whole.sort_indices()
        found = (whole.indptr.astype(np.int32), whole.indices.astype(np.int32), whole.data)
    return found


def _compliance(data: Any, m: int) -> FloatArray:
    """R (m,) [1/kg] where efc_R and 1 / efc_D are not the same: the latter where a copy did not fill the former."""
    r, inverse = data.efc_R[:m], data.efc_D[:m]
    empty = r == 0.0
    if np.any(inverse <= 0.0) or np.any(np.abs(r * inverse - 1.0)[~empty] > SAME):
        raise CapabilityError(
            "efc_R and 1 / efc_D disagree: the softness of these constraints is not known. Run mj_forward on "
            "this MjData, or copy both from where the step ran"
        )
    return np.where(empty, 1.0 / inverse, r)


def _check_smooth(model: Any, data: Any, mass: Any, smooth: Any) -> None:
    """M a0 must be the smooth force: otherwise another matrix than M has made a0, and made the problem."""
    gap = export.mass_mismatch(*mass, np.ascontiguousarray(smooth), np.ascontiguousarray(data.qfrc_smooth))
    if not gap <= ROUNDING:
        raise CapabilityError(
            f"M qacc_smooth differs from qfrc_smooth by {gap:.1e} of their size: these data are not those of M. "
            f"{_reason(model)}"
        )


def _check_forces(
    model: Any, data: Any, general: Generalized, jac: Any, own: FloatArray, smooth: Any, dt: float
) -> None:
    """J a must be J (a0 + M^-1 J^T f), as far as MuJoCo's solver has come, measured by |J| |a|."""
    gap = export.row_mismatch(*jac, np.ascontiguousarray(data.qacc), smooth + general.change(own) / dt)
    if not gap <= UNSOLVED:
        moved = dt * (
            general.velocity_of(np.array(data.qacc, float) - smooth)
            - general.velocity_of(general.change(own) / dt)
        )
        if np.abs(moved).max() <= UNSEEN:
            return
        raise CapabilityError(
            f"J (qacc - qacc_smooth) differs from J M^-1 J^T efc_force by {gap:.1e} of their size: the accelerations "
            f"are not those of these forces. {_reason(model)}"
        )


def _reason(model: Any) -> str:
    import mujoco as mj

    word = mj.mjtIntegrator(int(model.opt.integrator)).name.removeprefix("mjINT_").lower()
    return (
        f"The option integrator={word!r} may put damping into M (use 'euler', 'implicitfast' or 'RK4' for the problem "
        "with M itself), a solver with few iterations may have stopped early, or MjData was changed or copied in part "
        "since its forward pass: run mj_forward"
    )


@dataclass(frozen=True)
class _Held:
    """What blocks and their names depend on, copied, for the data go on."""

    types: IntArray  # (m,)
    ids: IntArray  # (m,)
    dim: IntArray  # (c,)
    geom: IntArray  # (c, 2)

    @classmethod
    def of(cls, data: Any, m: int) -> _Held:
        contact = data.contact
        return cls(
            np.array(data.efc_type[:m], np.int32),
            np.array(data.efc_id[:m], np.int32),
            np.array(contact.dim, np.int32),
            np.array(contact.geom, np.int32).reshape(-1, 2),
        )


def _blocks(mj: Any, data: Any, held: _Held, m: int, dt: float) -> tuple[Cones, FloatArray, Any]:
    """Cones, factor of each row, key of each block."""
    found = export.blocks(
        held.types,
        held.ids,
        _codes(mj),
        held.dim,
        np.ascontiguousarray(data.contact.friction, float).reshape(-1, 5),
        held.geom,
        np.ascontiguousarray(data.efc_frictionloss[:m], float),
        dt,
    )
    if isinstance(found, int):
        raise CapabilityError(
            f"constraint row {found} is of type {held.types[found]}, which is not known here"
        )
    ptr, kind, lower, upper, mu, scale, key = found
    return Cones._trusted(ptr, kind, lower, upper, mu, np.zeros(len(mu))), scale, key


def _words(mj: Any, model: Any, held: _Held) -> list[str]:
    types, ids, geom, dim = held.types.tolist(), held.ids.tolist(), held.geom, held.dim
    kinds = mj.mjtConstraint
    names: list[str] = []
    i = 0
    while i < len(types):
        of, which = types[i], ids[i]
        size = 1
        if of == kinds.mjCNSTR_EQUALITY:
            while i + size < len(types) and types[i + size] == of and ids[i + size] == which:
                size += 1
            name = _name(mj, model, "EQUALITY", which, "equality")
            names += [name] if size <= export.JOINED else [f"{name}, edge {edge}" for edge in range(size)]
        elif of == kinds.mjCNSTR_FRICTION_DOF:
            joint = int(model.dof_jntid[which])
            axis = which - int(model.jnt_dofadr[joint])
            turns = int(model.jnt_type[joint]) < int(mj.mjtJoint.mjJNT_SLIDE)
            names.append(f"friction of {_name(mj, model, 'JOINT', joint, 'joint')}{f', axis {axis}' * turns}")
        elif of == kinds.mjCNSTR_FRICTION_TENDON:
            names.append(f"friction of {_name(mj, model, 'TENDON', which, 'tendon')}")
        elif of in (kinds.mjCNSTR_LIMIT_JOINT, kinds.mjCNSTR_LIMIT_TENDON):
            word = "joint" if of == kinds.mjCNSTR_LIMIT_JOINT else "tendon"
            names.append(f"limit of {_name(mj, model, word.upper(), which, word)}")
        else:
            name = _contact_name(mj, model, geom[which], which)
            if of == kinds.mjCNSTR_CONTACT_PYRAMIDAL:
                size = 2 * (int(dim[which]) - 1)
                names += [f"{name}, edge {edge}" for edge in range(size)]
            else:
                size = int(dim[which]) if of == kinds.mjCNSTR_CONTACT_ELLIPTIC else 1
                names.append(name)
        i += size
    return names


def _name(mj: Any, model: Any, kind: str, which: int, word: str) -> str:
    given = mj.mj_id2name(model, getattr(mj.mjtObj, f"mjOBJ_{kind}"), which)
    return f"{word} {given or which}"


def _contact_name(mj: Any, model: Any, geom: Any, which: int) -> str:
    geoms = [int(g) for g in geom]
    sides = [_name(mj, model, "GEOM", g, "geom").removeprefix("geom ") if g >= 0 else "flex" for g in geoms]
    return f"contact {which} ({sides[0]}, {sides[1]})"
