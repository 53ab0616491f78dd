"""Convert MuJoCo's constraint problem, the `efc_*` arrays after `mj_forward`, to a `Problem`.

MuJoCo solves for forces f [N, N m] and accelerations. With its Jacobian J, mass matrix M, regularisation R > 0,
unconstrained acceleration a0 and reference acceleration aref it minimises

    1/2 f.(J M^-1 J^T + R) f + f.(J a0 - aref)     over its friction cones and bounds

    mujoco.mj_forward(model, data)
    problem = lavender.io.from_mujoco(model, data)
    lavender.residual(problem, lavender.io.mujoco.impulse(model, data)).relative    # judge MuJoCo's own answer

Multiplication by the time step dt gives the same problem in impulses and velocities:

    lambda = dt f      A = J M^-1 J^T + diag(R)      b = dt (aref - J a0)      w = A lambda - b = dt (J a + R f - aref)

The problem holds J and M unchanged (`Problem.generalized`), and R as its compliance. With `integrator="discrete"`, M
is MuJoCo's matrix M + h D + h^2 K of dampings D and stiffnesses K (`lavender.io.mujoco_discrete`). Rows keep MuJoCo's
order; tangents of a contact with different coefficients are scaled by friction[j] / friction[0], so that its cone is
round. `docs/mujoco.md` lists the block of each constraint and the differences from rigid contact.

The data are checked for consistency: every index before it is used; M a0 must equal the smooth force and 1 / R must
equal efc_D; J must reproduce efc_vel, efc_b and qfrc_constraint. Data of a problem with another matrix are rejected.
The checks do not depend on the answer of MuJoCo's solver: if the solver stopped before convergence, the judge reports
the error of `impulse`.
"""

from __future__ import annotations

import re
import weakref
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, IntArray, as_array, mark_read_only
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import sparse as sp
from lavender.io.engine_motion import EngineMotion
from lavender.io.mujoco_discrete import MASS_TOLERANCE, compute_discrete_matrix
from lavender.io.mujoco_memory import CHANGED_ADVICE, OTHER_MODEL_ADVICE, read_step
from lavender.io.rest import count_tiny_as_zero
from lavender.io.stiff_rows import MAX_EXAMINED_COMPLIANCE, raise_compliance
from lavender.problem import Names, Problem
from lavender.problem.cones import Cones
from lavender.problem.engine_record import EngineRecord, EngineSource
from lavender.problem.generalized import Generalized
from lavender.problem.operators import MAX_SAFE_ENTRY
from lavender_ext.core.checks import max_abs_of_array
from lavender_ext.core.problem import LAWS, make_generalized_data
from lavender_ext.io import mujoco_rows
from lavender_ext.io.mujoco_rows import Step

COMPLIANCE_TOLERANCE = 1e-9  # Largest accepted |R D - 1| [-].
# Largest accepted difference of a product with J from MuJoCo's stored result, relative to the size of its terms.
# Adding 1,000 terms in another order stays below it; data that were changed exceed it by far.
SUM_TOLERANCE = 2.0**-40
# [-] Largest difference of a velocity after a step from the predicted one, relative to the largest velocity and to
# 1 m/s: the rounding of a solve with a mass matrix of a condition of up to 1e6.
PREDICTION_TOLERANCE = 1e-9
CONTACT_NUMBER = re.compile(
    r"contact (\d+) "
)  # Of a block's name: the number of the contact in MjData.
# The velocity before the step is recovered from the velocities of bodies only if each joint's axis has at least this
# fraction that is independent of the joints before it in the same body [-].
MIN_INDEPENDENT_AXIS_FRACTION = 1e-10
DIVERGED_TEXT = (
    "qacc holds numbers that are not finite: the simulation has diverged, or the data was changed. Use data of an "
    "earlier step"
)
FLOAT32_GAP = (
    1e-5  # [-] Largest relative difference of M qacc_smooth and qfrc_smooth of data in float32.
)
FLOAT32_ADVICE = (
    "as in float32: mjx.get_data and mujoco_warp.get_data_into copy results of an engine in float32. Pass the arrays "
    "of that engine (efc_J, efc_D, efc_aref, ...) to lavender.io.from_efc"
)
LAYOUT_NOTE = "(also if opt.jacobian, which determines the layout of efc_J, was changed)"


def from_mujoco(model: Any, data: Any, *, name: str = "mujoco") -> Problem:
    """Return the constraint problem that MuJoCo solved last, in impulses and velocities; see the module.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        After `mj_forward` or `mj_step`; v* belongs to the velocities before the step.
    name : str
        Name of the problem; "(noslip)" is added if `noslip_iterations` moved MuJoCo's impulses away from the solution.

    Returns
    -------
    Problem
        In generalised coordinates, with v* and keys of blocks (geoms and number of a contact, joint, tendon,
        equality). The law is "cone" with elliptic friction cones, "lcp" with pyramidal cones or without friction,
        "linear" with only equalities. The problem has no initial guess; `impulse(model, data)` returns MuJoCo's
        answer.

    Raises
    ------
    InputError
        The arguments are not a model and its data; `mj_forward` was not called; the time step is not above 0; numbers
        are not finite; indices (`efc_id`, `contact.dim`, `efc_J_colind`, ...) are out of range.
    CapabilityError
        The data do not belong to the problem of J, M and R: `opt.jacobian` changed since the forward pass, a copy lacks
        needed arrays, MuJoCo does not store the stiffness of a flex (`integrator="discrete"` without Newton's method),
        or, after `mj_step`, joints of one body have dependent axes. It is not raised if MuJoCo's solver stopped before
        convergence: the problem does not depend on the answer.
    """
    step = read_step(model, data)
    kept = step.cache
    dt = _get_timestep(step)
    if step.has_noslip:
        name += " (noslip)"
    mass, change = _read_mass(step, data)
    blocks = make_blocks(step, data)
    jac = _read_jacobian(step, data, blocks)
    before = _get_velocity_before(step)
    b, compliance, v_free, is_regular, gap, gaps, least = mujoco_rows.compute_problem_numbers(
        step, blocks, jac, before, SUM_TOLERANCE, COMPLIANCE_TOLERANCE, MAX_SAFE_ENTRY
    )
    if not is_regular:
        _check_jacobian(*gaps)
        if not gap <= COMPLIANCE_TOLERANCE:
            compliance = _compute_compliance(data) * get_row_scales(blocks) * get_row_scales(blocks)
            least = compliance.min()
    general = Generalized.from_compressed_rows(jac, mass, v_free, like=kept.operator)
    operator = kept.operator = general.operator
    rest = kept.mj, model, blocks, b, compliance, general
    is_stiff = least < MAX_EXAMINED_COMPLIANCE
    if (
        is_regular
        and change is None
        and not is_stiff
        and not operator.has_entry_above(MAX_SAFE_ENTRY)
    ):
        view = make_generalized_data(blocks, b, operator, compliance, LAWS["cone"])
        problem: Problem = Problem._from_checked_data(view, "cone", name, (_make_fields, rest))
    else:
        if change is not None:  # MuJoCo's own a0 is as accurate as opt.tolerance only.
            b = mark_read_only(count_tiny_as_zero(b - dt * general.velocity_of(change)))
            general = general.with_jacobian(v_free=v_free + dt * change)
        fields = _make_fields(*rest[:3], b, compliance, general)
        problem = Problem(**fields, friction="cone", name=name, copy=False)
        raised = raise_compliance(problem) if is_stiff else None
        if raised is not None:
            problem = replace(problem, compliance=raised)
    is_stepped, answer = before is not None, None
    # Copies of what the step overwrites; the motion is made when it is judged.
    *arrays, velocity = mujoco_rows.copy_answer(step)
    if step.m and not step.has_noslip:
        if change is not None:
            arrays[2][:] += change
        momentum = dt * data.qfrc_constraint if is_stiff else None
        how = kept.mj, model, model.opt.integrator, step.is_discrete, is_stepped
        answer = partial(_make_motion, how, dt, blocks, arrays, compliance, momentum, is_stiff)
    source = EngineSource(weakref.ref(data), model, velocity, is_stepped)
    problem._set_record(EngineRecord(answer, source, _predict_velocity))
    return problem


def _predict_velocity(source: EngineSource) -> FloatArray | None:
    """Return the velocity after the step (nv,) that the answer predicts; None if the data were stepped since."""
    data = source.get_data()
    if data is None or not np.array_equal(data.qvel, source.velocity):
        return None
    return engine_answer(source.model, data).velocity


def _make_motion(
    how: tuple[Any, ...],
    dt: float,
    blocks: Any,
    arrays: list[FloatArray],
    compliance: FloatArray,
    momentum: FloatArray | None,
    is_stiff: bool,
) -> EngineMotion | None:
    """Return the motion of a step from copies of efc_force, qacc and qacc_smooth, or None if the forces are judged.

    `how` has the arguments of `find_mover`.
    """
    moved_by = find_mover(*how)
    if moved_by != "acceleration" and not is_stiff:
        return None
    force, acceleration, smooth = arrays
    lam = _divide_by_scale(dt * force, get_row_scales(blocks))
    return EngineMotion(lam, dt * (acceleration - smooth), compliance, moved_by, momentum)


class EngineAnswer(NamedTuple):
    """The part of the solver's answer that MuJoCo's integrator uses, and the velocity that follows.

    Parameters
    ----------
    moved_by : {"acceleration", "forces"}
        Euler's method without damping, `discrete` and RK4 use qacc; Euler's method with damping, `implicit` and
        `implicitfast` use qfrc_constraint.
    impulse : (m,), N s
        The forces in the rows of the problem.
    velocity : (nv,), m/s, rad/s
        Velocity after the step by this answer alone. NaN if it cannot be predicted: with RK4, which uses the answers of
        four forward passes, and if `mj_step` has advanced activations that the implicit integrators differentiate.
    """

    moved_by: str
    impulse: FloatArray
    velocity: FloatArray


def engine_answer(model: Any, data: Any) -> EngineAnswer:
    """Return the answer that moved the bodies in the last step, or will move them in the next one.

    The predicted velocity contains only the quantity of `moved_by`: it equals MuJoCo's own next qvel, to rounding,
    unless the model or the data were changed between the forward pass and the integration.

    Parameters
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        After `mj_forward` or `mj_step`. It is not changed.
    """
    step = read_step(model, data)
    dt = _get_timestep(step)
    mj = step.cache.mj
    scale = get_row_scales(make_blocks(step, data))
    impulse = _scale_force(step, data, scale)
    before = _get_velocity_before(step)
    moved_by = find_mover_of_step(step, before is not None)
    start = data.qvel.copy() if before is None else before
    is_runge_kutta = model.opt.integrator == mj.mjtIntegrator.mjINT_RK4
    if is_runge_kutta or (moved_by == "forces" and before is not None and model.na):
        return EngineAnswer(moved_by, impulse, np.full(step.n, np.nan))
    if moved_by == "acceleration":
        return EngineAnswer(moved_by, impulse, start + dt * data.qacc)
    scratch = mj.MjData(model)
    mj.mj_copyData(scratch, model, data)
    scratch.qvel[:] = start
    velocity = integrate_forces(mj, model, scratch, jacobian(model, data), scale * impulse / dt)
    return EngineAnswer(moved_by, impulse, velocity)


def compute_prediction_gap(problem: Problem) -> float:
    """Return the largest difference of qvel after `mj_step` from the velocity that the answer predicts [m/s, rad/s].

    It is 0 up to rounding, 1e-9 of the largest velocity; and NaN if the problem was made before the step, if the data
    were stepped since, or if the velocity cannot be predicted.
    """
    record = problem.record
    if record is None or record.source is None or not record.source.is_stepped:
        return float("nan")
    predicted, after = record.prediction, record.source.velocity
    if predicted is None:
        return float("nan")
    gap = float(np.abs(predicted - after).max(initial=0.0))
    return (
        gap
        if not gap <= PREDICTION_TOLERANCE * max(1.0, float(np.abs(after).max(initial=0.0)))
        else 0.0
    )


def find_source(problem: Problem) -> tuple[Any, Any, bool]:
    """Return the model and data from which a problem was made, and whether they were stepped before.

    The data are None if they do not exist any more, or if their velocities have changed.
    """
    source = None if problem.record is None else problem.record.source
    if source is None:
        return None, None, False
    data = source.get_data()
    is_same = data is not None and np.array_equal(data.qvel, source.velocity)
    return source.model, data if is_same else None, source.is_stepped


def integrate_forces(mj: Any, model: Any, data: Any, jac: Any, force: FloatArray) -> FloatArray:
    """Return the velocity after the step (nv,) from forces (m,) on the rows of J (m, nv); `data` is advanced.

    MuJoCo's own integrator runs with J^T f, and without an acceleration. Where MuJoCo's sum J^T f differs by rounding
    only, it is used: large forces may cancel.
    """
    total = jac.T @ force
    terms = abs(jac).T @ np.abs(force)
    is_rounding = np.abs(total - data.qfrc_constraint) <= SUM_TOLERANCE * terms
    data.qfrc_constraint[:] = np.where(is_rounding, data.qfrc_constraint, total)
    data.qacc[:] = np.nan
    is_euler = model.opt.integrator == mj.mjtIntegrator.mjINT_EULER
    (mj.mj_Euler if is_euler else mj.mj_implicit)(model, data)
    return np.array(data.qvel)


def find_mover_of_step(step: Step, is_stepped: bool) -> str:
    """Return `find_mover` of a step."""
    model = step.model
    return find_mover(step.cache.mj, model, model.opt.integrator, step.is_discrete, is_stepped)


def find_mover(mj: Any, model: Any, integrator: int, is_discrete: bool, is_stepped: bool) -> str:
    """Return "acceleration" if MuJoCo's integrator uses qacc, and "forces" if it uses qfrc_constraint.

    They describe the same motion if the solver has converged, and with PGS. Euler's method with damping, `implicit` and
    `implicitfast` solve (M - h dF/dv) a = qfrc_smooth + qfrc_constraint; all other methods use qacc. RK4 uses the qacc
    of each of its four passes: after a step, the rows belong to the last pass, and qacc is the mean of all.
    """
    option, kinds = model.opt, mj.mjtIntegrator
    if is_discrete:
        return "acceleration"
    if integrator == kinds.mjINT_RK4:
        return "forces" if is_stepped else "acceleration"
    if integrator != kinds.mjINT_EULER:
        is_implicit = integrator in (kinds.mjINT_IMPLICIT, kinds.mjINT_IMPLICITFAST)
        return "forces" if is_implicit else "acceleration"
    # Euler's method uses forces if it is implicit in the dampings of joints.
    bits = mj.mjtDisableBit
    off = int(bits.mjDSBL_EULERDAMP) | int(
        getattr(bits, "mjDSBL_DAMPER", getattr(bits, "mjDSBL_PASSIVE", 0))
    )
    if int(option.disableflags) & off:
        return "acceleration"
    if np.count_nonzero(model.dof_damping):  # In a tenth of the time of `any`.
        return "forces"
    # MuJoCo 4 has polynomial dampings, and dampings of actuators that act on the velocities of joints.
    poly = getattr(model, "dof_dampingpoly", ())
    actuators = getattr(model, "jnt_actuatorid", -1)
    is_damped = np.count_nonzero(poly) or np.count_nonzero(actuators != -1)
    return "forces" if is_damped else "acceleration"


def _make_fields(
    mj: Any, model: Any, blocks: Any, b: FloatArray, compliance: FloatArray, general: Generalized
) -> dict[str, Any]:
    """Return the fields of a problem; `blocks` is the result of `mujoco_rows.make_blocks`."""
    m = blocks.n_rows
    count = blocks.n_blocks
    return {
        "b": b,
        "generalized": general,
        "compliance": compliance,
        "cones": Cones._from_blocks(blocks),
        "key": get_block_keys(blocks),
        "names": Names(count, lambda: make_block_names(mj, model, blocks.ints[2 * m + 1 :], m)),
        "angular": find_angular_rows(mj, model, blocks.ints[2 * m + 1 :], m),
    }


def get_block_keys(blocks: Any) -> np.ndarray:
    """Return the keys of the blocks (k,) of the result of `mujoco_rows.make_blocks`."""
    first = len(blocks.numbers) - blocks.n_rows
    keys: np.ndarray = blocks.numbers[first : first + blocks.n_blocks].view(np.uint64)
    return keys


@np.errstate(over="ignore", invalid="ignore")
def read_gaps(data: Any, problem: Problem) -> FloatArray:
    """Return the distance [m] of the surfaces of each contact of a problem of `data` (k,), nan of other blocks."""
    numbers = [CONTACT_NUMBER.match(problem.block_name(k)) for k in range(problem.n_blocks)]
    dist = np.array(data.contact.dist)
    return np.array([np.nan if number is None else dist[int(number[1])] for number in numbers])


def impulse(model: Any, data: Any) -> FloatArray:
    """Return MuJoCo's own answer as impulses of the problem's rows (m,) [N s]: dt efc_force divided by `scaling`.

    With `noslip_iterations`, it is not a solution of the problem.
    """
    return _scale_force(read_step(model, data), data, scaling(model, data))


def _scale_force(step: Step, data: Any, scale: FloatArray) -> FloatArray:
    """Return dt efc_force (m,) [N s] divided by the factors of the rows."""
    return _divide_by_scale(step.dt * data.efc_force, scale)


def _divide_by_scale(impulse: FloatArray, scale: FloatArray) -> FloatArray:
    """Return impulses (m,) [N s] divided by the factors of the rows, 0 where the factor is 0."""
    return np.divide(impulse, scale, out=np.zeros(len(scale)), where=scale != 0.0)


def scaling(model: Any, data: Any) -> FloatArray:
    """Return the factor of each row (m,): row of the problem = factor times MuJoCo's row.

    The factor is friction[j] / friction[0] on tangents of an elliptic cone, 2 / torquescale on rotation rows of a weld,
    which are then angular velocities in rad/s, and 1 on all other rows. Impulses are MuJoCo's divided by the factor.
    """
    step = read_step(model, data)
    _get_timestep(step)
    return get_row_scales(make_blocks(step, data))


def acceleration(model: Any, data: Any, impulse: Any) -> FloatArray:
    """Return MuJoCo's `qacc` (nv,) for impulses (m,) [N s] of the problem's rows: a0 + M^-1 J^T lambda / dt."""
    step = read_step(model, data)
    lam = as_array("impulse", impulse, (step.m,), unit="N s")
    force = jacobian(model, data).T @ (scaling(model, data) * lam) / step.dt
    smooth = data.qacc_smooth
    mj = step.cache.mj
    if step.is_discrete:
        matrix = compute_discrete_matrix(mj, model, data, CHANGED_ADVICE)
        return smooth + matrix.solve(force) + (0.0 if matrix.change is None else matrix.change)
    change = np.zeros((1, step.n))
    mj.mj_solveM(model, data, change, force[None, :])
    return np.array(smooth, float) + change[0]


def jacobian(model: Any, data: Any) -> sp.csr_array:
    """Return J (m, nv) of all constraints, whether MuJoCo stores it densely or sparsely."""
    step = read_step(model, data)
    indptr, indices, values = _read_jacobian(step, data, None)
    return sp.csr_array((values.copy(), indices.copy(), indptr.copy()), shape=(step.m, step.n))


def _get_timestep(step: Step) -> float:
    dt: float = step.dt
    if not 0.0 < dt < np.inf:
        raise InputError(f"opt.timestep is {dt} s; a step above 0 is needed")
    return dt


def _read_mass(step: Step, data: Any) -> tuple[Any, Any]:
    """Return the lower triangle of the step's matrix and the correction of a0 (nv,) or None; see `DiscreteMatrix`.

    Raises
    ------
    CapabilityError
        M a0 is not the smooth force: a0 and the problem were computed with a matrix other than M.
    """
    if not step.has_mass:
        raise InputError(
            "M of this MjData is 0, because mj_forward(model, data) was not called: call it, or step the simulation"
        )
    pattern = find_mass_pattern(step)
    if step.is_discrete:
        matrix = compute_discrete_matrix(step.cache.mj, step.model, data, CHANGED_ADVICE)
        return matrix.lower, matrix.change
    values, gap = mujoco_rows.copy_mass(step, pattern)
    mass = *pattern, values
    if not gap <= MASS_TOLERANCE:
        # The smooth force may be small, because its terms cancel.
        lower = abs(sp.csr_array((values, pattern[1], pattern[0]), shape=(step.n, step.n)))
        product = (lower + sp.triu(lower.T, 1)) @ np.abs(data.qacc_smooth)
        size = max_abs_of_array(product + np.abs(data.qfrc_smooth))
        gap *= max_abs_of_array(data.qfrc_smooth) / size if size > 0.0 else 1.0
    if not gap <= MASS_TOLERANCE:
        difference = f"M qacc_smooth differs from qfrc_smooth by {gap:.1e} of their size"
        if gap <= FLOAT32_GAP:
            raise CapabilityError(f"{difference}, {FLOAT32_ADVICE}")
        raise CapabilityError(
            f"{difference}: the problem was built with another M. {CHANGED_ADVICE}"
        )
    return mass, None


def find_mass_pattern(step: Step) -> tuple[IntArray, IntArray]:
    """Return (indptr, indices) of the lower triangle of M, which steps of one model share.

    Raises
    ------
    InputError
        Rows of M are not consecutive, or their columns do not ascend to the diagonal entry.
    """
    kept, model = step.cache, step.model
    if mujoco_rows.has_mass_pattern(step, kept.pattern):
        return kept.pattern
    count = model.M_rownnz
    columns = mark_read_only(model.M_colind.copy())
    indptr = np.append(0, np.cumsum(count)).astype(np.int32)
    is_consecutive = np.all(count > 0) and np.array_equal(
        indptr, np.append(model.M_rowadr, len(columns))
    )
    if (
        not is_consecutive
        or np.any(columns < 0)
        or np.any(columns[indptr[1:] - 1] != np.arange(len(count)))
        or np.any((np.diff(columns) <= 0)[~np.isin(np.arange(1, len(columns)), indptr)])
    ):
        raise InputError(
            f"M_rowadr, M_rownnz and M_colind do not describe the lower triangle of M. {OTHER_MODEL_ADVICE}"
        )
    kept.pattern = mark_read_only(indptr), columns
    return kept.pattern


def _read_jacobian(step: Step, data: Any, blocks: Any) -> Any:
    """Return (indptr, indices, data) of J with the scaled rows of the blocks, or with MuJoCo's rows.

    Raises
    ------
    InputError
        The arrays of efc_J have the wrong size or indices out of range.
    """
    result = mujoco_rows.read_jacobian(step, blocks)
    if isinstance(result, tuple):
        return result
    m = step.m
    n = step.n
    values = np.ravel(data.efc_J)
    if result == -1:
        raise InputError(
            f"efc_J holds {len(values)} numbers; {m} x {n} are needed if opt.jacobian is dense. {CHANGED_ADVICE}"
        )
    count = data.efc_J_rownnz
    first = data.efc_J_rowadr
    columns = np.ravel(data.efc_J_colind)
    if not len(count) == len(first) == m:
        raise InputError(
            f"efc_J_rownnz has {len(count)} entries and efc_J_rowadr {len(first)}; {m} are needed, one for "
            f"each constraint row. {CHANGED_ADVICE} {LAYOUT_NOTE}"
        )
    if result is not None:  # The number of the first invalid row.
        raise InputError(
            f"row {result} of efc_J has {count[result]} entries from position {first[result]}; positions "
            f"below {len(columns)} and columns below {n} are needed. {CHANGED_ADVICE} {LAYOUT_NOTE}"
        )
    # Some rows have unsorted or repeated columns.
    indptr = np.concatenate([[0], np.cumsum(count, dtype=np.int64)])
    source = np.arange(indptr[-1]) + np.repeat(first - indptr[:-1], count)
    scale = np.ones(m) if blocks is None else get_row_scales(blocks)
    jac = sp.csr_array(
        (values[source] * np.repeat(scale, count), columns[source], indptr), shape=(m, n)
    )
    jac.sum_duplicates()
    return jac.indptr.astype(np.int32), jac.indices.astype(np.int32), mark_read_only(jac.data)


@np.errstate(over="ignore", invalid="ignore")
def _compute_compliance(data: Any) -> FloatArray:
    """Return R (m,) [1/kg] for data in which efc_R and 1 / efc_D differ.

    Rows with efc_R = 0, which a copy of the data did not fill, get 1 / efc_D.

    Raises
    ------
    CapabilityError
        efc_R and 1 / efc_D differ on a row with a nonzero efc_R, or an efc_D is not above 0.
    """
    r, inverse = data.efc_R, data.efc_D
    empty = r == 0.0
    if np.any(inverse <= 0.0) or np.any(np.abs(r * inverse - 1.0)[~empty] > COMPLIANCE_TOLERANCE):
        raise CapabilityError(
            "efc_R and 1 / efc_D differ, so the compliance of these constraints is ambiguous. Run "
            "mj_forward on this MjData, or copy both arrays from the data in which the step ran"
        )
    return np.where(empty, 1.0 / inverse, r)


def _get_velocity_before(step: Step) -> FloatArray | None:
    """Return the velocities (nv,) at the last forward pass; None if they are qvel, as after `mj_forward`.

    Raises
    ------
    InputError
        The body tree is invalid.
    CapabilityError
        The velocities cannot be recovered, because joints of one body have dependent axes or the data were changed.
    """
    v = mujoco_rows.find_velocity_before(step, SUM_TOLERANCE, MIN_INDEPENDENT_AXIS_FRACTION)
    if v is None or not isinstance(v, int):
        return v
    if v == -1:
        raise InputError(
            f"dof_bodyid and body_parentid do not describe a tree of these bodies. {OTHER_MODEL_ADVICE}"
        )
    raise CapabilityError(
        "the velocity before the step cannot be computed from cvel and cdof: joints of one body have "
        "dependent axes, or MjData was changed since its forward pass: run mj_forward"
    )


def _check_jacobian(velocity: float, row: float, push: float, finite: float) -> None:
    """Raise an error if products with J differ from MuJoCo's results by more than rounding.

    Parameters
    ----------
    velocity, row, push : float, -
        Relative differences of J qvel from efc_vel, of J a0 - aref from efc_b, and of J^T f from qfrc_constraint.
    finite : float
        0 if all numbers are finite.
    """
    if finite != 0.0:
        raise InputError(DIVERGED_TEXT)
    for difference, names in (
        (velocity, "J qvel and efc_vel"),
        (row, "J qacc_smooth - efc_aref and efc_b"),
        (push, "J^T efc_force and qfrc_constraint"),
    ):
        if not difference <= SUM_TOLERANCE:
            is_small = difference <= FLOAT32_GAP
            cause = f". The difference is {FLOAT32_ADVICE}" if is_small else f" {LAYOUT_NOTE}"
            raise CapabilityError(
                f"{names} differ by {difference:.1e} of their size: efc_J is not the Jacobian of this forward pass. "
                f"{CHANGED_ADVICE}{cause}"
            )


def make_blocks(step: Step, data: Any, max_equality_rows: int = mujoco_rows.MAX_BLOCK_ROWS) -> Any:
    """Return the blocks; see `mujoco_rows.make_blocks`.

    Raises
    ------
    CapabilityError
        A row has an unknown type.
    InputError
        An index is out of range, or a friction loss or coefficient is not a bound.
    """
    result = mujoco_rows.make_blocks(step, max_equality_rows)
    if isinstance(result, int):  # The number of the first invalid row.
        kind, which = int(data.efc_type[result]), int(data.efc_id[result])
        model = step.model
        counts = [model.neq, model.nv, model.ntendon, model.njnt, model.ntendon, *3 * [data.ncon]]
        if not 0 <= kind < len(counts):
            raise CapabilityError(
                f"constraint row {result} is of type {kind}, which is not supported: remove this constraint "
                "from the model"
            )
        is_contact = kind >= 5 and 0 <= which < data.ncon
        dim = f", of condim {data.contact.dim[which]}" if is_contact else ""
        raise InputError(
            f"constraint row {result} of {step.m} is of type {kind} and belongs to number {which} of "
            f"{counts[kind]}{dim}, which does not exist or has fewer rows. {CHANGED_ADVICE}"
        )
    if result.fault:
        raise InputError(
            f"efc_frictionloss or contact friction is negative or not finite. {CHANGED_ADVICE}"
        )
    return result


def get_row_scales(blocks: Any) -> FloatArray:
    """Return the factor of each row (m,) of the blocks of `make_blocks`."""
    scale: FloatArray = blocks.numbers[5 * blocks.n_rows : 6 * blocks.n_rows]
    return scale


def find_angular_rows(mj: Any, model: Any, ints: IntArray, m: int) -> npt.NDArray[np.bool_] | None:
    """Return which of m rows measure an angular velocity [rad/s], None if only contacts do; `ints` as below.

    These are limits and friction of rotating joints, equalities of hinges, and the last three rows of a weld.
    """
    kinds, joints = mj.mjtConstraint, mj.mjtJoint
    types = ints[:m]
    ids = ints[m : 2 * m]
    rows = np.flatnonzero(types <= int(kinds.mjCNSTR_LIMIT_JOINT))
    if not len(rows):
        return None
    types = types[rows]
    ids = ids[rows]
    index = np.arange(len(rows))
    begins = np.append(True, (types[1:] != types[:-1]) | (ids[1:] != ids[:-1]))
    place = index - np.maximum.accumulate(
        np.where(begins, index, 0)
    )  # Number of a row in its equality.
    joint = np.full(len(rows), -1)
    axis = np.zeros(len(rows), int)
    is_limit, is_friction = (
        types == int(kinds.mjCNSTR_LIMIT_JOINT),
        types == int(kinds.mjCNSTR_FRICTION_DOF),
    )
    is_equality = types == int(kinds.mjCNSTR_EQUALITY)
    joint[is_limit] = ids[is_limit]
    joint[is_friction] = model.dof_jntid[ids[is_friction]]
    axis[is_friction] = ids[is_friction] - model.jnt_dofadr[joint[is_friction]]
    equality = np.where(
        is_equality, model.eq_type[np.where(is_equality, ids, 0)] if model.neq else -1, -1
    )
    of_joints = equality == int(mj.mjtEq.mjEQ_JOINT)
    joint[of_joints] = model.eq_obj1id[ids[of_joints]]
    kind = np.where(joint >= 0, model.jnt_type[joint], int(joints.mjJNT_SLIDE))
    rotates = (kind == int(joints.mjJNT_BALL)) | (kind == int(joints.mjJNT_HINGE))
    rotates |= (kind == int(joints.mjJNT_FREE)) & (axis >= 3)
    angular = np.zeros(m, bool)
    angular[rows] = rotates | ((equality == int(mj.mjtEq.mjEQ_WELD)) & (place >= 3))
    return angular


def make_block_names(
    mj: Any, model: Any, ints: IntArray, m: int, joined: int = mujoco_rows.MAX_BLOCK_ROWS
) -> list[str]:
    """Return the names of the blocks of m rows.

    `ints` holds efc_type (m,), efc_id (m,), and dim (c,) and geom (c, 2) of the contacts. An equality of more than
    `joined` rows has a block for each row.
    """
    types = ints[:m].tolist()
    ids = ints[m : 2 * m].tolist()
    contacts = (len(ints) - 2 * m) // 3
    dim = ints[2 * m : 2 * m + contacts]
    geom = ints[2 * m + contacts :].reshape(-1, 2)
    words = {
        1: ("friction", "joint"),
        2: ("friction", "tendon"),
        3: ("limit", "joint"),
        4: ("limit", "tendon"),
    }

    def get_name(kind: str, i: int) -> str:
        own_name = mj.mj_id2name(model, getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}"), i)
        return f"{kind} {own_name or i}"

    names: list[str] = []
    i = 0
    while i < m:
        row_type, which = types[i], ids[i]  # row_type is a value of mjtConstraint.
        size = 1  # A constraint has a block for each row if its part has a name.
        part = ""
        if row_type == 0:
            while i + size < m and types[i + size] == row_type and ids[i + size] == which:
                size += 1
            name = get_name("equality", which)
            if (
                size > joined
            ):  # The rows of a flex belong to edges of its mesh, the rows of a weld to axes.
                part = "edge" if size > mujoco_rows.MAX_BLOCK_ROWS else "axis"
        elif row_type in words:
            word, kind = words[row_type]
            which = joint = int(model.dof_jntid[which]) if row_type == 1 else which
            name = f"{word} of {get_name(kind, which)}"
            if row_type == 1 and int(model.jnt_type[joint]) < int(mj.mjtJoint.mjJNT_SLIDE):
                name += f", axis {ids[i] - int(model.jnt_dofadr[joint])}"
        else:
            sides = [get_name("geom", g)[5:] if g >= 0 else "flex" for g in geom[which].tolist()]
            name = f"contact {which} ({', '.join(sides)})"
            part = "edge" if row_type == 6 else ""
            size = 1 if row_type == 5 else 2 * (int(dim[which]) - 1) if part else int(dim[which])
        names += [f"{name}, {part} {k}" for k in range(size)] if part else [name]
        i += size
    return names
