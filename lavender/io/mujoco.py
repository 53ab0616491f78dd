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

What MuJoCo holds is checked against itself: every index before it is followed; M a0 must be its smooth force, 1 / R its
efc_D; and J must be the matrix that made its efc_vel, efc_b and qfrc_constraint. Data of another problem than M's are
refused, with the option that makes them. What its solver answered is in no check: if it stopped before convergence,
`impulse` is further off, and the judge says by how much.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array, read_only
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Names, Problem
from lavender.problem.cones import Cones
from lavender.problem.generalized import Generalized
from lavender.problem.operators import MAX_SAFE_ENTRY
from lavender_ext.io import mujoco_rows

ROUNDING = 2.0**-46  # 64 roundings: M a0 against the smooth force, which MuJoCo solved for by the same factor
SAME = 1e-9  # -, R D - 1
# of the terms' size: sums of 1,000 of them in another order; what was changed is off by far more
SUMMED = 2.0**-40
ALIKE = 1e-10  # -, least share of a joint's axis that those before it in its body leave, to tell their velocities apart
# Bytes of MuJoCo's memory that a row (12 numbers and more), a contact and an entry of efc_J with its column take.
ROW_BYTES, CONTACT_BYTES, ENTRY_BYTES = 128, 512, 12
CHANGED = "MjData was changed since its forward pass, or is of another model: run mj_forward"
OF_M = ("Euler", "RK4", "implicit", "implicitfast")  # integrators whose constraint problem is of M
LAYOUT = "(also where opt.jacobian, which says how efc_J is laid out, was changed)"
OTHER_MODEL = "The model was changed, or MjData is of another one: give a model and data made from it"
NO_TRIANGLE = (np.zeros(1, np.int32), np.zeros(0, np.int32))
NO_CONTACT = SimpleNamespace(
    dim=np.zeros(0, np.int32), geom=np.zeros((0, 2), np.int32), friction=np.zeros((0, 5))
)
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


class _Model:
    """What a model keeps while it lives: its counts, and where its arrays are; what they hold is read anew."""

    def __init__(self, mj: Any, model: Any) -> None:
        self.mj, self.n = mj, int(model.nv)
        self.most = model.neq, self.n, model.ntendon, model.njnt, model.ntendon
        self.tree = model.body_parentid, model.dof_bodyid
        self.mass = model.M_rowadr, model.M_rownnz, model.M_colind
        self.like: Any = None  # its operator made first, whose pattern is compared before use


_SEEN: WeakKeyDictionary[Any, _Model] = WeakKeyDictionary()


def from_mujoco(model: Any, data: Any, *, name: str = "mujoco") -> Problem:
    """The constraint problem that MuJoCo solved last, in impulses and velocities; see the module.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        After `mj_forward` or `mj_step`; v* is of the velocities before the step.
    name : str
        Name of the problem; "(noslip)" is added where `noslip_iterations` moved MuJoCo's impulses off its solution.

    Returns
    -------
    Problem
        In generalised coordinates, with v* and keys of blocks (geoms and number of a contact, joint, tendon,
        equality). Law "cone" with elliptic friction cones, "lcp" with pyramidal ones or without friction, "linear"
        with equalities alone. MuJoCo's own impulses are its answer, no start: `impulse(model, data)` has them.

    Raises
    ------
    InputError
        Not a model and its data, or before `mj_forward`; a step that is no time; numbers that are not finite; indices
        (`efc_id`, `contact.dim`, `efc_J_colind`, ...) that name what is not there.
    CapabilityError
        The data belong to another problem than J, M and R: an integrator that treats damping inside M
        (`integrator="discrete"`), a Jacobian that is not the one of the forward pass (`opt.jacobian` changed since),
        or a copy that lacks what the problem needs; after `mj_step`, joints of one body that move it alike. Never
        because MuJoCo's solver stopped before convergence: the problem does not depend on its answer.
    """
    seen, m, contacts, smooth = _mujoco(model, data)
    opt, like = model.opt, seen.like
    dt = _timestep(opt)
    mass = _mass(seen, model, data, smooth, NO_TRIANGLE if like is None else like.mass[:2])
    cones, scale, key = _blocks(seen, data, contacts, dt)
    jac = _rows(seen, model, data, m, scale)
    rhs, softness, v_free, sound, gap, gaps = mujoco_rows.numbers(
        *jac, scale, dt, _before(seen, data), smooth, data.efc_aref, data.efc_R, data.efc_D, data.efc_force,
        _speed(model, data, m), data.efc_b, data.qfrc_constraint, data.qacc, MAX_SAFE_ENTRY,
    )  # fmt: skip
    _check_jacobian(*gaps)
    if not gap <= SAME:
        softness, sound = _compliance(data) * scale * scale, False
    names = Names(cones.n_blocks, lambda: _words(seen.mj, model, cones._blocks.ints[2 * m + 1 :], m))
    general = Generalized.compressed(jac, mass, v_free, like=like)
    if like is None:
        seen.like = general.operator
    made = (
        Problem._from_engine_arrays if sound and not general.operator.is_beyond(MAX_SAFE_ENTRY) else Problem
    )
    return made(
        b=rhs,
        cones=cones,
        generalized=general,
        compliance=softness,
        friction="cone",
        key=key,
        names=names,
        name=f"{name} (noslip)" if opt.noslip_iterations > 0 else name,
        copy=False,
    )


@np.errstate(over="ignore", invalid="ignore")
def impulse(model: Any, data: Any) -> FloatArray:
    """MuJoCo's own answer as impulses of the problem's rows (m,) [N s]: dt efc_force over `scaling`.

    After `noslip_iterations` it is no solution of the problem.
    """
    scale = scaling(model, data)
    force = _timestep(model.opt) * data.efc_force
    return np.divide(force, scale, out=np.zeros(len(scale)), where=scale != 0.0)


def scaling(model: Any, data: Any) -> FloatArray:
    """Factor of each row (m,) of the problem: row of the problem = factor times MuJoCo's row.

    1, and friction[j] / friction[0] on the tangents of an elliptic cone. Impulses are MuJoCo's over it.
    """
    seen, _, contacts, _ = _mujoco(model, data)
    scale: FloatArray = _blocks(seen, data, contacts, _timestep(model.opt))[1]
    return scale


def acceleration(model: Any, data: Any, impulse: Any) -> FloatArray:
    """MuJoCo's `qacc` (nv,) under impulses (m,) [N s] of the problem's rows: a0 + M^-1 J^T lambda / dt."""
    seen, m, _, smooth = _mujoco(model, data)
    lam = as_array("impulse", impulse, (m,), unit="N s")
    push = (jacobian(model, data).T @ (scaling(model, data) * lam))[None, :] / _timestep(model.opt)
    change = np.zeros_like(push)
    seen.mj.mj_solveM(model, data, change, np.ascontiguousarray(push))
    return np.array(smooth, float) + change[0]


def jacobian(model: Any, data: Any) -> sp.csr_array:
    """J (m, nv) of all constraints, from either way in which MuJoCo stores it."""
    seen, m, _, _ = _mujoco(model, data)
    indptr, indices, values = _rows(seen, model, data, m, np.ones(m))
    return sp.csr_array((values, indices, indptr), shape=(m, seen.n))


def _mujoco(model: Any, data: Any) -> tuple[_Model, int, int, Any]:
    """What is kept of the model, rows, contacts, and the unconstrained acceleration, of a model and data that fit."""
    try:
        seen = _SEEN.get(model)
    except TypeError:  # of no model: nothing that has weak references
        seen = None
    mj = package() if seen is None else seen.mj
    if (seen is None and not isinstance(model, mj.MjModel)) or not isinstance(data, mj.MjData):
        raise InputError(
            f"got a {type(model).__name__} and a {type(data).__name__}; a mujoco.MjModel and its mujoco.MjData "
            "are needed"
        )
    if seen is None:
        seen = _SEEN[model] = _Model(mj, model)
    smooth = data.qacc_smooth
    if len(smooth) != seen.n:
        raise InputError(f"the data has {len(smooth)} degrees of freedom, the model {seen.n}")
    m, contacts, entries = data.nefc, data.ncon, data.nJ
    needed = m * ROW_BYTES + contacts * CONTACT_BYTES + entries * ENTRY_BYTES
    if min(m, contacts, entries) < 0 or needed > data.parena:  # where its arrays end, for whoever reads them
        raise InputError(
            f"nefc = {m}, ncon = {contacts}, nJ = {entries}: what this MjData has allocated ({data.parena} bytes) does "
            f"not hold as many. {CHANGED}"
        )
    return seen, m, contacts, smooth


def package() -> Any:
    """MuJoCo, which whoever holds a model has; InputError where it is not there, or too old."""
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "mujoco cannot be imported: pip install mujoco; a model and its data come from it"
        ) from None
    if not hasattr(mujoco.MjModel, "M_rowadr"):
        raise InputError(f"mujoco is {mujoco.__version__}; 3.4 or later is needed: pip install -U mujoco")
    return mujoco


@cache
def _codes(mj: Any) -> Any:
    return read_only(np.array([int(getattr(mj.mjtConstraint, name)) for name in _CODES], np.int32))


def _timestep(opt: Any) -> float:
    dt = float(opt.timestep)
    if not 0.0 < dt < np.inf:
        raise InputError(f"opt.timestep is {dt} s; a step above 0 is needed")
    return dt


def _mass(seen: _Model, model: Any, data: Any, smooth: Any, like: Any) -> Any:
    """(indptr, indices, data) of M's lower triangle, the first two those of `like` where they are the same.

    M a0 must be the smooth force: otherwise another matrix than M has made a0, and made the problem.
    """
    made = mujoco_rows.lower(*seen.mass, data.M, smooth, data.qfrc_smooth, ROUNDING, like)
    if made is None:
        raise InputError(f"M_rowadr, M_rownnz and M_colind are no lower triangle of M. {OTHER_MODEL}")
    mass, gap = made
    if not gap <= ROUNDING:
        number = int(model.opt.integrator)
        found = [name for name, value in seen.mj.mjtIntegrator.__members__.items() if int(value) == number]
        word = found[0].removeprefix("mjINT_").lower() if found else str(number)
        why = f"integrator={word!r} puts damping into it; {', '.join(map(repr, OF_M))} have M itself"
        raise CapabilityError(
            f"M qacc_smooth differs from qfrc_smooth by {gap:.1e} of their size: these data are not those of M. "
            f"{CHANGED if word in map(str.lower, OF_M) else why}"
        )
    return mass


def _rows(seen: _Model, model: Any, data: Any, m: int, scale: FloatArray) -> Any:
    """(indptr, indices, data) of J, scaled by row."""
    values, n = data.efc_J, seen.n
    values = values if values.ndim == 1 else np.ravel(values)
    if not seen.mj.mj_isSparse(model):
        if len(values) < m * n:
            raise InputError(
                f"efc_J holds {len(values)} numbers; {m} x {n} are needed where opt.jacobian says dense. {CHANGED}"
            )
        return mujoco_rows.rows_of_dense(values, m, n, scale)
    count, first, columns = data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
    columns = columns if columns.ndim == 1 else np.ravel(columns)
    if not len(count) == len(first) == m:
        raise InputError(
            f"efc_J_rownnz and efc_J_rowadr hold {len(count)} and {len(first)} of {m} rows. {CHANGED} {LAYOUT}"
        )
    found = mujoco_rows.rows_of_sparse(values, count, first, columns, scale, n)
    if isinstance(found, int):
        raise InputError(
            f"row {found} of efc_J has {count[found]} entries from place {first[found]} of {len(columns)}, in columns "
            f"of {n}: it names what is not there. {CHANGED} {LAYOUT}"
        )
    if found is None:
        indptr = np.concatenate([[0], np.cumsum(count, dtype=np.int64)])
        at = np.arange(indptr[-1]) + np.repeat(first - indptr[:-1], count)
        whole = sp.csr_array((values[at] * np.repeat(scale, count), columns[at], indptr), shape=(m, n))
        whole.sum_duplicates()
        found = (whole.indptr.astype(np.int32), whole.indices.astype(np.int32), whole.data)
    return found


@np.errstate(over="ignore", invalid="ignore")
def _compliance(data: Any) -> FloatArray:
    """R (m,) [1/kg] where efc_R and 1 / efc_D are not the same: the latter where a copy did not fill the former."""
    r, inverse = data.efc_R, data.efc_D
    empty = r == 0.0
    if np.any(inverse <= 0.0) or np.any(np.abs(r * inverse - 1.0)[~empty] > SAME):
        raise CapabilityError(
            "efc_R and 1 / efc_D disagree: the softness of these constraints is not known. Run mj_forward on "
            "this MjData, or copy both from where the step ran"
        )
    return np.where(empty, 1.0 / inverse, r)


def _before(seen: _Model, data: Any) -> FloatArray:
    """Velocities (nv,) of the forward pass: qvel, or after a step what those of bodies, made before it, tell."""
    parent, bodies = seen.tree
    axis, spatial, v = data.cdof, data.cvel, data.qvel
    gap, size = mujoco_rows.motion_gap(parent, bodies, axis, spatial, v)
    if gap < 0.0:
        raise InputError(f"dof_bodyid and body_parentid are no tree of these bodies. {OTHER_MODEL}")
    if gap <= SUMMED * size or (not np.any(spatial) and np.any(data.efc_vel)):  # not filled by a copy
        return v
    v = mujoco_rows.motion_before(parent, bodies, axis, spatial, ALIKE)
    if v is None or not mujoco_rows.motion_gap(parent, bodies, axis, spatial, v)[0] <= SUMMED * size:
        raise CapabilityError(
            "the velocity before the step cannot be told from cvel and cdof: joints of one body move it alike, or "
            "MjData was changed since its forward pass: run mj_forward"
        )
    return v


def _speed(model: Any, data: Any, m: int) -> FloatArray:
    """What J v is held to: efc_vel; nothing (zeros) where the speeds of geoms' surfaces are in it, too."""
    speed: FloatArray = np.zeros(m) if getattr(model, "flg_surfacevel", False) else data.efc_vel
    return speed


def _check_jacobian(velocity: float, row: float, push: float, finite: float) -> None:
    """J must be the matrix that made what MuJoCo made by it, as far as rounding lets it be: whatever its solver did."""
    if finite != 0.0:
        raise InputError(
            "qacc holds numbers that are not finite: the simulation has diverged, or was changed"
        )
    for found, words in (
        (velocity, "J qvel and efc_vel"),
        (row, "J qacc_smooth - efc_aref and efc_b"),
        (push, "J^T efc_force and qfrc_constraint"),
    ):
        if not found <= SUMMED:
            raise CapabilityError(
                f"{words} differ by {found:.1e} of their size: efc_J is not the Jacobian of this forward pass. "
                f"{CHANGED} {LAYOUT}"
            )


def _blocks(seen: _Model, data: Any, contacts: int, dt: float) -> tuple[Cones, FloatArray, Any]:
    """Cones, factor of each row, key of each block."""
    contact = data.contact if contacts else NO_CONTACT
    most = (*seen.most, contacts, contacts, contacts)
    types, ids, dims, codes = data.efc_type, data.efc_id, contact.dim, _codes(seen.mj)
    found = mujoco_rows.blocks(
        types, ids, codes, most, dims, contact.friction, contact.geom, data.efc_frictionloss, dt
    )
    if isinstance(found, int):
        of, which, known = int(types[found]), int(ids[found]), codes.tolist()
        if of not in known:
            raise CapabilityError(f"constraint row {found} is of type {of}, which is not known here")
        there = most[known.index(of)]
        dim = f", of condim {dims[which]}" if known.index(of) > 4 and 0 <= which < there else ""
        raise InputError(
            f"constraint row {found} of {len(types)} is of type {of} and names number {which} of {there}{dim}: "
            f"that is not there, or has not so many rows. {CHANGED}"
        )
    blocks, scale, key = found
    if blocks is None:
        raise InputError(f"efc_frictionloss or a contact's friction is no bound. {CHANGED}")
    return Cones._from_blocks(blocks), scale, key


def _words(mj: Any, model: Any, held: IntArray, m: int, joined: int = mujoco_rows.JOINED) -> list[str]:
    types, ids, contacts = held[:m].tolist(), held[m : 2 * m].tolist(), (len(held) - 2 * m) // 3
    dim = held[2 * m : 2 * m + contacts]
    geom = held[2 * m + contacts : 2 * m + 3 * contacts].reshape(-1, 2)
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
            names += [name] if size <= joined else [f"{name}, edge {edge}" for edge in range(size)]
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
            sides = [_name(mj, model, "GEOM", g, "geom") if g >= 0 else "flex" for g in geom[which].tolist()]
            name = f"contact {which} ({', '.join(side.removeprefix('geom ') for side in sides)})"
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
