"""`RowBuilder`: closed-form solutions, two dimensions as a plane of three, keys, and agreement of all solvers."""

import numpy as np
import pytest
from hypothesis import given
from random_problems import seeds

import lavender as lv

DT = 1 / 60
G = 9.81
TOL = 1e-12
BODY = (1.5, -1.0)  # m, centre of the body of most tests
EXACT = {"rtol": 0.0, "atol": 1e-10}


def planar(velocity=(0.0, 0.0, 0.0), inv_mass=0.5, inv_inertia=3.0, position=BODY, **more):
    """Build for one planar body."""
    return lv.RowBuilder([inv_mass], [inv_inertia], [velocity], DT, [position], **more)


def spatial(velocities, positions, inv_mass=0.5, **more):
    """Build for bodies with the same inverse mass and a full inertia tensor."""
    n = len(positions)
    tensor = np.array([[3.0, 0.5, 0.2], [0.5, 2.0, -0.3], [0.2, -0.3, 4.0]])
    return lv.RowBuilder(np.full(n, inv_mass), [tensor] * n, velocities, DT, positions, **more)


def solved(builder, solver="auto", tol=TOL, **more):
    """Return the problem's solution and the velocities after the step."""
    problem = builder.problem(**more)
    solution = lv.solve(problem, solver, tol=tol, max_iter=100_000)
    assert solution.success, str(solution)
    return solution, builder.velocity_after(problem, solution.impulse)


PENDULUM = (
    -G * DT * 1.2 / (1 / 6.0 + 1.2**2)
)  # rad/s after a step of 2 kg with 1/3 kg m^2 at 1.2 m from the anchor
ERROR = np.array([0.01, -0.02])  # m, of a joint's anchors
TURNED = -0.5 * 0.1 / DT  # rad/s that remove half of 0.1 rad
#: Of one planar body: blocks with the world by method, the velocity before the step, and that after it.
CLOSED_FORMS = [
    ({"motor": {"speed": 2.0, "max_torque": 1000.0}}, (0, 0, 0), (0, 0, 2.0)),
    (
        {"motor": {"speed": 2.0, "max_torque": 1.0}},
        (0, 0, 0),
        (0, 0, 1.0 * DT * 3.0),
    ),  # its torque is too small
    (
        {"motor": {"axis": (2.0, 0.0), "speed": 1.0, "max_force": 10.0, "anchor": BODY}},
        (0, 0, 0),
        (5.0 * DT, 0, 0),
    ),
    (
        {
            "slider": {"anchor": BODY, "axis": (1.0, 0.0)},
            "limit": {"axis": (1.0, 0.0), "value": 0.97, "upper": 1.0, "anchor": BODY},
        },
        (5.0, 2.0, 1.0),
        (0.03 / DT, 0, 0),
    ),
    *(
        ({"limit": {"value": value, "lower": 0.0, "upper": 1.0}}, (0, 0, omega), (0, 0, after))
        for value, omega, after in (
            (0.5, -3.0, -3.0),  # far from the limit at 0
            (0.02, -3.0, -0.02 / DT),  # stops at the limit at the end of the step
            (-0.1, -3.0, 0.2 * 0.1 / DT),  # beyond the lower limit: corrected
            (0.98, 3.0, 0.02 / DT),
            (1.1, 0.0, -0.2 * 0.1 / DT),
        )
    ),  # beyond the upper limit
    *(
        (
            {"contact": {"point": BODY, "normal": (0.0, 1.0), "gap": gap, "restitution": e}},
            (0, speed, 0),
            (0, after, 0),
        )
        for gap, speed, e, after in (
            (0.0, -2.0, 0.5, 1.0),
            (0.0, -0.9, 0.5, 0.0),  # below the threshold of 1 m/s
            (0.02, -0.6, 0.0, -0.6),  # does not arrive in this step
            (0.02, -2.0, 0.0, -0.02 / DT),  # touches at the end of the step
            (0.02, -2.0, 0.5, 1.0),
            (0.2, -2.0, 0.5, -2.0),
            (-0.03, 0.0, 0.0, 0.2 * 0.02 / DT),  # penetration beyond the slop
            (-0.005, -0.1, 0.0, 0.0),
        )
    ),  # within the slop
]
#: The same of another body or builder.
CLOSED_FORMS_OF_OTHERS = [
    (
        {"hinge": {"anchor": (0.0, 0.0)}},
        (0, -G * DT, 0),
        (0, 1.2 * PENDULUM, PENDULUM),
        {"inv_mass": 0.5, "inv_inertia": 3.0, "position": (1.2, 0.0)},
    ),
    # m (v+ - v) = h (-k (x + h v+ - rest) - c v+), with m = 2 kg, k = 40 N/m, rest = 1 m, x = 1.3 m, v = -0.4 m/s
    *(
        (
            {
                "spring": {
                    "anchor_a": (0.0, 0.0),
                    "anchor_b": (1.3, 0.0),
                    "length": 1.0,
                    "stiffness": 40.0,
                    "damping": c,
                }
            },
            (-0.4, 0, 0),
            ((2.0 * -0.4 - DT * 40.0 * 0.3) / (2.0 + DT * c + DT**2 * 40.0), 0, 0),
            {"inv_inertia": 0.0, "position": (1.3, 0.0)},
        )
        for c in (0.0, 3.0)
    ),
    (
        {"weld": {"anchor": BODY, "anchor_b": BODY + ERROR, "angle_error": 0.1}},
        (0, 0, 0),
        (
            -0.5 * ERROR[0] / DT + TURNED * ERROR[1],
            -0.5 * ERROR[1] / DT - TURNED * ERROR[0],
            TURNED,
        ),
        {"baumgarte": 0.5},
    ),
]


@pytest.mark.parametrize(
    ("blocks", "before", "after", "more"),
    [*((*form, {}) for form in CLOSED_FORMS), *CLOSED_FORMS_OF_OTHERS],
)
def test_blocks_of_one_planar_body_give_the_velocity_in_closed_form(blocks, before, after, more):
    builder = planar(before, slop=0.01, **more)
    for method, arguments in blocks.items():
        getattr(builder, method)(-1, 0, **arguments)
    _, (velocity,) = solved(builder)
    np.testing.assert_allclose(velocity, after, rtol=0.0, atol=1e-12)


def test_gear_turns_in_its_ratio_and_conserves_exchanged_impulses():
    ratio = 3.0
    inertia = np.array([2.0, 5.0])
    builder = lv.RowBuilder(
        [1.0, 1.0], 1 / inertia, [(0, 0, 4.0), (0, 0, 0)], DT, np.array([(0, 0), (4, 0)])
    )
    builder.hinge(-1, 0, (0.0, 0.0))
    builder.hinge(-1, 1, (4.0, 0.0))
    gear = builder.gear(0, 1, ratio=ratio)
    solution, after = solved(builder)
    omega = after[:, 2]
    assert omega[0] + ratio * omega[1] == pytest.approx(0.0, abs=1e-10)
    impulse = solution.impulse[builder.rows_of(gear)][0]
    np.testing.assert_allclose(
        inertia * (omega - [4.0, 0.0]), impulse * np.array([1.0, ratio]), **EXACT
    )


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("degrees", [15.0, 35.0])
def test_a_block_on_an_inclined_plane_slides_only_above_its_friction_angle(dimensions, degrees):
    mu = 0.5
    angle = np.deg2rad(degrees)  # the friction angle is 26.6 degrees
    down = np.array([np.cos(angle), -np.sin(angle)])
    normal = np.array([np.sin(angle), np.cos(angle)])
    velocity = np.array([0.0, -G * DT])
    corner = 0.2
    flat = dimensions == 2
    lift = (lambda x: x) if flat else (lambda x: np.array([*x, 0.0]))
    position = [lift(0.1 * normal)]
    inertia = [6.0] if flat else [6.0 * np.eye(3)]
    v = [[*lift(velocity), *np.zeros(1 if flat else 3)]]
    builder = lv.RowBuilder([1.0], inertia, v, DT, position)
    for x in (-corner, corner):
        for z in (None,) if flat else (-corner, corner):
            at = lift(x * down) if flat else lift(x * down) + np.array([0.0, 0.0, z])
            builder.contact(-1, 0, at, lift(normal), mu=mu)
    _, (after,) = solved(builder, tol=1e-10)
    slides = DT * G * max(0.0, np.sin(angle) - mu * np.cos(angle))
    np.testing.assert_allclose(after[:2], slides * down, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(after[2:], 0.0, rtol=0.0, atol=1e-7)


def test_a_weld_leaves_no_relative_velocity():
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(2, 3))
    builder = spatial(rng.normal(size=(2, 6)), positions)
    builder.weld(0, 1, (0.3, 0.2, 0.1))
    _, after = solved(builder)
    np.testing.assert_allclose(after[0, 3:], after[1, 3:], rtol=0.0, atol=1e-9)
    carried = after[0, :3] + np.cross(after[0, 3:], positions[1] - positions[0])
    np.testing.assert_allclose(carried, after[1, :3], rtol=0.0, atol=1e-9)


def test_a_hinge_in_space_rotates_about_its_axis_alone():
    axis = np.array([1.0, 2.0, -0.5])
    builder = spatial(
        np.random.default_rng(5).normal(size=(2, 6)), np.array([(0.0, 0, 0), (1.0, 0.2, 0)])
    )
    builder.hinge(0, 1, (0.5, 0.1, 0.0), axis)
    builder.motor(0, 1, axis, speed=2.0, max_torque=1e6)
    _, after = solved(builder)
    expected = 2.0 * axis / np.linalg.norm(axis)
    np.testing.assert_allclose(after[1, 3:] - after[0, 3:], expected, rtol=0.0, atol=1e-8)


def test_a_tilted_hinge_is_turned_back():
    tilt = 0.01
    axis = np.array([0.0, 0.0, 1.0])
    builder = spatial(np.zeros((1, 6)), np.zeros((1, 3)), baumgarte=1.0)
    builder.hinge(-1, 0, np.zeros(3), axis, axis_b=(np.sin(tilt), 0.0, np.cos(tilt)))
    _, after = solved(builder)
    assert after[0, 3:5] == pytest.approx((0.0, -np.sin(tilt) / DT), abs=1e-8)


def add_everything(builder, lift, axis):
    """Add a block of each kind; `lift` maps planar vectors, `axis` is the axis of rotation if there is one."""
    turn = {} if axis is None else {"axis": axis}
    gear = {} if axis is None else {"axis_a": axis}
    return [
        builder.hinge(-1, 0, lift(0.0, 0.0), **turn),
        builder.motor(-1, 0, speed=2.0, max_torque=5.0, **turn),
        builder.limit(-1, 0, value=0.1, lower=0.0, **turn),
        builder.distance(0, 1, lift(1.0, 0.2), lift(2.0, 0.5), 1.0),
        builder.spring(-1, 1, lift(3.0, 3.0), lift(2.2, 1.0), 1.0, stiffness=50.0, damping=1.0),
        builder.slider(-1, 2, lift(3.0, 0.0), lift(1.0, 1.0)),
        builder.weld(2, 3, lift(3.5, 0.0)),
        builder.gear(0, 1, ratio=2.0, **gear),
        builder.contact(-1, 1, lift(2.0, -0.5), lift(0.0, 1.0), gap=-0.01, mu=0.4),
        builder.contact(-1, 3, lift(4.0, -0.5), lift(0.0, 1.0), mu=0.0, restitution=0.5),
    ]


PLACES = np.array([(1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (4.0, 0.0)])
VELOCITY = np.random.default_rng(0).normal(size=(4, 3)) - (0.0, 2.0, 0.0)


def test_row_builder_in_two_dimensions_equals_a_plane_in_three():
    flat = lv.RowBuilder([1.0, 0.5, 2.0, 1.0], [3.0, 1.0, 2.0, 0.5], VELOCITY, DT, PLACES)
    flat_keys = add_everything(flat, lambda x, y: (x, y), None)
    spread = np.zeros((4, 6))
    spread[:, [0, 1, 5]] = VELOCITY
    solid = lv.RowBuilder(
        [1.0, 0.5, 2.0, 1.0],
        [x * np.eye(3) for x in (3.0, 1.0, 2.0, 0.5)],
        spread,
        DT,
        np.hstack([PLACES, np.zeros((4, 1))]),
    )
    solid_keys = add_everything(solid, lambda x, y: (x, y, 0.0), (0.0, 0.0, 1.0))
    assert flat_keys == solid_keys
    _, planar_velocity = solved(flat, tol=1e-11)
    _, velocity = solved(solid, tol=1e-11)
    np.testing.assert_allclose(velocity[:, [0, 1, 5]], planar_velocity, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(velocity[:, 2:5], 0.0, rtol=0.0, atol=1e-7)


def test_row_builder_keys_carry_impulses_to_another_order():
    def build(order):
        builder = planar((0.3, -1.0, 0.0))
        keys = {
            i: builder.contact(-1, 0, (1.0 + i, -1.2), (0.0, 1.0), mu=0.5, feature=i) for i in order
        }
        return builder, keys

    first, keys = build([0, 1, 2])
    solution, _ = solved(first)
    second, other_keys = build([2, 0])
    other_keys["ball"] = second.ball(-1, 0, (9.0, 9.0))
    carried = second.problem().carry(solution)
    assert keys[0] == other_keys[0] and keys[2] == other_keys[2]
    for i in (0, 2):
        before = solution.impulse[first.rows_of(keys[i])]
        after = carried[second.rows_of(keys[i])]
        np.testing.assert_array_equal(before, after)
    assert not carried[second.rows_of(other_keys["ball"])].any()


def test_row_builder_blocks_have_names_and_order():
    builder = planar()
    contact = builder.contact(None, 0, BODY, (0.0, 1.0), mu=0.2)
    hinge = builder.hinge(None, 0, BODY)
    problem = builder.problem(name="two")
    assert problem.names == ("hinge 0 of world and body 0", "contact 0 of world and body 0")
    assert (builder.rows_of(hinge), builder.rows_of(contact)) == (slice(0, 2), slice(2, 4))
    assert problem.row_name(3) == "contact 0 of world and body 0, tangent 1"
    assert np.diff(problem.cones.ptr).tolist() == [2, 2] and problem.name == "two"


def largest_velocity_of_a_stack(slop, n=4, dt=1 / 120, steps=360, **options):
    """Return the largest velocity [m/s or rad/s] of n boxes of 1 m in the last 30 of the steps."""
    position = np.array([(0.0, 0.5 + k) for k in range(n)])
    angle = np.zeros(n)
    velocity = np.zeros((n, 3))
    solution = None
    largest = []
    for _ in range(steps):
        builder = lv.RowBuilder(
            np.ones(n), np.full(n, 6.0), velocity - (0.0, G * dt, 0.0), dt, position, slop=slop
        )
        turn = [np.array([(np.cos(a), -np.sin(a)), (np.sin(a), np.cos(a))]) for a in angle]
        for k in range(n):
            below, frame = (
                (position[k - 1], turn[k - 1]) if k else (np.array((0.0, -0.5)), np.eye(2))
            )
            for i, x in enumerate((-0.5, 0.5)):
                along, height = (position[k] + turn[k] @ (x, -0.5) - below) @ frame
                point = below + frame @ (np.clip(along, -0.5, 0.5) if k else along, height)
                if height - 0.5 < 0.02:
                    builder.contact(
                        k - 1, k, point, frame @ (0.0, 1.0), gap=height - 0.5, mu=0.6, feature=i
                    )
        problem = builder.problem()
        start = None if solution is None else problem.carry(solution)
        solution = lv.solve(problem, "pgs", impulse=start, **options)
        velocity = builder.velocity_after(problem, solution.impulse)
        position = position + dt * velocity[:, :2]
        angle = angle + dt * velocity[:, 2]
        largest.append(abs(velocity).max())
    return max(largest[-30:])


def test_a_slop_or_a_tolerance_keeps_a_stack_at_rest():
    """Check the statement of the quick start about budgets, with four boxes for three seconds."""
    assert largest_velocity_of_a_stack(0.0, tol=0, max_iter=10) > 0.03
    assert largest_velocity_of_a_stack(0.001, tol=0, max_iter=10) < 1e-3
    assert largest_velocity_of_a_stack(0.0, tol=1e-6, max_iter=10_000) < 1e-4


def test_a_tangent_can_be_chosen():
    builder = spatial(np.zeros((1, 6)), np.zeros((1, 3)))
    builder.contact(-1, 0, (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), mu=1.0, tangent=(3.0, 3.0, 1.0))
    expected = [np.sqrt(0.5), np.sqrt(0.5), 0.0]
    np.testing.assert_allclose(builder.problem().rows.tangent[0], expected, rtol=0.0, atol=1e-15)


def test_row_builder_rod_with_coinciding_anchors_pushes_b_along_z():
    builder = spatial(np.zeros((1, 6)), np.zeros((1, 3)))
    point = (0.0, 0.0, 0.0)
    builder.distance(-1, 0, point, point, 1.0)
    _, velocity = solved(builder, tol=1e-10)
    # eq. 1: the rod is 1 m too short, and a step of length DT removes a fifth of it; v_z = 0.2 / DT to 1e-9 relative.
    np.testing.assert_allclose(velocity[0, :3], [0.0, 0.0, 0.2 / DT], rtol=1e-9, atol=1e-9)


#: Arguments of array calls in three dimensions by type of block; "point" and "axis" are random vectors.
ARRAYS = {
    "ball": {"anchor": "point"},
    "hinge": {"anchor": "point", "axis": "axis", "anchor_b": "point", "axis_b": "axis"},
    "weld": {"anchor": "point", "anchor_b": "point", "angle_error": "axis"},
    "slider": {"anchor": "point", "axis": "axis", "angle_error": "axis"},
    "distance": {"anchor_a": "point", "anchor_b": "point", "length": "number"},
    "spring": {"anchor_a": "point", "anchor_b": "point", "length": "number", "stiffness": "number"},
    "motor": {"axis": "axis", "speed": "number", "max_torque": "number"},
    "limit": {"axis": "axis", "value": "number", "upper": "number", "anchor": "point"},
    "gear": {"axis_a": "axis", "axis_b": "axis", "ratio": "number", "angle_error": "number"},
    "contact": {
        "point": "point",
        "normal": "unit",
        "gap": "number",
        "mu": "number",
        "restitution": "number",
    },
}


def draw_arguments(rng, block_type, n, dimensions):
    """Return random arguments of n blocks by name."""
    values = {}
    for name, kind in ARRAYS[block_type].items():
        if kind == "axis" and dimensions == 2 and (block_type != "slider" or name != "axis"):
            if name == "angle_error":
                values[name] = rng.normal(size=n)
            elif block_type == "limit":
                values[name] = rng.normal(size=(n, 2))
            continue  # In two dimensions, axes of rotation are not given.
        values[name] = (
            rng.uniform(0.1, 0.9, size=n) if kind == "number" else rng.normal(size=(n, dimensions))
        )
        if kind == "unit":
            values[name] /= np.linalg.norm(values[name], axis=1)[:, None]
    return values


@pytest.mark.parametrize("dimensions", [2, 3])
@given(seed=seeds)
def test_row_builder_with_arrays_of_blocks_has_the_bits_of_single_calls(dimensions, seed):
    rng = np.random.default_rng(seed)
    n = 4
    inertia = np.full(3, 2.0) if dimensions == 2 else np.tile(2.0 * np.eye(3), (3, 1, 1))
    bodies = (
        np.ones(3),
        inertia,
        rng.normal(size=(3, 3 * dimensions - 3)),
        DT,
        rng.normal(size=(3, dimensions)),
    )
    single, arrays = lv.RowBuilder(*bodies), lv.RowBuilder(*bodies)
    single_keys, array_keys = [], []
    for block_type in rng.permutation(list(ARRAYS)):
        pairs = [(-1, 0), (0, 1), (0, 1), (2, -1)]
        values = draw_arguments(rng, block_type, n, dimensions)
        names = {"names": [f"{letter} {block_type}" for letter in "zamb"]} if seed % 2 else {}
        for i, (a, b) in enumerate(pairs):
            one = {name: x[i].tolist() for name, x in values.items()}
            one |= {"name": names["names"][i]} if names else {}
            single_keys.append(getattr(single, block_type)(a, b, **one))
        if block_type == "contact":
            points, normals = values.pop("point"), values.pop("normal")
            array_keys += arrays.contacts(pairs, points, normals, **values, **names).tolist()
        else:
            array_keys += arrays.joints(block_type, pairs, **values, **names).tolist()
    assert array_keys == single_keys
    first, second = single.problem(), arrays.problem()
    assert first == second and first.b.tobytes() == second.b.tobytes()
    assert [first.names[0], *first.names] == [second.names[0], *second.names]


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("e", [1.0, 0.5])
def test_contact_restitution_on_the_velocity_before_the_step_bounces_as_the_closed_form(e, planar):
    """Fifty bounces, each with the speed of the last: e^k of the first, whatever gravity adds in the step."""
    h = 1.0 / 60.0
    speed = 4.0
    up = 1
    width = 3 if planar else 6
    n = 2 if planar else 3
    for k in range(50):
        before = np.zeros((1, width))
        before[0, up] = -speed
        free = before.copy()
        free[0, up] -= 9.81 * h
        normal = np.eye(n)[up]
        builder = lv.RowBuilder(
            [1.0],
            [6.0] if planar else [6.0 * np.eye(3)],
            free,
            h,
            position=[0.5 * normal],
            velocity_before=before,
        )
        builder.contact(-1, 0, np.zeros(n), normal, restitution=e, restitution_threshold=0.0)
        problem = builder.problem()
        speed = float(builder.velocity_after(problem, lv.solve(problem, tol=1e-12).impulse)[0, up])
        assert speed == pytest.approx(4.0 * e ** (k + 1), rel=1e-9)


@pytest.mark.parametrize("block_type", ARRAYS)
@pytest.mark.parametrize("coincide", [False, True])
@given(seed=seeds)
def test_rows_in_two_dimensions_move_bodies_in_their_plane_alone(block_type, coincide, seed):
    """Of points that coincide too, whose direction is chosen."""
    rng = np.random.default_rng(seed)
    builder = lv.RowBuilder(
        np.ones(2), np.full(2, 2.0), rng.normal(size=(2, 3)), DT, np.zeros((2, 2))
    )
    values = draw_arguments(rng, block_type, 1, 2)
    if coincide:
        values |= {
            name: np.zeros((1, 2)) for name, kind in ARRAYS[block_type].items() if kind == "point"
        }
    getattr(builder, block_type)(0, 1, **{name: x[0].tolist() for name, x in values.items()})
    problem = builder.problem()
    jac = problem.rows.jacobian(problem.cones).toarray().reshape(-1, 2, 6)
    assert not jac[:, :, 2:5].any()
    assert (np.abs(jac[:, :, [0, 1, 5]]).max(axis=(1, 2)) > 0.0).all()
    np.testing.assert_allclose(problem.velocity(np.ones(problem.m))[:, 2:5], 0.0, atol=0.0)
