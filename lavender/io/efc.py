"""MuJoCo's constraint problems by the thousand: as its own loop makes them, and as MJX and MuJoCo Warp hold them.

    imported = lavender.io.from_mujoco_many(model, states)
    many = lavender.solve_many(imported.batch)
    lavender.residual_many(imported.batch, imported.impulse).verdict        # of MuJoCo's own answers

The problem is that of `lavender.io.mujoco`, with the same rows in the same order; in arrays, dt the time step:

    v* = qvel + dt a0      target = dt aref + J qvel      compliance = 1 / D      lambda = dt f

Tangents of an elliptic contact are scaled by friction[j] / friction[0]. Numbers in float32 are widened exactly, and the
judge's floor is that of float32. Rows of zeros, with which MJX and Warp pad, are soft and ask nothing.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, as_array, number, precision_of, whole_number
from lavender.base.errors import CapabilityError, InputError
from lavender.io import mujoco as single
from lavender.problem.batch import Batch, check_errors
from lavender.problem.cones import Cones, kinds_of
from lavender_ext.judge.measure import all_finite

__all__ = ["Imported", "from_efc", "from_mujoco_many"]

EQUALITY, FRICTION, ELLIPTIC = 0, (1, 2), 7  # numbers of mjtConstraint; all others push only
OF_ROWS = ("efc_J", "efc_D", "efc_aref", "efc_force", "efc_type", "efc_frictionloss", "efc_vel")
CHUNK = 2**21  # entries of J that are widened at once
# M a0 beside the smooth force, of their size: 64 roundings, in float64 and in float32, where factors are rounded, too.
ROUNDING = {"float64": single.ROUNDING, "float32": 2.0**-14}


class Imported(NamedTuple):
    """Problems of many worlds, and the engine's own answers to them."""

    batch: Batch
    impulse: FloatArray | None  # N s, in the batch's shape: dt efc_force in the batch's rows


def from_efc(
    *,
    efc_J: Any,
    efc_D: Any,
    efc_aref: Any,
    efc_type: Any,
    M: Any,
    qvel: Any,
    qacc_smooth: Any,
    timestep: float,
    efc_frictionloss: Any = 0.0,
    nefc: Any = None,
    contacts: tuple[Any, Any, Any, Any] | None = None,
    efc_force: Any = None,
    qfrc_smooth: Any = None,
) -> Imported:
    """Constraint problems from stacked arrays, n worlds with room for m rows each, in float32 or float64.

    Parameters
    ----------
    efc_J : (n, m, nv)
    efc_D, efc_aref : (n, m)
    efc_type : (n, m) or (m,) int
        Of mjtConstraint.
    M : (n, nv, nv)
        Mass matrix, both triangles.
    qvel, qacc_smooth : (n, nv)
        Velocity before the step and unconstrained acceleration.
    timestep : float, s
    efc_frictionloss : (n, m) or (m,)
        Read on rows of friction loss.
    nefc : (n,) int, optional
        Rows that count; default m.
    contacts : (world, efc_address, dim, friction), optional
        Of contacts: (c,), (c,), (c,) int and (c, 5). Read where elliptic rows begin; others are left out.
    efc_force : (n, m), optional
        The engine's answer.
    qfrc_smooth : (n, nv), optional
        To be checked against M qacc_smooth, to the precision of the data.

    Returns
    -------
    Imported
        The batch, under the law "cone", and `impulse` where `efc_force` was given.

    Raises
    ------
    InputError
        Shapes that do not fit; a D that is not above 0; elliptic rows without contacts.
    CapabilityError
        M qacc_smooth is not the smooth force: another matrix has made the problem.
    """
    jac, dt = np.asarray(efc_J), number("timestep", timestep, above=0.0)
    if jac.ndim != 3:
        raise InputError(f"efc_J has shape {jac.shape}; (n, m, nv) is needed")
    n, m, nv = jac.shape
    stiff = as_array("efc_D", efc_D, (n, m), finite=False)
    goal = dt * as_array("efc_aref", efc_aref, (n, m), finite=False)
    before, smooth = (
        as_array(name, x, (n, nv), finite=False) for name, x in (("qvel", qvel), ("qacc_smooth", qacc_smooth))
    )
    of = np.broadcast_to(np.asarray(efc_type), (n, m))
    loss = np.broadcast_to(np.asarray(efc_frictionloss, float), (n, m))
    count = np.full(n, m) if nefc is None else np.minimum(as_array("nefc", nefc, (n,), dtype=np.int32), m)
    counted = np.arange(m) < count[:, None]
    off = np.argwhere(counted & ~(stiff > 0.0) & np.isfinite(stiff))
    if len(off):
        raise InputError(
            f"efc_D of world {off[0][0]}, row {off[0][1]} is {stiff[tuple(off[0])]:g}; above 0 is needed"
        )
    precision = precision_of(jac, np.asarray(M), np.asarray(qvel))
    if qfrc_smooth is not None:
        _check_mass(np.asarray(M), smooth, as_array("qfrc_smooth", qfrc_smooth, (n, nv)), precision)
    free = before + dt * smooth
    step = max(1, CHUNK // max(1, m * nv))
    for i in range(0, n, step):
        goal[i : i + step] += np.einsum("nij,nj->ni", jac[i : i + step].astype(float), before[i : i + step])
    with np.errstate(divide="ignore"):
        soft = np.where(counted, 1.0 / stiff, 0.0)
    cones, scale = _blocks(of, loss, counted, contacts, dt)
    if scale is not None:
        jac = jac * scale[:, :, None].astype(jac.dtype)
        goal, soft = goal * scale, soft * scale * scale
    batch = Batch(jac, M, free, target=goal, cones=cones, compliance=soft, friction="cone", count=count)
    batch.precision = precision
    if efc_force is None:
        return Imported(batch, None)
    lam = dt * as_array("efc_force", efc_force, (n, m), finite=False) * counted
    return Imported(batch, lam if scale is None else lam / scale)


def from_mujoco_many(model: Any, states: Any, *, threads: int = 1, errors: str = "raise") -> Imported:
    """The problems of many states of one MuJoCo model, by `mj_forward` on each, and MuJoCo's own answers.

    Parameters
    ----------
    model : mujoco.MjModel
        Its solver, tolerance and iterations make the answers. J is asked for as a dense matrix.
    states : (n, nq + nv), or (n, size) of mjSTATE_FULLPHYSICS or mjSTATE_INTEGRATION
        qpos and qvel, or what `mj_getState` gives.
    threads : int
        `mj_forward` at the same time; the results do not depend on it.
    errors : {"raise", "status"}
        Of a state that is not finite: raise, or make it a world without rows whose v_free is NaN, which `solve_many`
        and `residual_many` refuse by its number, or pass with the same word.

    Returns
    -------
    Imported
        `batch[i]` is the problem that `from_mujoco` makes of state i, to rounding, each row of an equality a block.

    Raises
    ------
    InputError
        Another model, states of another size, or one that is not finite.
    CapabilityError
        An integrator whose constraint problem is not of M.
    """
    import mujoco as mj

    if not isinstance(model, mj.MjModel):
        raise InputError(f"model is a {type(model).__name__}; a mujoco.MjModel is needed")
    word = mj.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_").lower()
    if word not in map(str.lower, single.OF_M):
        raise CapabilityError(
            f"integrator={word!r} puts damping into M; {', '.join(map(repr, single.OF_M))} have M itself"
        )
    if mj.mj_isSparse(model):
        import copy

        model = copy.copy(model)
        model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
    check_errors(errors)
    given = np.ascontiguousarray(as_array("states", states, (None, None), finite=errors == "raise"))
    size = given.shape[1]
    kinds = {model.nq + model.nv: mj.mjtState.mjSTATE_QPOS | mj.mjtState.mjSTATE_QVEL}
    for kind in (mj.mjtState.mjSTATE_FULLPHYSICS, mj.mjtState.mjSTATE_INTEGRATION):
        kinds.setdefault(mj.mj_stateSize(model, kind), kind)
    if size not in kinds:
        raise InputError(f"states have {size} numbers each; one of {sorted(kinds)} is needed")
    n, elliptic = len(given), model.opt.cone == mj.mjtCone.mjCONE_ELLIPTIC
    found: list[Any] = [None] * n
    held: list[Any] = [np.zeros(0, np.int32)] * n  # what names are made of
    free, smooth = np.full((n, model.nv), np.nan), np.zeros((n, model.nv))
    mass = np.zeros((n, len(model.M_colind)))
    mass[:, model.M_rowadr + model.M_rownnz - 1] = 1.0  # its diagonal, of a state that is not finite
    none = [np.zeros(0) for _ in OF_ROWS]
    todo = iter(range(n))

    def work(_: int) -> None:
        data = mj.MjData(model)
        for i in todo:
            if not all_finite(given[i]):
                found[i] = none
                continue
            mj.mj_setState(model, data, given[i], kinds[size])
            mj.mj_forward(model, data)
            free[i], smooth[i], mass[i] = data.qvel, data.qacc_smooth, data.M
            arrays = [getattr(data, name).copy() for name in OF_ROWS]
            if elliptic and data.ncon:
                c = data.contact
                arrays += [c.efc_address.copy(), c.dim.copy(), c.friction.copy()]
            found[i] = arrays
            contact = data.contact if data.ncon else single.NO_CONTACT
            held[i] = np.concatenate([data.efc_type, data.efc_id, contact.dim, np.ravel(contact.geom)])

    threads = whole_number("threads", threads, 1, None)
    if threads == 1:
        work(0)
    else:
        with ThreadPoolExecutor(min(threads, max(n, 1))) as pool:
            list(pool.map(work, range(min(threads, max(n, 1)))))
    made = _gathered(model, found, mass, free, smooth, elliptic)
    made.batch.names_of = lambda i: single._words(mj, model, held[i], len(found[i][1]), 1)
    return made


def _gathered(model: Any, found: list[Any], mass: Any, before: Any, smooth: Any, elliptic: bool) -> Imported:
    """Ragged arrays of all rows, from those of each state."""
    n, nv, dt = len(found), model.nv, float(model.opt.timestep)
    count = np.array([len(x[1]) for x in found], np.int64)
    ptr = np.concatenate([[0], np.cumsum(count)])
    jac, stiff, aref, force, of, loss, velocity = (
        np.concatenate([x[k].ravel() for x in found]) if n else np.zeros(0) for k in range(len(OF_ROWS))
    )
    jac = jac.reshape(-1, nv)
    contacts = None
    if elliptic:
        held = [x for x in found if len(x) > len(OF_ROWS)]
        begin = np.repeat(ptr[:-1], [len(x[7]) if len(x) > len(OF_ROWS) else 0 for x in found])
        parts = [np.concatenate([x[k] for x in held]) if held else np.zeros((0, 5)) for k in (7, 8, 9)]
        address = np.where(parts[0] < 0, -1, parts[0] + begin) if held else np.zeros(0, int)
        contacts = (np.zeros(len(address), int), address, parts[1].reshape(len(address)), parts[2])
    cones, scale = _blocks(of[None], loss[None], np.ones((1, len(of)), bool), contacts, dt)
    goal = dt * aref + velocity
    soft, lam = 1.0 / stiff, dt * force
    if scale is not None:
        s = scale[0]
        jac *= s[:, None]
        goal, soft, lam = goal * s, soft * s * s, lam / s
    batch = Batch(
        jac,
        (mass, model.M_colind, np.append(model.M_rowadr, len(model.M_colind))),
        before + dt * smooth,
        target=goal,
        cones=cones,
        compliance=soft,
        friction="cone",
        row_ptr=ptr,
    )
    return Imported(batch, lam)


def whole_mass(model: Any, mass: Any) -> Any:
    """M (n, nv, nv) of its lower triangles (n, entries), stored as the model says."""
    n, nv = len(mass), model.nv
    row, whole = np.repeat(np.arange(nv), model.M_rownnz), np.zeros((n, nv, nv), mass.dtype)
    whole[:, row, model.M_colind] = mass
    whole[:, model.M_colind, row] = mass
    return whole


def _check_mass(mass: Any, smooth: FloatArray, force: FloatArray, precision: str) -> None:
    """M a0 must be the smooth force, of the size of its terms."""
    gap = np.abs(np.einsum("nij,nj->ni", mass.astype(float), smooth) - force).max(axis=1, initial=0.0)
    size = np.einsum("nij,nj->ni", np.abs(mass.astype(float)), np.abs(smooth)).max(axis=1, initial=0.0)
    bad = np.flatnonzero(gap > ROUNDING[precision] * size)
    if len(bad):
        i = bad[0]
        raise CapabilityError(
            f"world {i}: M qacc_smooth differs from qfrc_smooth by {gap[i] / size[i]:.1e} of their size; these data "
            "are not those of M (an integrator that puts damping into it, or arrays of another step)"
        )


def _blocks(of: Any, loss: Any, counted: Any, contacts: Any, dt: float) -> tuple[Cones, FloatArray | None]:
    """Blocks of all rows that count, one world after the other, and the factor of each row (n, m), None: 1."""
    n, m = of.shape
    begins, tangents, mu = np.ones((n, m), bool), np.zeros((n, m), np.int32), np.zeros((n, m))
    scale = None
    elliptic = (of == ELLIPTIC) & counted
    if elliptic.any() and contacts is None:
        raise InputError("efc_type has rows of elliptic contacts; contacts= is needed, with their friction")
    if contacts is not None:
        world, address, dim, rub = (np.asarray(x) for x in contacts)
        inside = (address < m) & (world >= 0) & (world < n) & (address >= 0)
        here = np.flatnonzero(inside)
        here = here[elliptic[world[here], address[here]] & (dim[here] > 1)]
        world, address, dim, rub = world[here], address[here], dim[here], rub[here].astype(float)
        if np.sum(dim) != np.count_nonzero(elliptic):
            rows = np.count_nonzero(elliptic)
            raise InputError(
                f"efc_type has {rows} rows of elliptic contacts, contacts name {np.sum(dim)} of them"
            )
        tangents[world, address], mu[world, address] = dim - 1, rub[:, 0]
        factor = np.ones((n, m))
        for j in range(1, int(np.max(dim, initial=1))):
            at = dim > j
            begins[world[at], address[at] + j] = False
            factor[world[at], address[at] + j] = rub[at, j - 1] / rub[at, 0]
        if (factor != 1.0).any():
            scale = factor
    free = of == EQUALITY
    held = np.isin(of, FRICTION)
    upper = np.where(held, dt * loss, np.inf)[counted]
    lower = np.where(held, -dt * loss, np.where(free, -np.inf, 0.0))[counted]
    first = begins[counted]
    ptr = np.append(np.flatnonzero(first), len(first)).astype(np.int32)
    none = np.zeros(len(ptr) - 1)
    tangents = tangents[counted][first]
    kinds = kinds_of(tangents > 0, tangents=tangents)
    return Cones(
        ptr=ptr, kind=kinds, lower=lower, upper=upper, mu=mu[counted][first], patch_radius=none
    ), scale
