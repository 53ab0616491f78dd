"""Equivalent problems: other units, turned frames and exchanged bodies change no answer and no number of iterations."""

from dataclasses import replace

import numpy as np
import pytest
from random_problems import CONTACTS, FORMS, add_compliance

import lavender as lv
from lavender.judge.states import compute_states
from lavender.problem.cones import CONTACT_BOX, CONTACT_ELLIPSE


def turn_frames(problem):
    """Turn both tangents of a contact by 90 degrees about its normal: t1' = t2, t2' = -t1."""
    rows, cones = problem.rows, problem.cones
    has_both = (cones.n_tangents == 2)[rows.n_joints :, None]
    turned = replace(
        rows, tangent=np.where(has_both, np.cross(rows.normal, rows.tangent), rows.tangent)
    )
    pairs = [cones.ptr[:-1][cones.n_tangents == 2] + 1, cones.rolling_rows[cones.rolling_rows >= 0]]
    convert = np.eye(problem.m)
    for first in np.concatenate(pairs):
        convert[first : first + 2, first : first + 2] = [[0.0, 1.0], [-1.0, 0.0]]
    separate = np.isin(cones.kind, (CONTACT_BOX, CONTACT_ELLIPSE))
    ratio = np.where(separate, cones.patch_radius, 1.0)
    cones = replace(
        cones, mu=cones.mu * ratio, patch_radius=np.where(separate, 1.0 / ratio, cones.patch_radius)
    )
    return replace(
        problem,
        rows=turned,
        b=convert @ problem.b,
        cones=cones,
        compliance=abs(convert) @ problem.compliance,
    ), convert


def exchange_bodies(problem):
    """Exchange the two bodies of every block: the normal and the first tangent turn round, the second does not."""
    rows, cones = problem.rows, problem.cones
    exchanged = replace(
        rows,
        jac=np.roll(rows.jac, 6, axis=1),
        joint_body=rows.joint_body[:, ::-1],
        contact_body=rows.contact_body[:, ::-1],
        arm_a=rows.arm_b,
        arm_b=rows.arm_a,
        normal=-rows.normal,
        tangent=-rows.tangent,
    )
    sign = np.ones(problem.m)
    sign[cones.ptr[:-1][cones.n_tangents == 2] + 2] = -1.0
    sign[cones.rolling_rows[cones.rolling_rows >= 0] + 1] = -1.0
    return replace(problem, rows=exchanged, b=sign * problem.b), np.diag(sign)


def mirror_rows(problem):
    """Turn the sign of every joint row, so that lower limits become upper limits."""
    rows, cones = problem.rows, problem.cones
    sign = np.where(cones.contact_rows, 1.0, -1.0)
    lower, upper = (
        np.where(sign > 0.0, x, -y)
        for x, y in ((cones.lower, cones.upper), (cones.upper, cones.lower))
    )
    changed = replace(
        problem,
        rows=replace(rows, jac=-rows.jac),
        b=sign * problem.b,
        cones=replace(cones, lower=lower, upper=upper),
    )
    return changed, np.diag(sign)


def scale_units(problem, mass, speed):
    """Multiply all masses and all speeds by powers of two; impulses are then multiplied by both."""
    rows = problem.rows
    cones = problem.cones
    impulse = mass * speed
    scaled = replace(
        rows,
        inv_mass=rows.inv_mass / mass,
        inv_inertia=rows.inv_inertia / mass,
        v_free=speed * rows.v_free,
    )
    cones = replace(cones, lower=impulse * cones.lower, upper=impulse * cones.upper)
    scaled = replace(
        problem, rows=scaled, b=speed * problem.b, cones=cones, compliance=problem.compliance / mass
    )
    return scaled, impulse * np.eye(problem.m)


#: Name of each change -> function that returns the changed problem of bodies and the conversion of its impulses, and
#: whether the change multiplies every number by a power of two, so that all roundings are the same.
CHANGES = {
    "turned frames": (turn_frames, False),
    "exchanged bodies": (exchange_bodies, False),
    "mirrored rows": (mirror_rows, False),
    "heavier bodies": (lambda problem: scale_units(problem, 64.0, 1.0), True),
    "slower motion": (lambda problem: scale_units(problem, 1.0, 2.0**-7), True),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", CONTACTS)
@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_equivalent_problem_takes_the_same_iterations_to_the_equivalent_answer(law, kind, change):
    """The tangents of a box are bounded one after the other, so that turned boxes take other iterations."""
    make_change, is_exact = CHANGES[change]
    for seed, sizes in (
        (3, {}),
        (8, {"bodies": 12, "joints": 6, "contacts": 24}),
    ):  # Sweeps pack 24 blocks and more.
        bodies = add_compliance(CONTACTS[kind](seed, law, **sizes), 0.02)
        cones = bodies.cones  # Every second row with two limits keeps the lower one only.
        upper = np.where(
            np.isfinite(cones.upper) & (np.arange(bodies.m) % 2 == 0), np.inf, cones.upper
        )
        bodies = replace(bodies, cones=replace(cones, upper=upper))
        changed, convert = make_change(bodies)
        for form, make in FORMS.items():
            one_problem, other_problem = make(bodies), make(changed)
            for name in lv.available(one_problem, external=False):
                one, other = (
                    lv.solve(p, name, tol=1e-9, max_iter=5000) for p in (one_problem, other_problem)
                )
                case = f"{seed}, {form}, {name}: {one} | {other}"
                assert one.status is other.status, case
                if is_exact:
                    np.testing.assert_array_equal(
                        other.impulse, convert @ one.impulse, err_msg=case
                    )
                    assert one.work == other.work, case
                    continue
                if kind == "boxes" and law == "coulomb":
                    continue
                np.testing.assert_allclose(
                    other.impulse,
                    convert @ one.impulse,
                    rtol=0.0,
                    atol=1e-6 * np.abs(one.impulse).max(),
                    err_msg=case,
                )
                if kind != "boxes":
                    assert abs(one.iterations - other.iterations) <= 2 + 0.02 * one.iterations, case


#: Unit of each number of a residual, a motion error and a gradient by the final velocities: powers of mass and speed.
UNITS = {
    "relative": (0, 0),
    "roundoff_floor": (0, 0),
    "excess": (0, 0),
    "above_floor": (0, 0),
    "energy": (0.5, 1),
    "energy_at_zero": (0.5, 1),
    "floor_energy": (0.5, 1),
    "energy_rhs": (0.5, 1),
    "velocity": (0, 1),
    "velocity_at_zero": (0, 1),
    "velocity_by_row": (0, 1),
    "error": (1, 1),
    "slack": (0, 1),
    "kinetic": (0.5, 1),
    "speed": (0, 1),
    "spin": (0, 1),
    "rows": (0, 1),
    "margin": (1, 1),
    "target": (0, 0),
    "v_free": (0, 0),
    "compliance": (1, 1),
    "mu": (0, 1),
    "patch_radius": (0, 1),
    "rolling": (0, 1),
    "lower": (-1, 0),
    "upper": (-1, 0),
}


def list_numbers(problem, impulse, solution):
    """Return (name of the unit, numbers) of everything that is computed of an impulse and of a solution (m,)."""
    numbers = []
    for precision in ("float64", "float32"):
        judged = lv.residual(problem, impulse, precision, threshold=0.0)
        names = [name for name in UNITS if hasattr(judged, name)]
        numbers += [(name, getattr(judged, name)) for name in names]
        numbers += (
            [("relative", x) for x in vars(judged.rounding).values()] if judged.rounding else []
        )
        for name in ("relative", "energy", "velocity", "energy_at_zero", "velocity_at_zero"):
            numbers.append((name, getattr(judged.islands, name)))
    motion = lv.motion_error(problem, impulse, solution)
    numbers += [
        (name, getattr(motion, name))
        for name in ("kinetic", "energy", "relative", "speed", "spin", "rows")
    ]
    for x in (impulse, solution):
        margin = compute_states(problem, x).margin
        numbers.append(("margin", np.where(np.isfinite(margin), margin, 0.0)))
    if problem.matrix is None:
        gradient = lv.derivative(problem, solution).vjp(
            velocity=np.ones(problem.velocity(solution).shape)
        )
        numbers += [
            (name, getattr(gradient, name))
            for name in ("target", "v_free", "compliance", "mu", "lower", "upper")
        ]
    return [(name, np.asarray(x, float)) for name, x in numbers if x is not None]


@pytest.mark.parametrize(
    ("mass", "speed"),
    [(64.0, 1.0), (1.0, 2.0**-7), (2.0**-4, 8.0), (2.0**180, 2.0**-150), (2.0**-180, 2.0**150)],
)
@pytest.mark.parametrize("kind", CONTACTS)
def test_numbers_of_the_judge_and_of_derivatives_have_their_documented_units(kind, mass, speed):
    """The last two units are near the ends of the range of numbers, 1e-60 to 1e60."""
    bodies = add_compliance(CONTACTS[kind](5, "coulomb"), 0.02)
    changed, _ = scale_units(bodies, mass, speed)
    for form, make in FORMS.items():
        one, other = make(bodies), make(changed)
        solution = lv.solve(one, "newton" if kind != "boxes" else "direct", tol=1e-12).impulse
        impulse = 0.9 * solution + 0.01
        pairs = zip(
            list_numbers(one, impulse, solution),
            list_numbers(other, mass * speed * impulse, mass * speed * solution),
            strict=True,
        )
        for (name, x), (_, y) in pairs:
            of_mass, of_speed = UNITS[name]
            np.testing.assert_array_equal(
                y, x * mass**of_mass * speed**of_speed, err_msg=f"{form}, {name}"
            )


@pytest.mark.parametrize("change", ["turned frames", "exchanged bodies"])
@pytest.mark.parametrize("kind", CONTACTS)
def test_numbers_of_the_judge_and_of_derivatives_do_not_depend_on_frames_and_on_the_order_of_bodies(
    kind, change
):
    bodies = add_compliance(CONTACTS[kind](5, "coulomb"), 0.02)
    changed, convert = CHANGES[change][0](bodies)
    of_rows = dict.fromkeys(("error", "slack", "target"), convert)
    of_rows |= dict.fromkeys(("velocity_by_row", "compliance"), np.abs(convert))
    for form, make in FORMS.items():
        one, other = make(bodies), make(changed)
        solution = lv.solve(one, "newton" if kind != "boxes" else "direct", tol=1e-13).impulse
        impulse = 0.9 * solution + 0.01
        pairs = zip(
            list_numbers(one, impulse, solution),
            list_numbers(other, convert @ impulse, convert @ solution),
            strict=True,
        )
        for (name, x), (_, y) in pairs:
            if name == "mu" and kind in ("boxes", "ellipses"):
                continue  # The first coefficient becomes the second.
            rows = of_rows.get(name)
            expected = x if rows is None else rows @ x
            np.testing.assert_allclose(
                y,
                expected,
                rtol=1e-6,
                atol=1e-9 * np.abs(x).max(initial=1e-3),
                err_msg=f"{form}, {name}",
            )
