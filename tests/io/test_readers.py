"""Readers of engines that return many worlds: the same questions to each, on recorded arrays or those of MuJoCo."""

import numpy as np
import pytest
from recorded_engines import (
    MAX_ROWS,
    Recorded,
    make_genesis,
    make_kamino,
    make_newton_mujoco,
    replace_genesis,
)

import lavender as lv

# Engines and data are float32: v+ of the impulses and the engine's own velocity differ by roundings of 1 m/s numbers.
VELOCITY_TOLERANCE = 1e-4


@pytest.fixture(autouse=True)
def genesis(monkeypatch):
    replace_genesis(monkeypatch)


def read_kamino(model, **changes):
    """Read a step; return it with the engine's next velocity of each world."""
    solver = make_kamino(model, **changes)
    ends = np.cumsum(solver._solver_kamino._model.info.num_bodies.array)
    return lv.io.from_kamino(solver), [
        x.ravel() for x in np.split(solver.velocity.array, ends[:-1])
    ]


def read_genesis(model, **changes):
    scene = make_genesis(model, **changes)
    return lv.io.from_genesis(scene), scene.sim.rigid_solver.dyn_state.dofs.vel.array.T


def read_newton_mujoco(cone, **changes):
    solver = make_newton_mujoco(cone, **changes)
    data = solver.mjw_data
    dt = solver.mj_model.opt.timestep
    step = lv.io.from_newton_mujoco(solver, data.qvel.array)
    return step, data.qvel.array + dt * data.qacc.array


READERS_BY_ENGINE = {
    **{
        f"kamino, {m}": lambda m=m, **more: read_kamino(m, **more)
        for m in ("mixed", "stacks", "dvi")
    },
    **{
        f"genesis, {m}": lambda m=m, **more: read_genesis(m, **more)
        for m in ("arm", "convex", "pyramids")
    },
    **{
        f"newton's mujoco, {m}": lambda m=m, **more: read_newton_mujoco(m, **more)
        for m in ("elliptic", "pyramidal")
    },
}


def spoil(world, value):
    """Return a change that writes a value into the first number of a world, which is the first or the last index."""

    def change(array):
        array[(world, 0) if array.shape[0] == 3 else (0, world)] = value
        return array

    return change


@pytest.mark.parametrize(
    "name", [name for name in READERS_BY_ENGINE if name != "kamino, stacks"]
)  # a world has no finite velocity
def test_reader_impulses_give_the_next_velocity_of_the_engine(name):
    step, after = READERS_BY_ENGINE[name]()
    assert step.claims.converged.shape == (len(step.batch),) and step.batch.precision == "float32"
    for i, problem in enumerate(step.batch):
        impulse = (
            step.impulse[step.batch.rows_of(i)]
            if step.impulse.ndim == 1
            else step.impulse[i, : problem.m]
        )
        assert np.abs(problem.velocity(impulse) - after[i]).max() <= VELOCITY_TOLERANCE


@pytest.mark.parametrize(
    ("name", "world", "changes"),
    [
        ("kamino, stacks", 7, {}),  # recorded with a NaN
        ("genesis, arm", 1, {"vel": spoil(1, np.nan)}),
        ("genesis, convex", 1, {"qacc": spoil(1, np.nan)}),
        ("genesis, convex", 1, {"qacc": spoil(1, 1e12)}),
        ("newton's mujoco, elliptic", 1, {"qacc": spoil(1, np.nan)}),
        ("newton's mujoco, elliptic", 1, {"qacc": spoil(1, -1e12)}),
    ],
)
def test_reader_of_a_world_with_bad_numbers_has_no_answer_for_it_alone(name, world, changes):
    step, _ = READERS_BY_ENGINE[name](**changes)
    found = lv.residual_many(step.batch, step.impulse, errors="status")
    assert np.flatnonzero(~np.isfinite(found.velocity_error)).tolist() == [world]
    assert set(found.faults) <= {world} and step.claims.converged.shape == (len(step.batch),)
    clean = (
        found if name == "kamino, stacks" else lv.residual_many(*READERS_BY_ENGINE[name]()[0][:2])
    )
    others = np.delete(np.arange(len(step.batch)), world)
    np.testing.assert_array_equal(found.relative[others], clean.relative[others])


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_reader_answers_of_mujoco_in_float32_are_right(cone):
    step, _ = read_newton_mujoco(cone)
    verdicts = lv.residual_many(step.batch, step.impulse, threshold=1e-4).verdict
    assert (
        set(verdicts.tolist()) <= {"at its floor", "close enough"} and step.claims.converged.all()
    )
    assert not any(dropped.any() for dropped in step.claims.residuals.values())


def test_from_newton_mujoco_counts_used_iterations_and_rows_and_contacts_without_memory():
    solver = make_newton_mujoco("pyramidal")
    data = solver.mjw_data
    data.solver_niter = Recorded([2, 100, 3])
    needed = data.nefc.array + MAX_ROWS
    stored = int(data.nacon.array[0])
    data.nefc = Recorded(needed)
    data.nacon = Recorded([stored + 5])
    step = lv.io.from_newton_mujoco(solver, data.qvel.array)
    assert step.claims.converged.tolist() == [True, False, True]
    assert (step.batch.row_counts == MAX_ROWS).all()
    assert step.claims.residuals["dropped_rows"].tolist() == (needed - MAX_ROWS).tolist()
    assert step.claims.residuals["dropped_contacts"].tolist() == [5.0] * 3


def set_at(path, value):
    """Return a change of an object at a dotted path; an ellipsis deletes the attribute."""

    def change(thing):
        *owners, last = path.split(".")
        for name in owners:
            thing = getattr(thing, name)
        delattr(thing, last) if value is ... else setattr(thing, last, value)

    return change


def flatten_inertia(x):
    x[2, 0, :] = x[2, :, 0] = 0.0
    return x


KAMINO = (lv.io.from_kamino, make_kamino, "mixed")
GENESIS = (lv.io.from_genesis, make_genesis, "arm")
MUJOCO = (
    lambda solver: lv.io.from_newton_mujoco(solver, np.zeros((3, 1))),
    make_newton_mujoco,
    "elliptic",
)
#: Reader, changes of arrays, change of the object, words of the CapabilityError.
UNSUPPORTED = [
    (KAMINO, {"inv_m_i": lambda x: 1.01 * x}, None, r"world \d: the engine's matrix differs"),
    (
        (*KAMINO[:2], "dvi"),
        {"nzb_coords": lambda x: x[:, ::-1]},
        None,
        r"world \d: the engine's matrix differs",
    ),
    (KAMINO, {"inv_I_i": flatten_inertia}, None, r"body 2 .* singular"),
    (KAMINO, {}, set_at("_solver_kamino._config.dynamics_solver", "lox"), "dynamics_solver='lox'"),
    (KAMINO, {}, set_at("_solver_kamino._config.sparse_dynamics", True), "sparse_dynamics=True"),
    (KAMINO, {}, set_at("_solver_kamino.problem_fd.data.bound_lower", ...), "bound_lower"),
    (GENESIS, {"mass_mat": lambda x: 1.01 * x}, None, "qacc_smooth differs from qfrc_smooth"),
    (GENESIS, {}, set_at("sim.rigid_solver._options.noslip_iterations", 3), "noslip_iterations"),
    (GENESIS, {}, set_at("sim.rigid_solver.rigid_config.use_hibernation", True), "use_hibernation"),
    (GENESIS, {}, set_at("sim.rigid_solver.rigid_config.enable_rolling_friction", True), "rolling"),
    (GENESIS, {}, set_at("sim.coupler", type("SAPCoupler", (), {})()), "SAPCoupler"),
    (GENESIS, {}, set_at("sim.rigid_solver.rigid_info.mass_mat", ...), "mass_mat"),
    (MUJOCO, {}, set_at("mjw_data.qfrc_smooth", ...), "qfrc_smooth"),
    (MUJOCO, {}, set_at("mjw_data.efc.J", Recorded(np.zeros((3, 1, 500), np.float32))), "sparse"),
]


@pytest.mark.parametrize(
    ("reader", "arrays", "change", "words"), UNSUPPORTED, ids=[words for *_, words in UNSUPPORTED]
)
def test_reader_of_unsupported_data_raises_an_error_that_names_them(reader, arrays, change, words):
    read, make, model = reader
    given = make(model, **arrays)
    if change is not None:
        change(given)
    with pytest.raises(lv.CapabilityError, match=words):
        read(given)


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (KAMINO[0], "a object; a newton"),
        (GENESIS[0], "a object; a built"),
        (MUJOCO[0], "SolverMuJoCo"),
    ],
)
def test_reader_of_another_object_names_the_needed_type(read, words):
    with pytest.raises(lv.InputError, match=words):
        read(object())
