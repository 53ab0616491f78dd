"""Doors: another engine's memory, numbers at the end of float64, words of the command line; as plain data."""

import functools
import os
import tempfile

import folders
import hypothesis.strategies as st
import numpy as np
import problems

import lavender as lv
from lavender import io

WHAT = ("memory", "memory", "far", "far", "command")
INDICES = ("efc_id", "efc_type", "efc_J_colind", "efc_J_rowadr", "efc_J_rownnz", "dim", "geom", "M_colind", "M_rowadr",
           "M_rownnz")  # fmt: skip
NUMBERS = ("efc_J", "efc_R", "efc_D", "efc_aref", "efc_force", "efc_frictionloss", "efc_vel", "efc_b", "qacc",
           "qacc_smooth", "qfrc_smooth", "qfrc_constraint", "qvel", "M")  # fmt: skip
OPTIONS = ("jacobian", "cone", "timestep", "integrator", "noslip_iterations", "nefc", "ncon", "nJ")
WHOLE = (-1, -2, 0, 1, 2, 3, 5, 7, 100, 2**15, 2**20, 2**30, 2**31 - 1, -(2**31))
REAL = (0.0, -0.0, 1.0, -1.0, 1e300, -1e300, 1e-300, "nan", "inf", "-inf")
WORDS = (
    ("report", "two_particles", "--workers", "{}"),
    ("report", "granular", "--workers", "1", "--seeds", "0:{}"),
    ("solve", "random_spd(n={})"), ("solve", "two_particles", "--tol", "{}"),
    ("solve", "two_particles", "--max-iter", "{}"), ("solve", "two_particles", "--time-limit", "{}"),
    ("check", "two_particles", "--tol", "{}", "--solvers", "pgs"), ("view", "{}"), ("record", "{}", "--out", "{}"),
)  # fmt: skip
ASKED = ("0", "-1", "-2", "1000000000", "1000000000000", "1e400", "nan", "", "a", "10000000", "1:", "0x10")
TOLD = ("kinetic", "energy", "speed", "spin", "rows", "bound", "bound_speed", "bound_spin", "moved", "spread",
        "spread_speed")  # fmt: skip


def door_specs():
    """What is done at which door."""
    pick = st.sampled_from
    edits = st.one_of(
        memory_edits(INDICES, WHOLE), memory_edits(NUMBERS, REAL), memory_edits(OPTIONS, WHOLE + REAL)
    )
    words = st.tuples(pick(WORDS), pick(ASKED)).map(lambda x: [word.format(x[1]) for word in x[0]])
    fields = {
        "memory": {"model": st.integers(0, 11), "edits": st.lists(edits, min_size=1, max_size=3)},
        "far": {"problem": problems.parts(8), "exponent": st.integers(-1070, 1020)},
        "command": {"words": words},
    }
    common = {"kind": st.just("door"), "seed": st.integers(0, 10**6)}
    return st.one_of(*(st.fixed_dictionaries({"what": st.just(w), **common, **fields[w]}) for w in WHAT))


def memory_edits(names, values):
    """Name, places (shares of the length) and value of a change."""
    places = st.lists(st.integers(0, 999), min_size=1, max_size=20)
    return st.tuples(st.sampled_from(names), places, st.sampled_from(values))


def check(spec):
    """What was broken."""
    yield from {"memory": memory, "far": far, "command": command}[spec["what"]](spec)


# -- another engine's memory ------------------------------------------------------------------------------------


@functools.cache
def model(number):
    """A small MuJoCo model by number."""
    import mujoco as mj

    rng = np.random.default_rng(number)
    cone, jacobian = ("elliptic", "pyramidal")[number % 2], ("dense", "sparse")[number // 2 % 2]
    condim = (3, 4, 6, 1)[number % 4]
    links = "".join(
        f'<body pos="0.2 0 0"><joint type="{rng.choice(["hinge", "slide"])}" axis="{rng.normal()} 1 0.3"'
        ' frictionloss="0.1" limited="true" range="-0.2 0.2"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".04"/>'
        for _ in range(3)
    )
    boxes = "".join(
        f'<body name="b{k}" pos="{0.15 * k} 3 {0.1 + 0.15 * k}"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
        for k in range(3)
    )
    made = mj.MjModel.from_xml_string(
        f'<mujoco><option cone="{cone}" jacobian="{jacobian}"/>'
        f'<default><geom condim="{condim}" friction="0.7 0.01 0.001"/></default>'
        f'<worldbody><geom type="plane" size="0 0 1"/>{boxes}<body pos="0 0 1">{links}{"</body>" * 3}</body>'
        '</worldbody><equality><connect body1="b2" anchor="0 0 .2"/></equality></mujoco>'
    )
    data = mj.MjData(made)
    data.qvel[:] = 0.3 * rng.normal(size=made.nv)
    for _ in range(20):
        mj.mj_step(made, data)
    return mj, made, data.qpos.copy(), data.qvel.copy()


def memory(spec):
    """Changed data are refused, or are a problem of finite numbers; the process lives."""
    try:
        mj, made, qpos, qvel = model(spec["model"])
    except ImportError:
        return
    data = mj.MjData(made)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mj.mj_forward(made, data)
    right = io.from_mujoco(made, data)
    before = {name: np.array(getattr(made, name)) for name in INDICES if name.startswith("M_")}
    options = {name: getattr(made.opt, name) for name in OPTIONS if hasattr(made.opt, name)}
    try:
        for edit in sorted(
            spec["edits"], key=lambda e: e[0] in ("nefc", "ncon", "nJ")
        ):  # nobody writes behind those
            change(made, data, *edit)
        for read in (io.from_mujoco, io.mujoco.jacobian, io.mujoco.scaling, io.mujoco.impulse, named):
            try:
                found = read(made, data)
            except lv.LavenderError:
                continue
            if isinstance(found, lv.Problem) and not np.isfinite(found.b).all():
                yield "wrong number", "a problem from changed memory is not finite"
            if (
                isinstance(found, lv.Problem)
                and not any(map(another, spec["edits"]))
                and not alike(found, right)
            ):
                yield "wrong number", f"another problem from memory with {spec['edits'][0][0]} changed"
    finally:
        for name, values in before.items():
            getattr(made, name)[:] = values
        for name, value in options.items():
            setattr(made.opt, name, value)


def another(edit):
    """Whether a change may make another problem that is one: an option, a bound, a number of what is there.

    An entry of M or J that nothing moves or pushes has made nothing that it could be held to.
    """
    name, _, value = edit
    there = name in ("efc_id", "efc_type", "dim") and 0 <= value < 100
    return name in OPTIONS or name in ("efc_frictionloss", "efc_J", "M") or there


def alike(found, right):
    """The same but for rounding."""
    if found.cones != right.cones:
        return False
    of = [(p.b, p.compliance, p.generalized.v_free, p.jacobian.toarray(), p.generalized.mass.toarray())
          for p in (found, right)]  # fmt: skip
    return all(np.allclose(x, y, rtol=1e-5, atol=1e-6) for x, y in zip(*of, strict=True))


def named(made, data):
    """The names of the blocks, which are made late."""
    return list(io.from_mujoco(made, data).names)


def change(made, data, name, places, value):
    """Write a value; what the engine does not let be written stays."""
    value = float(value) if isinstance(value, str) else value
    try:
        if name in OPTIONS:
            holder = data if name in ("nefc", "ncon", "nJ") else made.opt
            setattr(holder, name, type(getattr(holder, name))(value))
            return
        holder = made if name.startswith("M_") else data.contact if name in ("dim", "geom") else data
        array = np.asarray(getattr(holder, name)).reshape(-1)
        for place in places if array.size else ():
            array[place * array.size // 1000] = value
    except (TypeError, ValueError, OverflowError, AttributeError):
        return


# -- the end of float64 --------------------------------------------------------------------------------------------


def far(spec):
    """Motion errors are finite, or `note` says why there is none; at any impulse, and at the answer of auto."""
    problem = problems.build(spec["problem"])
    answer = lv.solve(problem).impulse
    for x in (np.full(problem.m, 2.0 ** spec["exponent"]), answer):
        if not np.isfinite(x).all():
            continue
        error = lv.motion_error(problem, x)
        values = {name: getattr(error, name) for name in TOLD}
        beyond = [name for name, value in values.items() if value is not None and not np.isfinite(value)]
        if beyond or (error.relative is not None and not np.isfinite(error.relative) and not error.note):
            yield "wrong number", f"not finite and not told: {beyond}"
        str(error)
    if problem.m and problem.is_symmetric:
        found = lv.redundancy(problem)
        if not 0 <= found.rank == problem.m - len(found.rows):
            yield "wrong number", f"rank {found.rank}"


# -- the command line ----------------------------------------------------------------------------------------------


def command(spec):
    """A documented status and no traceback, whatever number is asked for."""
    if (
        spec["words"][:2] in (["report", "two_particles"], ["report", "granular"])
        and spec["words"][-1].strip("0:-") == "1"
    ):
        return  # which starts processes
    with tempfile.TemporaryDirectory() as root:
        here = os.getcwd()
        os.chdir(root)
        try:
            code, text = folders.quiet(spec["words"])
        finally:
            os.chdir(here)
    yield from folders.told(code, text, " ".join(spec["words"][:2]))
