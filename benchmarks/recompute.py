"""Recompute the numbers that audit, tune and slip print, by MuJoCo and NumPy alone.

    python -m benchmarks recompute model.xml --worlds 2 --steps 40 --states keyframes

The worlds are simulated again by plain MuJoCo. With J, M, R and aref of a forward pass, A = J M^-1 J^T + diag(R),
lambda = dt f, w = dt (J a + R f - aref) and d the diagonal of A, the error of a step is the largest sqrt(nu d) |e| of a
block with e = lambda - projection(lambda - w / d) (docs/residual.md). If qacc moves the bodies, it is the largest
dt |J (qacc - exact qacc)|, with MuJoCo's Newton at tolerance 0 (rows of welds with torquescale 1). Slips are computed
with MuJoCo's Jacobians of the bodies at the contact's point. Compared are

    audit    error, rows and contacts of every step, quantiles, counts of the headline and the worst steps
    tune     error of every step of every setting, its 99 % quantile and maximum, and the motion
    slip     speed of each pair of geoms, and the table of settings

Times cannot be recomputed. The largest relative difference of each kind is printed; the exit code is 1 above 1e-6.
"""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import click
import mujoco
import numpy as np

from lavender.audit.audit import MAX_PROBLEMS_IN_MEMORY, audit
from lavender.audit.slip_states import explain_slip_of_states
from lavender.audit.tune import tune
from lavender.audit.tune.mujoco_settings import CONVERGED_OPTIONS, MIN_JUDGED_PARTS
from lavender.io.start_states import load_model, read_states

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
KIND = mujoco.mjtConstraint
TOLERANCE = 1e-6  # Largest accepted relative difference.
ROUNDING = 1e-11  # [m/s] Differences of errors below this are rounding.
REMEDY_STEPS = 25
RESTARTS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def get_state(model: Any, data: Any) -> Any:
    """Return the state vector."""
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    return state


def is_moved_by_acceleration(model: Any) -> bool:
    """Return whether the integrator uses qacc: Euler without damping, discrete, the first pass of RK4."""
    integrator = mujoco.mjtIntegrator
    off = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    if model.opt.integrator == integrator.mjINT_EULER:
        return bool(model.opt.disableflags & off) or not np.array(model.dof_damping).any()
    return model.opt.integrator not in (integrator.mjINT_IMPLICIT, integrator.mjINT_IMPLICITFAST)


def compute_error(model: Any, state: Any) -> tuple[float, int, int]:
    """Return the velocity error [m/s] of MuJoCo's answer in a state, the number of rows and of contacts."""
    model = copy.copy(model)
    model.opt.noslip_iterations = 0
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, STATE)
    mujoco.mj_forward(model, data)
    m = int(data.nefc)
    nv = model.nv
    dt = model.opt.timestep
    contacts = int(np.count_nonzero(data.contact.efc_address >= 0)) if data.ncon else 0
    if m == 0:
        return 0.0, 0, contacts
    jac = np.zeros((m, nv))
    if mujoco.mj_isSparse(model):
        for i in range(m):
            part = slice(data.efc_J_rowadr[i], data.efc_J_rowadr[i] + data.efc_J_rownnz[i])
            jac[i, data.efc_J_colind[part]] = data.efc_J.ravel()[part]
    else:
        jac[:] = data.efc_J.reshape(m, nv)
    solved = np.array(jac)
    mujoco.mj_solveM(model, data, solved, jac)
    if is_moved_by_acceleration(model):
        exact = mujoco.MjData(model)
        mujoco.mj_setState(model, exact, state, STATE)
        mujoco.mj_forward(
            apply_options(model, (CONVERGED_OPTIONS | {"ls_iterations": 300}).items()), exact
        )
        return float(dt * np.abs(jac @ (data.qacc - exact.qacc)).max()), m, contacts
    row_type, force = np.array(data.efc_type), np.array(data.efc_force)
    acceleration = data.qacc_smooth + solved.T @ force
    slack = dt * (jac @ acceleration + data.efc_R * force - data.efc_aref)
    diagonal = np.einsum("ij,ij->i", jac, solved) + data.efc_R
    impulse = dt * force
    loss = dt * np.array(data.efc_frictionloss)
    errors = np.zeros(m)
    is_equality = row_type == KIND.mjCNSTR_EQUALITY
    is_loss = (row_type == KIND.mjCNSTR_FRICTION_DOF) | (row_type == KIND.mjCNSTR_FRICTION_TENDON)
    low = np.where(is_equality, -np.inf, np.where(is_loss, -loss, 0.0))
    high = np.where(is_loss, loss, np.inf)
    errors = diagonal * np.abs(impulse - np.clip(impulse - slack / diagonal, low, high))
    for c in range(data.ncon):
        contact = data.contact[c]
        first, dim = int(contact.efc_address), int(contact.dim)
        if first >= 0 and row_type[first] == KIND.mjCNSTR_CONTACT_ELLIPTIC and dim > 1:
            rows = slice(first, first + dim)
            scale = np.concatenate([[1.0], contact.friction[: dim - 1] / contact.friction[0]])
            errors[rows] = compute_cone_errors(
                impulse[rows] / scale,
                slack[rows] * scale,
                diagonal[rows] * scale**2,
                contact.friction[0],
            )
    return float(errors.max()), m, contacts


def compute_cone_errors(impulse: Any, slack: Any, diagonal: Any, mu: float) -> Any:
    """Return sqrt(nu d) |e| of the rows of a contact with the cone |lambda_t| <= mu lambda_n, of a pair their norm."""
    d = np.array(diagonal)
    pairs = [slice(1, 3), *([slice(4, 6)] if len(d) == 6 else [])]
    for pair in pairs:
        d[pair] = d[pair].mean()
    e = impulse - project_on_cone(impulse - slack / d, d, mu)
    nu = np.concatenate([d[:3], np.full(len(d) - 3, d[0])])
    errors = np.sqrt(nu * d) * np.abs(e)
    for pair in pairs:
        errors[pair] = np.linalg.norm(errors[pair])
    return errors


def project_on_cone(y: Any, d: Any, mu: float) -> Any:
    """Return the point x of the cone with the smallest sum of d (x - y)^2, by bisection on the multiplier."""
    if np.linalg.norm(y[1:]) <= mu * y[0]:
        return y
    # In the polar cone of the metric, the nearest point is the tip.
    if np.linalg.norm(d[1:] * y[1:]) * mu <= -d[0] * y[0]:
        return np.zeros(len(y))
    pole = d[0] / mu**2  # Normal impulses are positive on one side of this multiplier only.
    low, high = (0.0, pole) if y[0] > 0.0 else (pole, 1e30 * pole)

    def point(k: float) -> Any:
        """Return the stationary point of a multiplier."""
        normal = d[0] * y[0] / (d[0] - k * mu**2) if k != pole else np.inf
        return np.concatenate([[normal], d[1:] * y[1:] / (d[1:] + k)])

    for _ in range(400):
        middle = 0.5 * (low + high) if low == 0.0 or high < 4.0 * low else np.sqrt(low * high)
        x = point(middle)
        inside = np.linalg.norm(x[1:]) <= mu * x[0]
        if inside == (y[0] > 0.0):
            high = middle
        else:
            low = middle
    return point(0.5 * (low + high))


def simulate(model: Any, world: int, steps: int, starts: Any) -> Any:
    """Return the states before the steps of a world with random controls and velocities, as the pages describe it."""
    data = mujoco.MjData(model)
    seed = 0
    exact = 1 if starts is None else len(starts)
    if starts is not None:
        mujoco.mj_setState(model, data, starts.vectors[world % exact], STATE)
    if world >= exact:
        data.qvel[:] += 0.1 * np.random.default_rng([seed, world]).standard_normal(model.nv)
    limited = np.array(model.actuator_ctrllimited, bool)[:, None]
    low, high = np.where(limited, np.array(model.actuator_ctrlrange), [-1.0, 1.0]).T
    rng = np.random.default_rng(seed + world)
    states = []
    for step in range(steps):
        ctrl = rng.uniform(low, high)
        if step or starts is None or starts.controls is None:
            data.ctrl[:] = ctrl
        else:
            data.ctrl[:] = starts.controls[world % exact]
        states.append(get_state(model, data))
        mujoco.mj_step(model, data)
    return np.array(states)


def compare(found: Any, expected: Any, floor: float = ROUNDING) -> float:
    """Return the largest relative difference; differences below `floor` are rounding."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    gap = np.maximum(np.abs(found - expected) - floor, 0.0) / np.maximum(np.abs(expected), 1e-300)
    return float(np.max(gap, initial=0.0))


def recompute_audit(
    source: Any, model: Any, worlds: int, steps: int, states: Any
) -> dict[str, float]:
    """Compare an audit with plain MuJoCo."""
    found = audit(source, worlds=worlds, steps=steps, spread=0.1, states=states, workers=1)
    starts = None if states is None else read_states(mujoco, model, states).select_evenly(worlds)
    every = [simulate(model, world, steps, starts) for world in range(worlds)]
    facts = np.array([[compute_error(model, state) for state in own] for own in every])
    errors = facts[:, :, 0]
    table = found.errors
    quantiles = np.quantile(errors, (0.5, 0.9, 0.99, 0.999, 1.0), method="higher")
    # Errors above the threshold are above the floor of float64 in these models.
    unconverged = int(np.count_nonzero(errors > found.threshold))
    worst = [errors[w.world, w.step] for w in found.worst]
    print(*found.headline, sep="\n")
    return {
        "audit: error of each step": compare(found.numbers[0], errors),
        "audit: rows": compare(found.rows, facts[:, :, 1]),
        "audit: contacts": compare(found.contacts, facts[:, :, 2]),
        "audit: quantiles": compare(table["velocity [m/s]"], quantiles),
        "audit: steps in the headline": compare(found.is_unconverged.sum(), unconverged),
        "audit: worst steps": compare([w.velocity for w in found.worst], worst),
    }


def apply_options(model: Any, options: Any) -> Any:
    """Return a copy of the model with options (name, value), whose values may be texts."""
    changed = copy.copy(model)
    kinds = {
        "solver": (mujoco.mjtSolver, "mjSOL_"),
        "jacobian": (mujoco.mjtJacobian, "mjJAC_"),
        "cone": (mujoco.mjtCone, "mjCONE_"),
    }
    for name, value in options:
        if name in kinds:
            kind, prefix = kinds[name]
            setattr(changed.opt, name, getattr(kind, prefix + value.upper()))
        else:
            setattr(changed.opt, name, type(getattr(model.opt, name))(float(value)))
    return changed


def apply_text(model: Any, text: str) -> Any:
    """Return a copy of the model with a setting of the table of `lavender slip`."""
    values = re.findall(r'(\w+)="([^"]*)"', text)
    if text.startswith("<option"):
        return apply_options(model, values)
    changed = copy.copy(model)
    if text.startswith("solref"):
        shortest = float(values[0][1].split()[0])
        for solref in (changed.geom_solref, changed.pair_solref):
            solref[solref[:, 0] > shortest] = shortest, 1.0
    elif text.startswith("friction"):
        names = text.partition(" of ")[2].split(" and ")
        geoms = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in names]
        changed.geom_friction[geoms, 0] = float(values[0][1])
        own = np.isin(model.pair_geom1, geoms) & np.isin(model.pair_geom2, geoms)
        changed.pair_friction[own, :2] *= 2.0
    return changed


def recompute_tune(
    source: Any, model: Any, worlds: int, steps: int, states: Any
) -> dict[str, float]:
    """Compare a tuning with plain MuJoCo, except its times."""
    found = tune(source, worlds=worlds, steps=steps, spread=0.1, states=states, repeats=1)
    starts = None if states is None else read_states(mujoco, model, states).select_evenly(worlds)
    halves = [
        np.concatenate(
            [
                simulate(model, w, steps, starts).reshape(
                    -1, 10, len(simulate(model, w, 1, starts)[0])
                )
                for w in range(half, worlds, 2)
            ]
        )
        for half in (0, 1)
    ]
    gaps = {"tune: error of each step": 0.0, "tune: 99 % and maximum": 0.0, "tune: motion": 0.0}

    def run(options: Any, stretches: Any, with_errors: bool = True) -> tuple[Any, Any]:
        """Return errors of all steps and the positions at the ends of stretches with some options."""
        changed = apply_options(model, options)
        errors = []
        ends = []
        for stretch in stretches:
            data, vectors = mujoco.MjData(changed), mujoco.MjData(model)
            mujoco.mj_setState(changed, data, stretch[0], STATE)
            for state in stretch:
                mujoco.mj_setState(model, vectors, state, STATE)
                data.ctrl[:] = vectors.ctrl
                if with_errors:
                    errors.append(compute_error(changed, get_state(changed, data))[0])
                mujoco.mj_step(changed, data)
            mujoco.mj_kinematics(changed, data)
            ends.append(np.array(data.xpos))
        return np.array(errors), np.array(ends)

    for stretches, results in zip(halves, (found.measured, found.held), strict=True):
        converged = run(CONVERGED_OPTIONS.items(), stretches, with_errors=False)[1]
        for m in results:
            errors, ends = run(m.setting.options, stretches)
            # Every fourth stretch comes first, and a setting that is not accurate enough is judged on a part.
            n_parts = max(MIN_JUDGED_PARTS, -(-len(errors) // MAX_PROBLEMS_IN_MEMORY))
            part = np.repeat(np.arange(len(stretches)) % n_parts, stretches.shape[1])
            errors = next(e for k in range(n_parts) if len(e := errors[part <= k]) == len(m.error))
            motion = np.linalg.norm(ends - converged, axis=2).max(axis=1)
            own = [float(np.quantile(errors, 0.99, method="higher")), float(errors.max())]
            new = {
                "tune: error of each step": compare(m.error, errors),
                "tune: 99 % and maximum": compare([m.worst_error, m.error.max()], own),
                "tune: motion": compare(m.motion, motion),
            }
            gaps = {name: max(gap, new[name]) for name, gap in gaps.items()}
    print(*found.headline, found.choices.to_string(index=False), sep="\n")
    return gaps


def compute_slips(model: Any, before: Any, velocity: Any) -> dict[str, list[float]]:
    """Return the sliding speeds [m/s] of the points of each pair of geoms, at a state and with a velocity."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, before, STATE)
    mujoco.mj_forward(model, data)
    slips: dict[str, list[float]] = {}
    for c in range(data.ncon):
        contact = data.contact[c]
        if contact.efc_address < 0 or contact.dim == 1:
            continue
        jacobians = np.zeros((2, 3, model.nv))
        for jac, geom in zip(jacobians, contact.geom, strict=True):
            mujoco.mj_jac(model, data, jac, None, contact.pos, int(model.geom_bodyid[geom]))
        tangents = contact.frame.reshape(3, 3)[1:]
        name = ", ".join(
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, int(g)) or str(int(g))
            for g in contact.geom
        )
        slips.setdefault(name, []).append(
            float(np.linalg.norm(tangents @ (jacobians[1] - jacobians[0]) @ velocity))
        )
    return slips


def recompute_slip(model: Any, vectors: Any) -> dict[str, float]:
    """Compare the slip of states with plain MuJoCo."""
    result = explain_slip_of_states(model, vectors)
    if not result.explanations:
        return {}
    print(result.table.to_string(index=False))
    points: dict[str, list[float]] = {}
    used = [e.state for e in result.explanations]
    for i in used:
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, vectors[i], STATE)
        mujoco.mj_forward(model, data)
        solved = np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, solved, np.array(data.qfrc_constraint)[None])
        velocity = data.qvel + model.opt.timestep * (data.qacc_smooth + solved[0])
        for name, speeds in compute_slips(model, vectors[i], velocity).items():
            points.setdefault(name, []).extend(speeds)
    if not points:
        return {}
    table = result.table.set_index("contact")
    gaps = {
        "slip: mean speed": max(
            compare(table.loc[n, "slip [m/s]"], np.mean(x)) for n, x in points.items()
        ),
        "slip: points": max(compare(table.loc[n, "points"], len(x)) for n, x in points.items()),
    }
    worst = result.worst
    if worst.remedies:
        print(worst.remedies_table.to_string(index=False), *worst.advice, sep="\n")
        name = max((s.speed, s.contact) for s in worst.slips)[1].partition(" (")[2].rstrip(")")
        ranked = []
        for i in used:
            slips = {s.contact: s.speed for s in result.explanations[used.index(i)].slips}
            own = [
                x for contact, x in slips.items() if contact.partition(" (")[2].rstrip(")") == name
            ]
            if own:
                ranked.append((float(np.mean(own)), used.index(i), i))
        chosen = [i for *_, i in sorted(ranked, reverse=True)[:8]]
        runs = [simulate_slip(model, vectors[i], name) for i in chosen]
        chosen = [i for i, run in zip(chosen, runs, strict=True) if run[2] < 0] or chosen
        gap = 0.0
        for found in worst.remedies:
            changed = apply_text(model, found.setting)
            runs = [simulate_slip(changed, vectors[i], name) for i in chosen]
            steps = [run[2] for run in runs if run[2] >= 0]
            if found.diverged_step != min(steps, default=-1):
                gap = np.inf
            slip, later = np.mean([run[:2] for run in runs], axis=0)
            if np.isfinite(slip) or np.isfinite(found.slip):
                gap = max(gap, compare(found.slip, slip))
            if np.isfinite(later) or np.isfinite(found.later):
                gap = max(gap, compare(found.later, later))
        gaps["slip: table of settings"] = gap
    return gaps


def simulate_slip(model: Any, state: Any, name: str) -> tuple[float, float, int]:
    """Return the slip of two geoms in a step, its mean in the next 25, and the step of a restart by MuJoCo or -1."""
    data = mujoco.MjData(model)
    means = []
    mujoco.mj_setState(model, data, state, STATE)
    for step in range(REMEDY_STEPS + 1):
        before = get_state(model, data)
        mujoco.mj_step(model, data)
        if any(data.warning[int(kind)].number for kind in RESTARTS):
            return means[0] if means else np.nan, np.nan, step
        speeds = compute_slips(model, before, np.array(data.qvel)).get(name)
        means.append(float(np.mean(speeds)) if speeds else np.nan)
    return means[0], np.nan if np.isnan(means[-1]) else float(np.nanmean(means[1:])), -1


@click.command(help=__doc__)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--worlds", default=2, help="Number of worlds.")
@click.option("--steps", default=40, help="Steps of each world, a multiple of 10.")
@click.option("--states", default=None, help="Start states, as for `lavender audit`.")
@click.option("--no-tune", is_flag=True, help="Leave `tune` out.")
def command(path: Path, worlds: int, steps: int, states: str | None, no_tune: bool) -> None:
    """Recompute the numbers of a model."""
    _, model = load_model(path)
    gaps = recompute_audit(path, model, worlds, steps, states)
    starts = None if states is None else read_states(mujoco, model, states).select_evenly(worlds)
    vectors = simulate(model, 0, steps, starts)[:: max(1, steps // 8)]
    gaps |= recompute_slip(model, vectors)
    if not no_tune:
        gaps |= recompute_tune(path, model, worlds, steps, states)
    print()
    for name, gap in gaps.items():
        print(f"{name}: largest relative difference {gap:.1e}")
    raise SystemExit(max(gaps.values()) > TOLERANCE)
