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

from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    as_array,
    as_floats,
    check_choice,
    check_float,
    check_int,
    precision_of,
    shape_of,
)
from lavender.base.errors import CapabilityError, InputError
from lavender.base.threads import run_on_threads
from lavender.batch.data import ERRORS, Batch, check_counts, check_triangle
from lavender.io import mujoco as single
from lavender.problem.cones import Cones, kinds_of
from lavender_ext.judge.measure import all_finite

# Values of mjtConstraint: an equality, friction loss, the first and the last one. Rows of all others only push.
EQUALITY, FRICTION, ELLIPTIC = 0, (1, 2), 7
MAX_CONTACT_ROWS = 6  # The largest condim: a contact has a normal and up to five friction rows.
# What is read of each row, beside efc_J, and of each contact: type and shape.
OF_ROWS: dict[str, Any] = dict.fromkeys(
    ("efc_D", "efc_aref", "efc_force", "efc_frictionloss", "efc_vel"), (float, ())
) | dict.fromkeys(("efc_type", "efc_id"), (np.int32, ()))
OF_CONTACTS: dict[str, Any] = {
    "efc_address": (np.int32, ()), "dim": (np.int32, ()), "geom": (np.int32, (2,)), "friction": (float, (5,)),
}  # fmt: skip
CHUNK = 2**21  # entries of J that are widened at once
# M a0 beside the smooth force, of their size: 64 roundings, in float64 and in float32, where factors are rounded, too.
ROUNDING = {"float64": single.ROUNDING, "float32": 2.0**-14}


class Imported(NamedTuple):
    """Problems of many worlds, and the engine's own answers to them."""

    batch: Batch
    impulse: FloatArray | None  # N s, in the batch's shape: dt efc_force in the batch's rows


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # of rows that do not count
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
        Values of mjtConstraint, 0 to 7.
    M : (n, nv, nv)
        Mass matrix, both triangles. Or its lower triangles in compressed rows, as MuJoCo Warp holds them: (values
        (n, entries), indices, indptr).
    qvel, qacc_smooth : (n, nv)
        Velocity before the step and unconstrained acceleration.
    timestep : float, s
    efc_frictionloss : scalar, (n, m) or (m,)
        Read on rows of friction loss.
    nefc : (n,) int, optional
        Rows that count, 0 to m; default m. The numbers of the rows behind them are not read.
    contacts : (world, efc_address, dim, friction), optional
        Of contacts: (c,), (c,), (c,) int and (c, 5). Those that begin at an elliptic row that counts are read, and
        must name each of these rows once. All others are ignored.
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
        Shapes that do not fit; an efc_type that is no value of mjtConstraint; a D that is not above 0; a friction loss
        below 0; elliptic rows that no contact names, or several.
    CapabilityError
        M qacc_smooth is not the smooth force: another matrix has made the problem.
    """
    jac, before = as_floats("efc_J", efc_J), as_floats("qvel", qvel)
    # MJX and Warp hold the time step as an array of one number.
    is_one = np.prod(shape_of("timestep", timestep)) == 1
    dt = check_float("timestep", np.asarray(timestep).item() if is_one else timestep, above=0.0)
    if jac.ndim != 3:
        raise InputError(f"efc_J has shape {jac.shape}; (n, m, nv) is needed")
    n, m, nv = jac.shape
    stiff = as_array("efc_D", efc_D, (n, m), finite=False)
    goal = dt * as_array("efc_aref", efc_aref, (n, m), finite=False)
    smooth = as_array("qacc_smooth", qacc_smooth, (n, nv), finite=False)
    of, loss = _of_rows("efc_type", efc_type, n, m), _of_rows("efc_frictionloss", efc_frictionloss, n, m)
    count = np.full(n, m) if nefc is None else check_counts("nefc", nefc, n, m)
    counted = np.arange(m) < count[:, None]
    _check_rows(
        "efc_type",
        of,
        counted & ~((of >= 0.0) & (of <= ELLIPTIC) & (of == np.rint(of))),
        "a value of mjtConstraint, 0 to 7,",
    )
    _check_rows("efc_D", stiff, counted & (stiff <= 0.0), "above 0")
    held = counted & ((of == FRICTION[0]) | (of == FRICTION[1]))
    _check_rows("efc_frictionloss", loss, held & ~((loss >= 0.0) & (loss < np.inf)), "a finite number from 0")
    mass = _mass(M, n, nv)
    precision = precision_of(jac, mass, before)
    before = as_array("qvel", before, (n, nv), finite=False)
    if qfrc_smooth is not None:
        _check_mass(mass, smooth, as_array("qfrc_smooth", qfrc_smooth, (n, nv), finite=False), precision)
    free = before + dt * smooth
    step = max(1, CHUNK // max(1, m * nv))
    for i in range(0, n, step):
        goal[i : i + step] += np.einsum("nij,nj->ni", jac[i : i + step].astype(float), before[i : i + step])
    soft = np.where(counted, 1.0 / stiff, 0.0)
    cones, scale = _blocks(of, loss, counted, contacts, dt)
    if scale is not None:
        jac = jac * scale[:, :, None].astype(jac.dtype)
        goal, soft = goal * scale, soft * scale * scale
    batch = Batch(jac, mass, free, target=goal, cones=cones, compliance=soft, friction="cone", count=count)
    batch.precision = precision
    if efc_force is None:
        return Imported(batch, None)
    lam = np.where(counted, dt * as_array("efc_force", efc_force, (n, m), finite=False), 0.0)
    return Imported(batch, lam if scale is None else lam / scale)


def from_mujoco_many(model: Any, states: Any, *, threads: int = 1, errors: str = "raise") -> Imported:
    """The problems of many states of one MuJoCo model, by `mj_forward` on each, and MuJoCo's own answers.

    Parameters
    ----------
    model : mujoco.MjModel
        Its options (solver, tolerance, iterations, jacobian, ...) make the answers.
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
        After `noslip_iterations` `impulse` is no solution of it.

    Raises
    ------
    InputError
        Another model, states of another size, one that is not finite, or one at which MuJoCo ends in an error.
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
    check_choice("errors", errors, ERRORS)
    given = np.ascontiguousarray(as_array("states", states, (None, None), finite=errors == "raise"))
    size = given.shape[1]
    kinds = {model.nq + model.nv: mj.mjtState.mjSTATE_QPOS | mj.mjtState.mjSTATE_QVEL}
    for kind in (mj.mjtState.mjSTATE_FULLPHYSICS, mj.mjtState.mjSTATE_INTEGRATION):
        kinds.setdefault(mj.mj_stateSize(model, kind), kind)
    if size not in kinds:
        raise InputError(f"states have {size} numbers each; one of {sorted(kinds)} is needed")
    n, nv, sparse = len(given), model.nv, bool(mj.mj_isSparse(model))
    free, smooth = np.full((n, nv), np.nan), np.zeros((n, nv))
    mass = np.zeros((n, len(model.M_colind)))
    mass[:, model.M_rowadr + model.M_rownnz - 1] = 1.0  # its diagonal, of a state that is not finite
    todo = iter(range(n))
    threads = min(check_int("threads", threads, 1, None), max(n, 1))

    def work(stop: bytearray) -> tuple[_Stretches, _Stretches]:
        data = mj.MjData(model)
        rows = _Stretches(n // threads, efc_J=(float, (nv,)), **OF_ROWS)
        contacts = _Stretches(n // threads, **OF_CONTACTS)
        for i in todo:
            if stop[0]:
                break
            if not all_finite(given[i]):
                continue
            mj.mj_setState(model, data, given[i], kinds[size])
            try:
                mj.mj_forward(model, data)
            except mj.FatalError as error:
                raise InputError(f"state {i}: MuJoCo ends in an error, {error}") from None
            free[i], smooth[i], mass[i] = data.qvel, data.qacc_smooth, data.M
            mj.mj_mulJacVec(model, data, data.efc_vel, data.qvel)  # MuJoCo's has the speeds of surfaces, too
            rows.take(i, data, data.nefc, efc_J=jacobian(data))
            if data.ncon:
                contacts.take(i, data.contact, data.ncon)
        return rows, contacts

    def jacobian(data: Any) -> FloatArray:
        m = data.nefc
        if not sparse:  # there is room behind it where rows of zeros were counted and left out
            return np.reshape(data.efc_J[: m * nv], (m, nv))
        jac = np.empty((m, nv))
        mj.mju_sparse2dense(jac, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        return jac

    parts = run_on_threads(work, threads)
    rows, ptr = _in_order([of_rows for of_rows, _ in parts], n)
    contacts, contact_ptr = _in_order([of_contacts for _, of_contacts in parts], n)
    made = _gathered(model, rows, ptr, contacts, contact_ptr, mass, free, smooth)
    of_row = rows["efc_type"], rows["efc_id"]
    of_contact = contacts["dim"], contacts["geom"]

    def words(i: int) -> Any:
        here, there = slice(ptr[i], ptr[i + 1]), slice(contact_ptr[i], contact_ptr[i + 1])
        held = np.concatenate([*(x[here] for x in of_row), *(x[there].ravel() for x in of_contact)])
        return single._words(mj, model, held, int(ptr[i + 1] - ptr[i]), 1)

    made.batch.names_of = words
    world = np.repeat(np.arange(n), np.diff(contact_ptr))
    made.batch.contact_counts = np.bincount(world[contacts["efc_address"] >= 0], minlength=n)
    return made


class _Stretches:
    """Arrays of many states one after the other, as they come, in room that grows to what `states` will need."""

    def __init__(self, states: int, **kinds: tuple[type, tuple[int, ...]]) -> None:
        self.arrays: dict[str, Any] = {
            name: np.empty((0, *shape), dtype) for name, (dtype, shape) in kinds.items()
        }
        self.states, self.n, self.room = states, 0, 0
        self.of: list[int] = []  # which state each stretch is of,
        self.counts: list[int] = []  # and its length

    def take(self, i: int, source: Any, count: int, **given: FloatArray) -> None:
        """Those of state i by their names, of the source where they are not given."""
        begin, end = self.n, self.n + count
        self.of.append(i)
        self.counts.append(count)
        if end > self.room:
            self.room = int(end * min(4.0, 1.25 * max(1.0, self.states / len(self.of)))) + 1
            for name, x in self.arrays.items():
                self.arrays[name] = np.empty((self.room, *x.shape[1:]), x.dtype)
                self.arrays[name][:begin] = x[:begin]
        for name, x in self.arrays.items():
            x[begin:end] = given[name] if name in given else getattr(source, name)
        self.n = end


def _in_order(parts: list[_Stretches], n: int) -> tuple[dict[str, Any], Any]:
    """Arrays of all n states in their order, and where each begins (n + 1,)."""
    count, ptr = np.zeros(n, np.int64), np.zeros(n + 1, np.int64)
    own = [(np.array(part.of, np.int64), np.array(part.counts, np.int64)) for part in parts]
    for of, counts in own:
        count[of] = counts
    np.cumsum(count, out=ptr[1:])
    if len(parts) == 1:
        return {name: x[: ptr[-1]] for name, x in parts[0].arrays.items()}, ptr
    out = {name: np.empty((ptr[-1], *x.shape[1:]), x.dtype) for name, x in parts[0].arrays.items()}
    for part, (of, counts) in zip(parts, own, strict=True):
        to = np.repeat(ptr[of] - (np.cumsum(counts) - counts), counts) + np.arange(part.n)
        for name, x in part.arrays.items():
            out[name][to] = x[: part.n]
    return out, ptr


def _gathered(
    model: Any, rows: Any, ptr: Any, contact: Any, contact_ptr: Any, mass: Any, before: Any, smooth: Any
) -> Imported:
    """Of the rows and contacts of all states, one after the other."""
    dt, jac, of, contacts = float(model.opt.timestep), rows["efc_J"], rows["efc_type"], None
    if (of == ELLIPTIC).any():
        address = contact["efc_address"]
        address = np.where(address < 0, -1, address + np.repeat(ptr[:-1], np.diff(contact_ptr)))
        contacts = (np.zeros(len(address), int), address, contact["dim"], contact["friction"])
    cones, scale = _blocks(
        of[None], rows["efc_frictionloss"][None], np.ones((1, len(of)), bool), contacts, dt
    )
    goal = dt * rows["efc_aref"] + rows["efc_vel"]
    soft, lam = 1.0 / rows["efc_D"], dt * rows["efc_force"]
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


def _of_rows(name: str, given: Any, n: int, m: int) -> FloatArray:
    """Numbers of all rows (n, m), of (n, m), (m,) or one number."""
    if len(shape_of(name, given)) == 2:
        return as_array(name, given, (n, m), finite=False)
    return np.broadcast_to(as_array(name, given, (m,), finite=False), (n, m))


def _check_rows(name: str, numbers: FloatArray, wrong: Any, needed: str) -> None:
    """Raise InputError at the first row of a world that is wrong."""
    if wrong.any():
        at = np.argwhere(wrong)
        i, row = at[0]
        raise InputError(
            f"{name} of world {i}, row {row} is {numbers[i, row]:g}, {len(at)} in all; {needed} is needed"
        )


def _mass(given: Any, n: int, nv: int) -> Any:
    """M (n, nv, nv), also of its lower triangles in compressed rows."""
    values, *pattern = given if isinstance(given, tuple) and given else (given,)
    values = as_floats("M", values)
    if not pattern:
        if values.ndim == 2:
            values = np.broadcast_to(values, (n, *values.shape))
        if values.shape != (n, nv, nv):
            raise InputError(f"M has shape {values.shape}; {(n, nv, nv)} is needed")
        return values
    if values.ndim != 2 or len(values) != n:
        raise InputError(f"values of M have shape {values.shape}; ({n}, entries) is needed")
    ptr, col = check_triangle(pattern, np.full(n, nv), values)
    row, whole = np.repeat(np.arange(nv), np.diff(ptr)), np.zeros((n, nv, nv), values.dtype)
    whole[:, row, col] = values
    whole[:, col, row] = values
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


def _elliptic_contacts(contacts: Any, elliptic: Any) -> tuple[Any, ...]:
    """Return world, first row, rows and coefficients of each contact that begins at a row of `elliptic` (n, m).

    Raises
    ------
    InputError
        Not four arrays of one length; a contact without friction coefficients; rows that no contact or several name.
    """
    if not isinstance(contacts, (tuple, list)) or len(contacts) != 4:
        raise InputError(f"contacts is {contacts!r:.60}; (world, efc_address, dim, friction) is needed")
    names = [f"{name} of contacts" for name in ("world", "efc_address", "dim")]
    size = (shape_of(names[0], contacts[0]) or (None,))[0]
    world, address, dim = (
        as_array(name, x, (size,), dtype=np.int32) for name, x in zip(names, contacts, strict=False)
    )
    rub = as_array("friction of contacts", contacts[3], (size, MAX_CONTACT_ROWS - 1), finite=False)
    n, m = elliptic.shape
    here = np.flatnonzero((address < m) & (world >= 0) & (world < n) & (address >= 0))
    here = here[elliptic[world[here], address[here]] & (dim[here] > 1)]
    world, address, dim, rub = world[here], address[here], dim[here], rub[here]
    large = np.flatnonzero(dim > np.minimum(MAX_CONTACT_ROWS, m - address))
    if len(large):
        k = large[0]
        raise InputError(
            f"dim of contact {here[k]} is {dim[k]}; at most {MAX_CONTACT_ROWS}, and rows up to {m}, are needed"
        )
    used = np.arange(1, MAX_CONTACT_ROWS) < dim[:, None]
    bad = np.argwhere(used & ~((rub > 0.0) & (rub < np.inf)))
    if len(bad):
        k, j = bad[0]
        raise InputError(
            f"friction of contact {here[k]} is {rub[k, j]:g} at {j}; a finite number above 0 is needed"
        )
    first = world * np.int64(m) + address
    rows = [first[dim > j] + j for j in range(MAX_CONTACT_ROWS)]
    named = np.bincount(np.concatenate(rows), minlength=n * m).reshape(n, m)
    if (named != elliptic).any():
        off = np.argwhere(named != elliptic)
        i, row = off[0]
        kind = "an" if elliptic[i, row] else "no"
        raise InputError(
            f"row {row} of world {i} is {kind} elliptic row by efc_type, and {named[i, row]} contacts name it, "
            f"{len(off)} such rows in all; each elliptic row is needed once"
        )
    return world, address, dim, rub


def _blocks(of: Any, loss: Any, counted: Any, contacts: Any, dt: float) -> tuple[Cones, FloatArray | None]:
    """Blocks of all rows that count, one world after the other, and the factor of each row (n, m), None: 1."""
    n, m = of.shape
    begins, tangents, mu = np.ones((n, m), bool), np.zeros((n, m), np.int32), np.zeros((n, m))
    scale = None
    elliptic = (of == ELLIPTIC) & counted
    if elliptic.any() and contacts is None:
        raise InputError("efc_type has rows of elliptic contacts; contacts= is needed, with their friction")
    if contacts is not None:
        world, address, dim, rub = _elliptic_contacts(contacts, elliptic)
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
