"""MuJoCo's constraint problem read from memory: its own solution is the judge's solution too."""

import copy
import gc
import weakref
from itertools import product

import numpy as np
import pytest
from mujoco_scene import mj, scene, state

import lavender as lv
from lavender.io import mujoco as adapter
from lavender.io import mujoco_memory

# MuJoCo's solvers stop where the cost no longer falls; in float64 that is 1e-16 of it, and the residual of a
# minimiser is the square root of what is left.
NEWTON = 1e-8
PGS = 1e-6  # its improvement of a whole sweep is small long before the distance is


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
@pytest.mark.parametrize(
    ("cone", "condim"),
    [
        ("elliptic", 3),
        ("elliptic", 4),
        ("elliptic", 6),
        ("elliptic", 1),
        ("pyramidal", 3),
        ("pyramidal", 6),
    ],
)
def test_from_mujoco_answer_of_newton_is_a_solution(cone, condim, jacobian):
    model, data = state(cone, condim=condim, jacobian=jacobian)
    problem = lv.io.from_mujoco(model, data)
    found = lv.residual(problem, adapter.impulse(model, data))
    assert data.ncon >= 3
    assert problem.law == ("cone" if cone == "elliptic" and condim > 1 else "lcp")
    assert found.relative < NEWTON
    assert found.velocity_at_zero > 1e-3  # m/s: there was something to do


def test_from_mujoco_matrix_and_b_equal_the_arrays_of_mujoco():
    model, data = state(jacobian="sparse")
    problem = lv.io.from_mujoco(model, data)
    jac = adapter.jacobian(model, data).toarray()
    mass = np.zeros((model.nv, model.nv))
    for i, column in enumerate(np.eye(model.nv)):
        mj.mj_mulM(model, data, mass[i], column)
    a = jac @ np.linalg.solve(mass, jac.T) + np.diag(data.efc_R)
    # 1e-12: rounding of a dense solve with the condition number of M, about 1e3.
    np.testing.assert_allclose(problem.dense(), a, atol=1e-12 * np.abs(a).max())
    np.testing.assert_allclose(
        problem.b, -model.opt.timestep * data.efc_b, atol=1e-14 * np.abs(data.efc_b).max()
    )
    assert problem.asymmetry == 0.0


def test_from_mujoco_blocks_have_names_and_kinds():
    model, data = state(condim=4)
    problem = lv.io.from_mujoco(model, data)
    c = problem.cones
    assert problem.names[0] == "equality string"
    assert list(c.ptr[:2]) == [0, 3] and np.isinf(c.upper[:3]).all()
    door = problem.names.index("friction of joint door")
    row = c.ptr[door]
    assert (c.lower[row], c.upper[row]) == pytest.approx(
        (-0.1 * model.opt.timestep, 0.1 * model.opt.timestep)
    )
    spin = np.flatnonzero(c.kind == lv.ROUND)
    assert len(spin)
    assert c.mu[spin] == pytest.approx(0.5)
    assert adapter.scaling(model, data)[c.ptr[spin] + 3] == pytest.approx(0.02 / 0.5)
    assert any("(low, high)" in name for name in problem.names)
    limit = [i for i, name in enumerate(problem.names) if name == "limit of joint door"]
    assert all(c.lower[c.ptr[i]] == 0.0 and c.upper[c.ptr[i]] == np.inf for i in limit)


@pytest.mark.parametrize("condim", [3, 4, 6])
def test_from_mujoco_with_unequal_coefficients_scales_rows_to_a_round_cone(condim):
    text = scene(condim=condim)
    pair = '<contact><pair geom1="low" geom2="high" condim="{}" friction="0.6 0.2 0.02 0.003 0.001"/></contact>'
    model = mj.MjModel.from_xml_string(
        text.replace("<equality>", pair.format(condim) + "<equality>")
    )
    data = mj.MjData(model)
    for _ in range(25):
        mj.mj_step(model, data)
    data.qvel[6:12] = 0.2, 0.1, 0.0, 0.3, 0.0, 0.5
    mj.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    scale = adapter.scaling(model, data)
    assert scale.min() < 0.4
    assert lv.residual(problem, adapter.impulse(model, data)).relative < NEWTON
    # Softness is the same on all tangents of a contact: what MuJoCo's R is made for.
    c = problem.cones
    for i in np.flatnonzero(np.diff(c.ptr) > 2):
        if c.mu[i] > 0.0:
            soft = problem.compliance[c.ptr[i] + 1 : c.ptr[i + 1]]
            np.testing.assert_allclose(soft, soft[0], rtol=1e-14)
    solution = lv.solve(problem, "newton", tol=1e-11, impulse=np.zeros(problem.m))
    assert solution.residual.relative <= max(1e-11, 2 * solution.residual.roundoff_floor)
    found = adapter.acceleration(model, data, solution.impulse)
    assert np.abs(found - data.qacc).max() < 1e-5 * (1 + np.abs(data.qacc).max())


def test_from_mujoco_has_velocities_keys_and_no_guess():
    model, data = state()
    problem = lv.io.from_mujoco(model, data)
    assert problem.operator == "generalized"
    dt = model.opt.timestep
    after = problem.velocity(adapter.impulse(model, data))
    np.testing.assert_allclose(after, data.qvel + dt * data.qacc, atol=1e-6)
    assert (
        problem.guess is None
    )  # MuJoCo's answer is no start: who times a solve from it times nothing
    assert lv.solve(problem, "newton", tol=1e-6).iterations > 0
    assert (
        lv.solve(problem, "newton", tol=1e-6, impulse=adapter.impulse(model, data)).iterations == 0
    )
    assert len(np.unique(problem.key)) == problem.n_blocks
    names = list(problem.names)
    keys = problem.key
    mj.mj_step(model, data)
    mj.mj_forward(model, data)
    later = lv.io.from_mujoco(model, data)
    both = set(keys.tolist()) & set(later.key.tolist())
    assert len(both) >= 5
    for key in both:
        before = names[keys.tolist().index(key)].split(" (")
        now = later.names[later.key.tolist().index(key)].split(" (")
        assert before[1:] == now[1:]  # the same geoms, or the same joint
        assert before[0].rstrip("0123456789") == now[0].rstrip("0123456789")
    assert list(problem.names) == names


@pytest.mark.parametrize("integrator", ["EULER", "RK4", "IMPLICIT", "IMPLICITFAST"])
@pytest.mark.parametrize("solver", ["NEWTON", "CG", "PGS"])
@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_from_mujoco_after_an_early_stop_has_the_same_problem(jacobian, solver, integrator):
    model, data = state(jacobian=jacobian)
    model.opt.integrator = getattr(mj.mjtIntegrator, f"mjINT_{integrator}")
    model.opt.solver = getattr(mj.mjtSolver, f"mjSOL_{solver}")
    mj.mj_forward(model, data)
    whole = lv.io.from_mujoco(model, data)
    done = lv.residual(whole, adapter.impulse(model, data))
    model.opt.iterations, model.opt.tolerance, data.qacc_warmstart[:] = 1, 0.0, 0.0
    mj.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    assert problem == whole
    found = lv.residual(problem, adapter.impulse(model, data))
    assert done.relative < (NEWTON if solver == "NEWTON" else PGS)
    assert found.velocity > max(1e-3, 1e3 * done.velocity)  # m/s
    assert found.relative > 1e-3
    assert found.verdict != "at its floor"
    mj.mj_step(model, data)
    if integrator != "RK4":  # whose last forward pass is that of another moment
        assert np.array_equal(lv.io.from_mujoco(model, data).b, problem.b)


def test_from_mujoco_without_efc_r_reads_its_inverse():
    model, data = state()
    right = lv.io.from_mujoco(model, data)
    data.efc_R[:] = 0.0
    np.testing.assert_allclose(
        lv.io.from_mujoco(model, data).compliance, right.compliance, rtol=1e-14
    )
    data.efc_R[:] = 3.0
    with pytest.raises(lv.CapabilityError, match="efc_R and 1 / efc_D differ"):
        lv.io.from_mujoco(model, data)


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_from_mujoco_of_an_edited_model_reads_the_new_values(jacobian):
    """What is kept with a model is compared before it serves: the same bits as from a model seen for the first time."""
    model, data = state(jacobian=jacobian)
    for change in ("body_mass", "dof_armature", "geom_friction", "dof_frictionloss"):
        before = lv.io.from_mujoco(model, data)
        array = getattr(model, change)
        array[:] = 1.5 * array + 0.01
        mj.mj_setConst(model, data)
        mj.mj_forward(model, data)
        fresh = copy.copy(model)
        other = mj.MjData(fresh)
        other.qpos[:], other.qvel[:], other.qacc_warmstart[:] = (
            data.qpos,
            data.qvel,
            data.qacc_warmstart,
        )
        mj.mj_forward(fresh, other)
        found = lv.io.from_mujoco(model, data)
        assert found == lv.io.from_mujoco(fresh, other) != before


def test_from_mujoco_of_a_flex_has_a_block_for_each_edge():
    """Together its rows would reach every vertex, and each row of M^-1/2 J^T would be as long as the flex is large."""
    model = mj.MjModel.from_xml_string("""<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
        <flexcomp name="cloth" type="grid" dim="2" count="5 5 1" spacing=".05 .05 .05" pos="0 0 .02" radius=".01"
        mass="1"><edge equality="true"/></flexcomp></worldbody></mujoco>""")
    data = mj.MjData(model)
    for _ in range(20):
        mj.mj_step(model, data)
    mj.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    edges = int(np.count_nonzero(data.efc_type[: data.nefc] == mj.mjtConstraint.mjCNSTR_EQUALITY))
    assert edges > 6
    assert np.array_equal(problem.cones.ptr[: edges + 1], np.arange(edges + 1))
    assert len(np.unique(problem.key)) == problem.n_blocks
    assert problem.names[edges - 1].endswith(f"edge {edges - 1}")
    assert problem.whitened.nnz <= 9 * problem.m  # three vertices at most
    solution = lv.solve(problem, "newton", tol=1e-9)
    assert solution.success or solution.residual.at_floor


CLOTH = """<mujoco><option cone="{cone}" tolerance="1e-12" iterations="300"/><worldbody>
  <geom type="plane" size="2 2 .1" condim="{condim}"/><geom type="sphere" size=".08" pos=".05 .03 .05"/>
  <body pos="0 0 .4"><freejoint/><geom type="sphere" size=".05" mass=".2"/></body>
  <flexcomp name="cloth" type="grid" {more} spacing=".05 .05 .05" pos="0 0 .2" radius=".01" mass="1">
  <edge equality="{edge}"/><contact selfcollide="auto" condim="{condim}"/></flexcomp></worldbody></mujoco>"""
FLEXES = {
    "rope": ('dim="1" count="8 1 1"', "true"),
    "cloth": ('dim="2" count="5 5 1"', "true"),
    "solid": ('dim="3" count="3 3 3"', "true"),
    "interpolated": ('dim="3" count="3 3 3" dof="trilinear"', "false"),
}


@pytest.mark.parametrize("kind", FLEXES)
@pytest.mark.parametrize(
    ("cone", "condim"), [("pyramidal", 3), ("elliptic", 1), ("elliptic", 3), ("elliptic", 4)]
)
def test_solve_of_a_flex_gives_the_acceleration_of_mujoco(cone, condim, kind):
    more, edge = FLEXES[kind]
    try:
        model = mj.MjModel.from_xml_string(
            CLOTH.format(cone=cone, condim=condim, more=more, edge=edge)
        )
    except ValueError as error:
        pytest.skip(f"this MuJoCo does not know it: {error}")
    data = mj.MjData(model)
    met = 0
    for _ in range(12):
        try:
            mj.mj_step(model, data, 10)
        except mj.FatalError as error:
            pytest.skip(f"this MuJoCo cannot step it: {error}")
        mj.mj_forward(model, data)
        problem = lv.io.from_mujoco(model, data)
        met = max(met, int(np.count_nonzero(np.array(data.contact.geom) < 0)))
        solution = lv.solve(problem, tol=1e-9)
        found = adapter.acceleration(model, data, solution.impulse)
        # 1e-9 of what contact changes, over the softness that MuJoCo's elliptic cones stop at
        assert np.abs(found - data.qacc).max() < 1e-5 * (1.0 + np.abs(data.qacc).max())
    assert met > 0  # a vertex has touched something


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_from_mujoco_after_a_step_of_rk4_reads_the_mean_acceleration_of_four_passes(cone):
    """Of none is efc_force; after a forward pass they are those of its forces, as under any integrator.

    Before MuJoCo 4.0 they are those of the last pass.
    """
    model, data = state(cone)
    model.opt.integrator = mj.mjtIntegrator.mjINT_RK4
    v = data.qvel.copy()
    mj.mj_step(model, data)
    if int(mj.__version__.partition(".")[0]) >= 4:
        np.testing.assert_allclose(data.qacc, (data.qvel - v) / model.opt.timestep, atol=1e-9)
        own = adapter.acceleration(model, data, adapter.impulse(model, data))
        assert np.abs(own - data.qacc).max() > 1e-2
    mj.mj_forward(model, data)
    solution = lv.solve(lv.io.from_mujoco(model, data), tol=1e-10)
    np.testing.assert_allclose(
        adapter.acceleration(model, data, solution.impulse), data.qacc, atol=1e-5
    )


# -- data that were changed -----------------------------------------------------------------------------

INDICES = (
    "efc_id",
    "efc_J_colind",
    "efc_J_rowadr",
    "efc_J_rownnz",
    "dim",
    "M_colind",
    "M_rowadr",
    "M_rownnz",
)
NUMBERS = ("qacc", "qvel", "qacc_smooth", "efc_aref", "efc_force", "efc_vel", "efc_J", "efc_R", "M")


def same_to_rounding(found, right):
    """Blocks are the same, and J, M, b, v* and compliances but for the last digits."""
    if found.cones != right.cones:
        return False
    pairs = [(getattr(found, name), getattr(right, name)) for name in ("b", "compliance")]
    pairs.append((found.generalized.v_free, right.generalized.v_free))
    held = (found.generalized, right.generalized)
    pairs += [tuple(getattr(g, name).toarray() for g in held) for name in ("jac", "mass")]
    return all(np.allclose(x, y, rtol=1e-12, atol=1e-12) for x, y in pairs)


@pytest.mark.parametrize("way", ["EULER", "IMPLICITFAST", "RK4", "noslip"])
@pytest.mark.parametrize("name", [*INDICES, *NUMBERS])
def test_from_mujoco_with_a_changed_array_raises_or_reads_the_same_problem(name, way):
    """Before an index is followed, and though the pattern of M was seen before; no integrator is blamed for it."""
    model, data = state(condim=4, jacobian="sparse")
    if way == "noslip":
        model.opt.noslip_iterations = 3
    else:
        model.opt.integrator = getattr(mj.mjtIntegrator, f"mjINT_{way}")
    mj.mj_forward(model, data)
    right = lv.io.from_mujoco(model, data)
    array = getattr(
        model if name.startswith("M_") else data.contact if name == "dim" else data, name
    )
    before = np.array(array)
    n = len(array)
    said = []
    wrong = (-1, 2**31 - 1, 1000) if name in INDICES else (np.nan, np.inf)
    # Of one entry of J that nothing moves or pushes nobody can tell: all at once are a little more.
    scaled = () if name in INDICES else [(slice(None), (1.0 + 1e-6) * before)]
    for at, value in (*product((0, n // 2, n - 1), wrong), *scaled):
        array[:] = before
        array[at] = value
        try:
            found = lv.io.from_mujoco(model, data)
        except lv.LavenderError as told:
            said.append(str(told))
        else:
            assert same_to_rounding(found, right), (at, value)
    assert len(said) >= 4
    assert not any("integrator" in words for words in said)


def test_from_mujoco_keeps_only_constant_arrays_of_a_model_and_releases_it():
    model, data = state()
    for name in ("body_parentid", "dof_bodyid"):
        lv.io.from_mujoco(model, data)
        whole = getattr(model, name)
        kept = int(whole[-1])
        whole[-1] = 1000
        with pytest.raises(
            lv.InputError, match="dof_bodyid and body_parentid do not describe a tree"
        ):
            lv.io.from_mujoco(model, data)
        whole[-1] = kept
    alive = weakref.ref(model)
    del model, data, whole
    gc.collect()
    assert alive() is None


def test_solve_of_an_imported_step_leaves_its_fields_postponed():
    model, data = state()
    adapter.from_mujoco(model, data)  # Later steps share the pattern of the first.
    problem, other = adapter.from_mujoco(model, data), adapter.from_mujoco(model, data)
    assert lv.solve(problem).impulse.tobytes() == lv.solve(other).impulse.tobytes()
    assert {"b", "cones", "generalized", "compliance", "key", "names"}.isdisjoint(vars(problem))
    assert problem.names[0] == other.names[0]
    assert problem == copy.copy(other)
    assert "_rest" not in vars(problem)
    with pytest.raises(AttributeError, match="no attribute 'keys'"):
        _ = problem.keys


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_from_mujoco_without_a_description_of_structs_reads_attributes(monkeypatch, cone, jacobian):
    model, data = state(cone, condim=4, jacobian=jacobian)
    assert mujoco_memory.find_layout(mj)[0] is not None
    from_memory = lv.io.from_mujoco(model, data)
    states = np.r_[data.qpos, data.qvel][None]
    many = lv.io.from_mujoco_many(model, states)
    monkeypatch.setitem(mujoco_memory.TYPE_SIZES, "size_t", 16)
    layout = mujoco_memory.find_layout.__wrapped__(mj)
    assert layout[0] is None  # offsets that do not lead to the arrays of the attributes
    monkeypatch.setattr(mujoco_memory, "find_layout", lambda _: layout)
    model, other = copy.copy(model), copy.copy(data)
    assert lv.io.from_mujoco(model, other) == from_memory
    assert np.array_equal(adapter.impulse(model, other), adapter.impulse(model, data))
    assert np.array_equal(lv.io.from_mujoco_many(model, states).impulse, many.impulse)
    other.nefc = 2**30
    with pytest.raises(lv.InputError, match="do not fit into"):
        lv.io.from_mujoco(model, other)


def test_find_layout_of_an_unknown_type_returns_no_offsets(monkeypatch):
    monkeypatch.setattr(mujoco_memory, "TYPE_SIZES", {"int": 4})
    assert mujoco_memory.find_layout.__wrapped__(mj)[0] is None


@pytest.mark.parametrize("n_rows", [0, 1, 2])
def test_from_mujoco_without_a_forward_pass_or_with_rows_of_none_raises(n_rows):
    """A pass without constraints leaves no arrays of rows, though the arena has memory in use."""
    model = mj.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mj.MjData(model)
    if n_rows:
        mj.mj_forward(model, data)
        data.nefc = n_rows
    with pytest.raises(lv.InputError, match="do not fit into" if n_rows else "mj_forward"):
        lv.io.from_mujoco(model, data)


@pytest.mark.parametrize("before", ["dense", "sparse"])
def test_from_mujoco_with_another_jacobian_layout_than_the_data_raises(before):
    model, data = state(jacobian=before)
    other = {"dense": mj.mjtJacobian.mjJAC_SPARSE, "sparse": mj.mjtJacobian.mjJAC_DENSE}[before]
    model.opt.jacobian = other
    with pytest.raises(lv.LavenderError, match=r"opt\.jacobian"):
        lv.io.from_mujoco(model, data)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 0.0, -9.81)])
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("stepped", [False, True])
@pytest.mark.parametrize("factor", [0.0, -1.0, 1.0 + 1e-6])
def test_from_mujoco_with_a_jacobian_of_other_data_raises(factor, stepped, moving, gravity):
    model, data = state()
    model.opt.gravity[:] = gravity
    if not moving:
        data.qvel[:] = 0.0
    (mj.mj_step if stepped else mj.mj_forward)(model, data)
    assert lv.io.from_mujoco(model, data).m > 0
    data.efc_J[:] = factor * data.efc_J
    # Nothing moves, pushes or falls: what J is nobody can tell.
    if moving or any(gravity) or np.abs(data.efc_force).max() > 0.0:
        with pytest.raises(lv.CapabilityError, match="not the Jacobian of this forward pass"):
            lv.io.from_mujoco(model, data)


def test_from_mujoco_with_data_of_another_model_raises():
    model, data = state()
    text = scene()
    # As many velocities, of six joints where one was.
    ways = "".join(
        f'<joint type="{kind}" axis="{axis}"/>'
        for kind in ("slide", "hinge")
        for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    bob = '<body name="bob" pos="0 2 1">'
    other = mj.MjModel.from_xml_string(text.replace(f"{bob}<freejoint/>", bob + ways))
    assert other.nv == model.nv
    with pytest.raises(lv.LavenderError):
        lv.io.from_mujoco(other, data)


def test_from_mujoco_of_other_objects_raises():
    model, data = state(steps=1)
    with pytest.raises(lv.InputError, match=r"MjModel.*needed"):
        lv.io.from_mujoco(data, model)
    with pytest.raises(lv.InputError, match=r"impulse \[N s\] has shape"):
        adapter.acceleration(model, data, np.zeros(int(data.nefc) + 1))


@pytest.mark.parametrize("option", ['solver="PGS"', 'integrator="discrete"'])
def test_joint_with_friction_is_judged_after_it_has_come_to_rest(option):
    """The velocity falls by a constant factor in each step, past 1e-60 rad/s; such a b counts as 0."""
    damping = 0 if "PGS" in option else 1
    model = mj.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.002" gravity="0 0 0" {option}/><worldbody><body>
        <joint type="hinge" axis="0 0 1" frictionloss="1" damping="{damping}"/>
        <geom type="cylinder" size=".1 .05" mass="1"/></body></worldbody></mujoco>"""
    )
    data = mj.MjData(model)
    kind = mj.mjtState.mjSTATE_INTEGRATION
    state_of = np.zeros(mj.mj_stateSize(model, kind))
    for velocity in (1e-3, 1e-59, 8e-61, 1e-62, 1e-70, 1e-100, 1e-200):
        data.qvel[:] = velocity
        mj.mj_forward(model, data)
        problem = lv.io.from_mujoco(model, data)
        one = lv.residual(problem, adapter.impulse(model, data))
        assert (velocity >= 1e-59) == bool(problem.b.any())
        mj.mj_getState(model, data, state_of, kind)
        batch, impulse = lv.io.from_mujoco_many(model, state_of[None])
        many = lv.residual_many(batch, impulse)
        # MuJoCo's solver ends at absolute tolerances, so that only the first answer is exact.
        allowed = (1e-9 if velocity == 1e-3 else 2.0) * velocity
        assert max(one.velocity, many.velocity_error[0]) <= allowed
        assert lv.solve_many(batch).success[0]


def test_keys_of_many_states_map_the_impulses_of_the_step_before():
    """Contacts change while the bodies fall and roll; each world starts from its own impulses."""
    model, data = state("elliptic", condim=3)
    kind = mj.mjtState.mjSTATE_INTEGRATION
    size = mj.mj_stateSize(model, kind)
    worlds = [mj.MjData(model) for _ in range(6)]
    for i, world in enumerate(worlds):
        mj.mj_copyData(world, model, data)
        world.qvel[:] += 0.5 * np.random.default_rng(i).standard_normal(model.nv)
    before = None
    changed = 0
    for _ in range(12):
        states = np.empty((len(worlds), size))
        for world, of_world in zip(worlds, states, strict=True):
            mj.mj_getState(model, world, of_world, kind)
        batch, _ = lv.io.from_mujoco_many(model, states)
        if before is not None:
            start = batch.make_start(before)
            changed += not np.array_equal(batch.row_counts, before.problems.row_counts)
            for i in range(len(worlds)):
                expected = batch[i].carry(before[i])
                np.testing.assert_array_equal(start[batch.rows_of(i)], expected)
        before = lv.solve_many(batch, impulse=before)
        assert before.success.all()
        for world in worlds:
            for _ in range(5):
                mj.mj_step(model, world)
    assert changed >= 3
