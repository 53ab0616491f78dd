"""The problem inside a step: the same bits as the step, the judge's values, snapshots, other solvers."""

import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from test_engine_bits import SCENES
from worked import after

import lavender as lv
from lavender.sim.engine.layout import HEAD
from lavender.sim.engine.snapshot import MAGIC
from lavender.sim.scene.parameters import SCENE_ORDERS


def reported(observation, problem):
    """Impulses of a step in the order of the problem's rows."""
    contacts = observation["contacts"]["impulses"]
    size = np.diff(problem.cones.ptr)[problem.rows.n_joints :]
    parts = [
        observation["joint_impulses"],
        *(row[:n] for row, n in zip(contacts, size, strict=True)),
    ]
    return np.concatenate(parts)


#: Contacts of one, three, four, five and six rows, which are swept two at a time if they share no body.
ROWS_OF_CONTACTS = (
    {"friction": 0.0},
    {},
    {"patch_radius": 0.1},
    {"rolling_radius": 0.05},
    {"patch_radius": 0.1, "rolling_radius": 0.001},
)


@pytest.mark.parametrize(
    ("name", "more"),
    [
        *(
            (name, {"warm_start": warm, "solver_iterations": 9})
            for name in SCENES
            for warm in (True, False)
        ),
        *(
            (name, {"order": order, "seed": 5})
            for name in ("stack", "bridge", "pyramid")
            for order in SCENE_ORDERS
        ),
        *(("stack", {"n": 8} | more) for more in ROWS_OF_CONTACTS),
        *(
            ("pyramid", {"base": 6, "friction": 0.05, "friction_shape": "disk"} | more)
            for more in ROWS_OF_CONTACTS[1:]
        ),
        *(
            ("pile", {"n": 60, "rolling_radius": 0.0, "patch_radius": 0.0, "friction": mu})
            for mu in (0.0, 0.5)
        ),
        ("stack", {"n": 1}),
        ("table", {}),
        ("newtons_cradle", {}),
    ],
)
def test_step_has_the_bits_and_residuals_of_solve(name, more):
    sim = lv.Simulation(lv.Scene(name, substeps=1, **SCENES.get(name, {}) | more))
    rows = 0
    for _ in range(30):
        problem = sim.constraint_problem()
        asked = {"order": sim.sweep_order()}
        asked |= {"seed": sim.sweep_seed()} if more.get("order") == "random" else {}
        budget = sim.solver_iterations
        expected = lv.solve(problem, "sequential_impulses", tol=0, max_iter=budget, **asked).impulse
        observation, *_ = sim.step()
        np.testing.assert_array_equal(reported(observation, problem), expected)
        values = dict(zip(lv.SOLVER_FIELDS, observation["solver"], strict=True))
        normal = problem.cones.ptr[:-1][problem.cones.kind > 0]
        assert (values["iterations"], values["contacts"]) == (budget, len(normal))
        assert values["warm_start"] == sim.warm_start
        start = problem.start() if problem.guess is None else problem.guess
        for when, impulse in (("initial", start), ("final", expected)):
            judged = lv.residual(problem, impulse)
            error, slack = judged.error[normal], judged.slack[normal]
            # w is a difference of velocities of up to some m/s, so it carries their rounding, some 1e-15 m/s.
            most = np.abs(error).max(initial=0.0)
            least = slack.min(initial=0.0)
            assert values[f"residual_{when}"] == pytest.approx(most, rel=1e-9, abs=1e-14)
            assert values[f"violation_{when}"] == pytest.approx(-least, rel=1e-9, abs=1e-14)
        rows += problem.m
    assert rows > 0


def test_scene_constraint_problem_has_names_keys_and_guess():
    sim = after(60, "bridge", n=4)
    problem = sim.constraint_problem()
    assert problem.row_name(3) == "hinge 0, axis 3"
    contacts = [problem.row_name(row) for row in problem.cones.ptr[problem.rows.n_joints : -1]]
    assert len(set(contacts)) == len(contacts) > 3
    assert all(re.fullmatch(r"load on plank \d, point [1-4], normal", name) for name in contacts)
    assert len(set(problem.key.tolist())) == problem.n_blocks
    assert problem.guess.shape == (problem.m,) and np.abs(problem.guess).max() > 0
    sim.set_warm_start(False)
    assert sim.constraint_problem().guess is None
    assert lv.Simulation(lv.Scene("ramp", friction=0)).constraint_problem().cones.n_rows == 4


def test_scene_iterations_and_warm_start_set_now_act_in_the_next_step():
    sim = lv.Simulation("stack")
    sim.step()
    assert sim.step()[0]["solver"][[0, 1, 3]].tolist() == [16, 1, 24]
    sim.set_solver_iterations(33)
    sim.set_warm_start(False)
    assert sim.step()[0]["solver"][[0, 1, 3]].tolist() == [33, 0, 0]
    sim.set_warm_start(True)  # the cache was kept meanwhile
    assert sim.step()[0]["solver"][[0, 1, 3]].tolist() == [33, 1, 24]


def test_restore_of_a_foreign_or_damaged_snapshot_raises(tmp_path):
    sim = lv.Simulation(lv.Scene("stack", n=3))
    path = tmp_path / "state"
    sim.save(path)
    others = [{"n": 4}, {"friction": 0.3}, {"friction_shape": "box"}, {"mass": 2.0}]
    for other in others:
        with pytest.raises(lv.InputError, match="another scene"):
            lv.Simulation(lv.Scene("stack", **{"n": 3, **other})).load(path)
    data = path.read_bytes()
    cut, *flipped = (
        data[:-40],
        *(data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :] for k in (5, len(data) // 2, -33)),
    )
    for bad in (cut, *flipped):
        path.write_bytes(bad)
        with pytest.raises(lv.InputError, match=r"does not begin as a snapshot|damaged"):
            sim.load(path)
    # What is cut or lengthened inside a file whose checksum is right.
    end = len(MAGIC) + 8 + int.from_bytes(data[len(MAGIC) : len(MAGIC) + 8], "little")
    header = json.loads(data[len(MAGIC) + 8 : end])
    arrays = data[end:-32]
    said = header["lengths"]
    for lengths, rest in (
        (said, arrays[:-8]),
        (said, arrays + bytes(8)),
        ([*said[:3], said[3] - 1], arrays[:-8]),
        ([said[0] - 1, *said[1:]], arrays[4:]),
        ([*said[:3], -1], arrays),
        ([10**30, *said[1:]], arrays),
        ([*said[:3], float(said[3])], arrays),
    ):
        head = json.dumps({**header, "lengths": lengths}).encode()
        body = MAGIC + len(head).to_bytes(8, "little") + head + rest
        path.write_bytes(body + hashlib.sha256(body).digest())
        with pytest.raises(lv.InputError, match=r"do not match its header|size has 9 entries"):
            sim.load(path)
    shot = sim.snapshot()
    for name in ("real", "index", "keys"):
        with pytest.raises(lv.InputError, match="do not have the sizes"):
            sim.restore(replace(shot, **{name: getattr(shot, name)[:-1]}))
    with pytest.raises(lv.InputError, match="its sizes differ from the sizes of this scene"):
        sim.restore(
            replace(lv.Simulation(lv.Scene("stack", n=4)).snapshot(), fingerprint=shot.fingerprint)
        )
    alone = lv.Scene()  # no pair, no contact: arrays of one entry or none
    alone.add_sphere()
    one = after(2, alone)
    one.save(path)
    one.load(path)


@pytest.mark.parametrize("rolling", [0.0, 0.01])
@pytest.mark.parametrize(
    "name", [n for n in lv.available(external=False) if "cone" in lv.get(n).laws or n == "pgs"]
)
def test_scene_step_by_any_registered_solver_runs(name, rolling):
    sim = lv.Simulation(
        lv.Scene("stack", n=3, solver=name, solver_iterations=2000, rolling_radius=rolling)
    )
    for _ in range(30):
        observation, *_, info = sim.step()
    assert sim.last_solution.solver.name == name
    assert info["failed_solves"] == 0
    assert observation["solver"][0] == 2000 and observation["solver"][3] == 12
    # tol 1e-6 of gravity's 0.08 m/s per step leaves the boxes still.
    assert np.abs(observation["velocities"]).max() < 1e-4


@pytest.mark.parametrize("policy", ["use", "keep", "damp", "raise"])
def test_step_after_a_failed_solve_follows_on_failure(policy):
    # One sweep of pgs cannot reach 1e-6 on six boxes.
    sim = lv.Simulation(lv.Scene("stack", solver="pgs", solver_iterations=1, on_failure=policy))
    sim.state.head[HEAD["warm_start"]] = 1
    if policy == "raise":
        twin = lv.Simulation(lv.Scene("stack", solver="pgs", solver_iterations=1, on_failure="use"))
        with pytest.raises(lv.SolveFailed, match="step 0"):
            sim.step()
        assert sim.steps == 0
        for name in ("x", "q", "v", "cache_key", "cache_impulse", "joint_impulse"):
            np.testing.assert_array_equal(sim.state.a[name], twin.state.a[name])
        # The same where a later substep fails.
        scene = lv.Scene(dt=0.2, substeps=4, solver="pgs", solver_iterations=1, on_failure="raise")
        scene.add_plane()
        scene.add_box(position=(0, 0, 0.62), quaternion=(1, 0.02, 0.03, 0))
        sim = lv.Simulation(scene)
        before = sim.state.copy()
        with pytest.raises(lv.SolveFailed):
            sim.step()
        assert sim.state.head[HEAD["step"]] == 0
        for name in ("setting", "x", "q", "v", "cache_key", "cache_impulse", "joint_impulse"):
            np.testing.assert_array_equal(sim.state.a[name], before.a[name])
        return
    problem = sim.constraint_problem()
    found = lv.solve(problem, "pgs", max_iter=1).impulse
    observation, *_, info = sim.step()
    assert info["failed_solves"] == 1
    expected = {"use": found, "keep": problem.guess, "damp": 0.5 * (problem.guess + found)}[policy]
    np.testing.assert_array_equal(observation["contacts"]["impulses"].ravel(), expected)


def test_scene_residual_of_all_rows_is_that_of_the_judge():
    sim = lv.Simulation(
        lv.Scene("bridge", n=6, patch_radius=0.05, substeps=1), report_residual=True
    )
    for _ in range(50):
        problem = sim.constraint_problem()
        *_, info = sim.step()
    judged = lv.residual(
        problem, lv.solve(problem, "sequential_impulses", tol=0, max_iter=16).impulse
    )
    assert info["residual"]["relative"] == judged.relative
    assert info["residual"]["energy"] == judged.energy
    assert info["residual"]["worst"] == judged.worst_name
    share = info["residual"]["share"]
    assert set(share) == {"joint", "normal", "disk", "spin"}
    assert sum(share.values()) == pytest.approx(1.0, abs=1e-12)  # four shares of one sum
    energy = problem.d * judged.error**2
    assert share["joint"] == pytest.approx(
        energy[: len(problem.rows.jac)].sum() / energy.sum(), rel=1e-12
    )


def test_shares_of_the_residual_of_rolling_contacts_are_those_of_numpy():
    scene = lv.Scene(rolling_radius=0.03, patch_radius=0.02, substeps=1)
    scene.add_plane()
    for i in range(6):
        scene.add_sphere(
            0.2, position=(0.1 * i, 0.2 * i % 0.3, 0.2 + 0.3 * i), angular_velocity=(1.0, 2.0, 3.0)
        )
    sim = lv.Simulation(scene, report_residual=True)
    for _ in range(40):
        problem = sim.constraint_problem()
        observation, *_, info = sim.step()
    energy = (
        problem.d * lv.residual(problem, observation["contacts"]["impulses"].ravel()).error ** 2
    )
    sums = energy.reshape(-1, 6).sum(axis=0) / energy.sum()
    expected = {
        "joint": 0.0,
        "normal": sums[0],
        "disk": sums[1:3].sum(),
        "spin": sums[3],
        "rolling": sums[4:].sum(),
    }
    assert (
        info["residual"]["share"] == pytest.approx(expected, rel=1e-9) and expected["rolling"] > 0.0
    )


def test_recorded_problems_are_the_problems_of_the_steps(tmp_path):
    sim, twin = (lv.Simulation(lv.Scene("ramp")) for _ in range(2))
    paths = sim.record(tmp_path / "ramp", 3)
    assert [p.name for p in paths] == ["ramp-1.npz", "ramp-2.npz", "ramp-3.npz"]
    from lavender.io import load

    for path in paths:
        assert load(path) == twin.constraint_problem()
        twin.step()
    assert sim.steps == 3
    with pytest.raises(lv.UnknownName, match="form"):
        sim.record(tmp_path, 1, form="csv")
    chain = lv.Simulation("chain")
    pytest.importorskip("h5py")
    assert sim.record(tmp_path / "fclib", 1, form="fclib")[0].suffix == ".hdf5"
    with pytest.raises(lv.CapabilityError):  # joints
        chain.record(tmp_path / "joints", 1, form="fclib")
    assert chain.steps == 0
    mixed = lv.Scene(friction=0.5)
    mixed.add_plane()
    mixed.add_box((1, 1, 1), mass=1, position=(0, 0, 0.5))
    mixed.add_sphere(
        0.3, mass=1.0, position=(5, 0, 0.42), friction=0.0
    )  # falls: a contact of one row beside those of three
    later = lv.Simulation(mixed)
    with pytest.raises(lv.CapabilityError, match="contacts of 1, 3 rows"):
        later.record(tmp_path / "later", 60, form="fclib")
    assert later.steps == len(list((tmp_path / "later").iterdir())) > 0  # that step is not done
    (tmp_path / "file").write_text("")
    with pytest.raises(lv.InputError, match="is not a folder"):
        sim.record(tmp_path / "file", 1)


@pytest.mark.parametrize(
    ("parameters", "order"),
    [
        ({}, "alternating"),
        *(({"order": order}, order) for order in SCENE_ORDERS),
        ({"solver": "pgs"}, "given"),
        ({"solver": "pgs", "solver_options": {"order": "reverse"}}, "reverse"),
        ({"solver": "newton"}, None),
    ],
)
def test_step_reports_the_order_of_its_sweeps(parameters, order):
    sim = lv.Simulation(lv.Scene("stack", n=2, **parameters))
    assert sim.reset()[1]["order"] == sim.step()[-1]["order"] == order
    if sim.last_solution is not None:
        assert sim.last_solution.solver.order == (order or "")


@pytest.mark.parametrize("solver", ["newton", "auto", "pgs"])
def test_every_step_meets_the_velocity_error_that_the_scene_requires(solver):
    sim = lv.Simulation(lv.Scene("pile", n=4, solver=solver, solver_options={"velocity_tol": 1e-6}))
    judged = []
    for _ in range(40):
        sim.step()
        if sim.last_solution is not None:
            judged.append(sim.last_solution.residual.velocity)
            assert sim.last_solution.velocity_tol == 1e-6 and sim.last_solution.success
    assert len(judged) > 5 and max(judged) <= 1e-6
