"""Invalid input of the engine: scenes, snapshots, threads and Ctrl-C; the engine refuses, or makes whole steps."""

import hashlib
import threading
from dataclasses import replace
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
from extreme_problems import SPECIAL
from hypothesis import given, reject
from worked import after

import lavender as lv
from lavender.sim.engine import check


def trajectory(sim, steps):
    """Return the bytes of the positions after each step."""
    return [sim.step()[0]["positions"].tobytes() for _ in range(steps)]


real = st.floats(-4.0, 4.0, allow_subnormal=False) | st.sampled_from(
    [s * x for x in SPECIAL for s in (1.0, -1.0)]
)
positive = real.map(lambda x: abs(x) or 1.0)
size = st.sampled_from((0.0, 1e-60, 1e-12, 1e-3, 0.1, 0.5, 1.0, 10.0, 1e8, 1e30, 1e60))
vector = st.lists(real, min_size=3, max_size=3) | st.lists(
    st.floats(-4.0, 4.0), min_size=3, max_size=3
)
GALLERY = {
    "stack": {"n": 3},
    "pyramid": {"base": 3},
    "card_house": {},
    "pile": {"n": 12},
    "chain": {"n": 6},
    "bridge": {"n": 4},
    "heavy_on_light": {},
    "table": {"legs": 4},
    "ramp": {},
    "spinner": {},
    "newtons_cradle": {},
    "four_bar": {},
}
SOLVERS = [name for name in lv.available(external=False) if {"coulomb"} <= lv.get(name).laws]
ORDERS = ("given", "reverse", "symmetric", "random", "colored", "bottom_up", "top_down")
PARAMETERS = st.fixed_dictionaries(
    {},
    optional={
        "seed": st.integers(0, 3),
        "dt": st.sampled_from((1e-60, 1e-9, 1e-3, 0.1, 1.0, 1e6, 1e60)),
        "substeps": st.sampled_from((1, 2, 4)),
        "restitution": st.sampled_from((0.0, 0.5, 1.0)),
        "gravity": vector,
        "position_iterations": st.sampled_from((0, 1, 20)),
        "warm_start": st.booleans(),
        "friction": size,
        "patch_radius": size,
        "slop": size,
        "margin": size,
        "restitution_threshold": size,
    },
)
HOW_SOLVED = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"order": st.sampled_from(ORDERS)}),
    st.fixed_dictionaries(
        {
            "solver": st.sampled_from(SOLVERS),
            "solver_iterations": st.sampled_from((1, 10, 60)),
            "on_failure": st.sampled_from(("use", "keep", "damp", "raise")),
        }
    ),
)
MOTION = {
    "quaternion": st.lists(real, min_size=4, max_size=4),
    "inertia": st.lists(positive, min_size=3, max_size=3),
    "friction": size,
    "patch_radius": size,
    "velocity": vector,
    "angular_velocity": vector,
}
JOINT_OPTIONS = {
    "collide": st.booleans(),
    "hertz": st.sampled_from((0.0, 1e-9, 1.0, 1e9, 1e60)),
    "damping": st.sampled_from((0.0, 1.0, 1e60)),
}
MOTOR = {"motor_speed": real, "motor_torque": st.sampled_from((0.0, 1.0, 1e9, 1e60))}
SHAPES = {
    "body": {},
    "sphere": {"radius": positive},
    "box": {"size": st.lists(positive, min_size=3, max_size=3)},
}
UNCHANGING = ("save", "problem", "residual")  # Actions that change nothing.
ACTIONS = st.sampled_from(
    (
        *UNCHANGING,
        "few sweeps",
        "many sweeps",
        "cold",
        "warm",
        "snapshot",
        "restore",
        "reset",
        "seed",
    )
)


@st.composite
def bodies(draw):
    """Up to eight bodies, often at one place, perhaps on a plane."""
    place = draw(vector)
    planes = draw(st.sampled_from(([], [{"add": "plane"}], [{"add": "plane", "normal": place}])))

    def body(shape):
        fields = {"add": st.just(shape), "mass": positive, "position": st.just(place) | vector}
        options = MOTION if shape == "body" else {k: x for k, x in MOTION.items() if k != "inertia"}
        return st.fixed_dictionaries(fields | SHAPES[shape], optional=options)

    return planes + draw(
        st.lists(st.sampled_from(sorted(SHAPES)).flatmap(body), min_size=1, max_size=8)
    )


def joints(n):
    """Joints between two of n bodies or the world."""
    ends = {"a": st.integers(-1, n - 1), "b": st.integers(-1, n - 1)}
    kinds = (
        ("ball", {"anchor": vector}, {}),
        ("hinge", {"anchor": vector, "axis": vector}, MOTOR),
        ("distance", {"anchor_a": vector}, {"length": size}),
    )
    strategies = (
        st.fixed_dictionaries(
            {"kind": st.just(kind)} | ends | fields, optional=JOINT_OPTIONS | options
        )
        for kind, fields, options in kinds
    )
    return st.lists(st.one_of(*strategies), max_size=3)


@st.composite
def scenes(draw):
    """A scene as plain data, and what is done with it."""
    parameters = draw(PARAMETERS) | draw(HOW_SOLVED)
    data = {"parameters": parameters, "again": draw(st.integers(0, 3)) == 3}
    if draw(st.integers(0, 3)) == 3:
        data["name"] = draw(st.sampled_from(sorted(GALLERY)))
        parameters |= GALLERY[data["name"]]
    else:
        data["bodies"] = draw(bodies())
        data["joints"] = draw(joints(len(data["bodies"])))
    steps = st.integers(1, 10 if "solver" in parameters else 20)
    return data | {
        "actions": draw(st.lists(st.one_of(steps, steps, ACTIONS), min_size=1, max_size=8))
    }


def build_scene(data):
    """Build the scene of plain data; an error of the package if it is not valid."""
    scene = lv.Scene(data.get("name"), **data["parameters"])
    for body in data.get("bodies", ()):
        getattr(scene, f"add_{body['add']}")(**{k: x for k, x in body.items() if k != "add"})
    for joint in data.get("joints", ()):
        scene.add_joint(**joint)
    return scene


def act(simulation, action, snapshot, path):
    """Do one of ACTIONS; return the snapshot to restore."""
    if action in ("few sweeps", "many sweeps"):
        simulation.set_solver_iterations(4 if action == "few sweeps" else 64)
    elif action in ("cold", "warm"):
        simulation.set_warm_start(action == "warm")
    elif action == "snapshot":
        return simulation.snapshot()
    elif action == "restore" and snapshot is not None:
        simulation.restore(snapshot)
    elif action == "save":
        simulation.save(path)
        simulation.load(path)
    elif action == "problem":
        problem = simulation.constraint_problem()
        if problem.m:
            lv.solve(problem, "sequential_impulses", max_iter=4)
    elif action == "residual":
        simulation.residual()
    elif action in ("reset", "seed"):
        simulation.reset(*([5] if action == "seed" else []))
        return None  # It is another scene if the seed shakes it.
    return snapshot


def check_observation(observation, terminated, info):
    """Require finite numbers, or `terminated` and a body's name in the step in which one is not finite."""
    if terminated:
        assert "lost_body" in info
        return
    for key in ("positions", "quaternions", "velocities", "solver", "joint_impulses"):
        assert np.isfinite(observation[key]).all(), key
    q = observation["quaternions"]
    assert np.all(np.abs(np.einsum("ij,ij->i", q, q) - 1.0) < 1e-9)


def play(data, path, inspect=True):
    """Step a scene, with or without the actions that change nothing; return a hash of all observations."""
    simulation = lv.Simulation(build_scene(data))
    seen = hashlib.sha256()
    snapshot = None
    for action in data["actions"]:
        if isinstance(action, str):
            if inspect or action not in UNCHANGING:
                try:
                    snapshot = act(simulation, action, snapshot, path)
                except lv.LavenderError:
                    if action not in UNCHANGING:
                        raise
            continue
        for _ in range(action):
            try:
                observation, _, terminated, _, info = simulation.step()
            except lv.LavenderError as error:
                seen.update(type(error).__name__.encode())
                return seen.digest()
            check_observation(observation, terminated, info)
            for key in ("positions", "quaternions", "velocities", "joint_impulses", "solver"):
                seen.update(observation[key].tobytes())
            seen.update(observation["contacts"]["impulses"].tobytes())
            if terminated:
                assert not data.get("lasts"), f"{info['lost_body']} is lost"
                return seen.digest()
    return seen.digest()


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(data=scenes())
def test_extreme_scenes_stay_finite_or_terminate_and_inspection_changes_nothing(
    data, tmp_path_factory
):
    path = tmp_path_factory.getbasetemp() / "drawn.state"
    try:
        seen = play(data, path)
    except lv.LavenderError:
        reject()
    if data["again"]:
        assert play(data, path, inspect=False) == seen


def box(size, x=0.0, y=0.0, z=0.0, **more):
    return {
        "add": "box",
        "size": [size] * 3 if np.isscalar(size) else size,
        "mass": 1.0,
        "position": [x, y, z],
    } | more


def sphere(radius, x=0.0, z=0.0):
    return {"add": "sphere", "radius": radius, "mass": 1.0, "position": [x, 0.0, z]}


def tilted(angle):
    return [np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0]


PLANE = {"add": "plane"}
ON_BOX = [PLANE, box(1.0, z=0.5)]
#: Scenes from which nothing may be lost in 240 steps.
LASTING = {
    "on one place": [
        *[box(1.0)] * 5,
        *[sphere(0.5, 3.0)] * 3,
        sphere(0.5),
        {"add": "plane", "offset": 0.3},
    ],
    "flat boxes": [
        PLANE,
        *(
            b
            for i in range(4)
            for b in (
                box([1e-6, 1.0, 1.0], 0.1 * i, z=0.6, quaternion=tilted(0.1 * i)),
                box([1e-3, 1e-3, 10.0], 0.2 * i, 2.0, 5.0),
            )
        ),
    ],
    **{
        f"sizes of {x:g}": [*ON_BOX, sphere(0.5 * x, z=1.0 + 0.5 * x), box(x, 0.2, z=1.0 + x)]
        for x in (1e-6, 1e6)
    },
    **{f"masses of {x:g}": [*ON_BOX, box(1.0, z=1.5, mass=x)] for x in (1e-6, 1e6)},
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", LASTING)
def test_scenes_of_unlike_sizes_and_masses_lose_no_body(name, tmp_path):
    play(
        {"parameters": {}, "bodies": LASTING[name], "actions": [240], "lasts": True},
        tmp_path / "state",
    )


NUMBERS = {
    "real": st.sampled_from((*SPECIAL, float("nan"), float("inf"), -1.0, 1e9)),
    "keys": st.integers(0, 2**64 - 1),
    **dict.fromkeys(
        ("size", "index"),
        st.sampled_from((-(2**31), -1000, -1, 0, 1, 2, 7, 65536, 10**8, 2**31 - 1)),
    ),
}


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(
    name=st.sampled_from(sorted(GALLERY)),
    how=HOW_SOLVED,
    steps=st.integers(0, 6),
    edits=st.lists(
        st.sampled_from(("size", *["index"] * 3, "real", "keys")).flatmap(
            lambda name: st.tuples(st.just(name), st.integers(0, 10**6), NUMBERS[name])
        ),
        min_size=1,
        max_size=5,
    ),
)
def test_process_survives_a_snapshot_with_changed_arrays(name, how, steps, edits):
    """A changed state may compute anything, but it reads and writes only within its arrays."""
    simulation = after(steps, name, **GALLERY[name], **how | {"on_failure": "use"})
    shot = simulation.snapshot()
    arrays = {array: getattr(shot, array).copy() for array in NUMBERS}
    for array, place, value in edits:
        if len(arrays[array]):
            arrays[array][place % len(arrays[array])] = value
    try:
        simulation.restore(replace(shot, **arrays))
        for _ in range(4):
            if simulation.step()[2]:
                return
        simulation.constraint_problem()
    except lv.LavenderError:
        return


def test_every_array_of_a_snapshot_that_the_scene_gives_is_compared():
    # One bit of one entry changes, which no other check detects.
    sim = after(5, "bridge", n=4, patch_radius=0.1)
    for name in check.GIVEN:
        if not sim.state.a[name].size:
            continue
        state = sim.state.copy()
        state.a[name].reshape(-1).view(np.uint8)[0] ^= 1
        shot = sim.snapshot()
        bad = lv.Snapshot(
            shot.fingerprint, 5, 0, "", state.size, state.real, state.index, state.keys
        )
        before = sim.snapshot()
        with pytest.raises(lv.InputError, match=f"damaged: {name} "):
            sim.restore(bad)
        assert sim.snapshot().real.tobytes() == before.real.tobytes()


@pytest.mark.parametrize("inspects", [False, True])
def test_scene_steps_in_two_threads_wait_for_each_other(inspects):
    # Without the lock, eight of eight runs crashed. restore(snapshot()) of one thread may undo a step of another
    # between the two calls, so the bits are compared if each thread only steps.
    scene = lv.Scene("pile", n=60, kind="mixed", substeps=2)
    sim, twin = lv.Simulation(scene), lv.Simulation(scene)

    def work():
        for i in range(60):
            sim.step()
            if inspects and i % 10 == 0:
                sim.constraint_problem(), sim.residual(), sim.restore(sim.snapshot())

    threads = [threading.Thread(target=work) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    if not inspects:
        trajectory(twin, 180)
        assert sim.steps == 180 and sim.snapshot().real.tobytes() == twin.snapshot().real.tobytes()


@pytest.fixture
def caller(plug_in):
    """Register a solver that calls `now` in run number `at`; return both and the number of runs."""

    def make(now, at, **more):
        plan = SimpleNamespace(now=now, at=at, runs=0)

        def run(problem, impulse):
            plan.runs += 1
            claim = plan.now() if plan.runs == plan.at else None
            return claim or lv.Claim(lv.Status.MAX_ITERATIONS, 1)

        plug_in(run, "caller", supports_rolling=True, **more)
        return plan

    return make


def stop():
    raise KeyboardInterrupt


@pytest.mark.parametrize("at", [1, 3])
def test_ctrl_c_in_any_substep_restores_the_state_before_the_step(caller, at):
    plan = caller(stop, 0)
    scene = lv.Scene("bridge", n=4, solver="caller", substeps=3, solver_iterations=1)
    sim, twin = lv.Simulation(scene), lv.Simulation(scene)
    trajectory(sim, 3), trajectory(twin, 3)
    plan.at = plan.runs + at
    with pytest.raises(KeyboardInterrupt):
        sim.step()
    assert sim.steps == 3 and trajectory(sim, 4) == trajectory(twin, 4)
