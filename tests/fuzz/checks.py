"""What is promised of one input: each check takes a spec and gives what was broken, as (what, detail).

What lavender refuses, it refuses by an error of its own (`LavenderError`); all other exceptions are findings, and
so are warnings that reach the caller.
"""

import base64
import contextlib
import faulthandler
import hashlib
import json
import math
import os
import resource
import signal
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import doors
import files
import folders
import judge_twin
import numpy as np
import problems
import promises
import scenes

import lavender as lv

REFUSED = (lv.LavenderError,)
COUNTS = {"refused": 0}  # inputs that lavender refused
# Below this, numbers on the way are far from the edges of float64, and both judges must say the same.
MODERATE = 90.0


def run(spec):
    """Findings of one input, by its kind."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found = []
        try:
            found = list(CHECKS[spec["kind"]](spec))
        except REFUSED:
            COUNTS["refused"] += 1
        except MemoryError as error:
            found = [("overrun", f"memory: {place(error)}")]
        except Exception as error:
            found = [(f"raw {type(error).__name__}", place(error))]
        for warning in heard[:1]:
            name = os.path.basename(warning.filename)
            found.append(("warning", f"{spec.get('solver', '')} {name}:{warning.lineno}: {warning.message}"))
        return found


def watch(spec, path, limit):
    """Write an input to a file; end the process if checking it takes more than `limit` seconds of processor time."""
    Path(path).write_text(json.dumps(spec), encoding="utf-8")
    faulthandler.register(signal.SIGXCPU, all_threads=True, chain=True)
    end = int(time.process_time() + limit) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (end, resource.RLIM_INFINITY))


def place(error):
    """Message, and where: the last frame inside the packages."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "/lavender" in f.filename and "/tests/" not in f.filename] or frames
    where = f"{os.path.basename(own[-1].filename)}:{own[-1].name}"
    return f"{where}: {type(error).__name__}: {str(error)[:300]}"


# -- solves ----------------------------------------------------------------------------------------------------


def bits(solution):
    """Everything that must be the same again."""
    r = solution.residual
    numbers = np.array([r.relative, r.energy, r.velocity, r.floor])
    return (
        solution.impulse.tobytes(),
        solution.slack.tobytes(),
        numbers.tobytes(),
        solution.status.name,
        solution.iterations,
        tuple(sorted(solution.work.items())),
    )


def data_of(problem):
    """Hash of everything a solver could have changed."""
    out = hashlib.sha256()
    c, parts = problem.cones, [problem.b, problem.d, problem.guess]
    parts += [c.ptr, c.kind, c.lower, c.upper, c.mu, c.patch_radius, c.rolling]
    if problem.generalized is None:
        a = problem.csr
        parts += [a.indptr, a.indices, a.data]
    else:
        for x in (problem.jacobian, problem.generalized.mass):
            parts += [x.indptr, x.indices, x.data] if hasattr(x, "indptr") else [x]
        parts.append(problem.generalized.v_free)
    for x in parts:
        if x is not None:
            out.update(np.ascontiguousarray(x).tobytes())
    return out.digest()


def check_solve(spec):
    problem = problems.build(spec["problem"])
    try:
        yield from solved(spec, problem)
    except lv.InputError as error:  # a problem that was taken has nothing wrong with it
        if spec["options"].get("time_limit") == 0.0:
            raise
        yield "late refusal", f"{spec['solver']}: {place(error)}"


def solved(spec, problem):
    """Solved, once or in every way that gives the same, and judged."""
    options = spec["options"]
    if spec["solver"] == "lemke" and not any(problem.cones.kind):
        problem.csr  # noqa: B018 - formed before it is compared
    before = data_of(problem) if spec["again"] else None
    if spec.get("prepared"):
        mine = {k: v for k, v in options.items() if k in ("order", "seed")}
        rest = {k: v for k, v in options.items() if k not in mine}
        prepared = lv.prepare(problem, spec["solver"], **mine)
        first = prepared.solve(**rest)
        solution = prepared.solve(problem, **rest)
        if "time_limit" not in options and bits(first) != bits(solution):
            yield "changed bits", f"{spec['solver']}: solved twice by one Prepared"
    else:
        solution = lv.solve(problem, spec["solver"], **options)
    yield from claims(spec, problem, solution)
    if "others" in spec:
        yield from together(spec, problem, solution)
    if spec["again"]:
        yield from states(spec, problem, solution)
        if data_of(problem) != before:
            yield "changed data", f"{spec['solver']} changed the problem that it was given"
        if "time_limit" not in options:
            fresh = lv.solve(problems.build(spec["problem"]), spec["solver"], **options)
            if bits(fresh) != bits(solution):
                yield "changed bits", f"{spec['solver']}: solved twice"


def together(spec, problem, solution):
    """The same structure with other right sides: solved in one call as one by one, and each claim is judged."""
    options = dict(spec["options"])
    start = options.pop("impulse", None)
    taken = []
    for b in spec["others"]:
        with contextlib.suppress(lv.InputError):  # numbers that the door refuses, it refuses here, too
            taken.append((b, problem.updated(b=np.array(b, float))))
    problems_of = [problem, *(other for _, other in taken)]
    starts = None if start is None else [start] * len(problems_of)
    many = lv.solve_many(problems_of, spec["solver"], impulses=starts, threads=spec["threads"], **options)
    if bits(many[0]) != bits(solution):
        yield "changed bits", f"{spec['solver']}: solve_many and solve"
    for (b, other), found in zip(taken, many[1:], strict=True):
        if bits(lv.solve(other, spec["solver"], **spec["options"])) != bits(found):
            yield "changed bits", f"{spec['solver']}: solve_many and solve, other right side"
        yield from claims({**spec, "problem": {**spec["problem"], "b": b}}, other, found)


def claims(spec, problem, solution):
    """Status, success and numbers against the judge in long double."""
    name, status, r = spec["solver"], solution.status.name, solution.residual
    budget = spec["options"].get("max_iter", lv.get(name).max_iter)
    if solution.iterations > budget and not lv.get(name).external:  # those count in their own way
        yield "overrun", f"{name}: {solution.iterations} iterations of {budget}"
    if (
        status == "MAX_ITERATIONS"
        and spec["options"]["tol"] == 0.0
        and solution.iterations != budget
        and lv.get(name).resumable
    ):
        yield "overrun", f"{name}: {solution.iterations} iterations where {budget} were asked for"
    if solution.claim_check != "confirmed" and not lv.get(name).external:
        yield "contradicted", f"{name}: {solution.claim_check}, {solution.status_conflict}"
    finite = bool(np.isfinite(solution.impulse).all())
    if not finite and status not in ("DIVERGED", "NUMERICAL_ERROR"):
        yield "false claim", f"{name}: {status} with an impulse that is not finite"
    for what in ("relative", "energy", "velocity", "floor"):
        if math.isnan(getattr(r, what)):
            yield "false claim", f"{name}: {what} is NaN"
    accepted = True
    try:
        solution.raise_for_status()
    except lv.SolveFailed:
        accepted = False
    claimed = solution.success or accepted or status in ("CONVERGED", "FLOOR", "INFEASIBLE")
    wanted = claimed or spec["again"]
    if not wanted:
        return
    twin = judge_twin.Problem(spec["problem"])
    j = twin.judge(solution.impulse)
    slop = 1.0 + 1e-6
    if status == "INFEASIBLE" and solution.claim_check == "confirmed":
        if solution.success:
            yield "false claim", f"{name}: INFEASIBLE and success"
        if solution.certificate is None:
            yield "false claim", f"{name}: INFEASIBLE without a certificate"
        else:
            wrong = twin.refutes(solution.certificate)
            if wrong:
                yield "false claim", f"{name}: INFEASIBLE, {wrong}"
    if j.nothing or twin.d_edge:
        return
    first = min(j.unrefined, 0.1 * max(solution.tol, j.relative))  # of a pass that need not be refined
    within = solution.tol * slop + j.allowed + first
    floor = 2.0 * max(j.floor, min(r.floor, j.floor_most)) * slop + j.allowed + first
    if (
        solution.success or (status == "CONVERGED" and solution.claim_check == "confirmed")
    ) and not j.relative <= within:
        yield (
            "false claim",
            f"{name}: {status}, success {solution.success}, relative {r.relative:.3e}, in long double {j.relative:.3e}",
        )
    if ((status == "FLOOR" and solution.claim_check == "confirmed") or accepted) and not j.relative <= max(
        within, floor
    ):
        found = f"relative {r.relative:.3e} floor {r.floor:.3e}, in long double {j.relative:.3e}"
        yield "false claim", f"{name}: {status} accepted, {found}"
    if (status == "FLOOR" or (accepted and not solution.success)) and not (
        r.relative <= 1e-5 and math.isfinite(r.floor)
    ):
        yield "false claim", f"{name}: {status} accepted with relative {r.relative} and floor {r.floor}"
    if finite and j.range < MODERATE:
        both_infinite = r.relative == j.relative == math.inf  # zero impulses solve it, these do not
        if not (both_infinite or abs(r.relative - j.relative) <= 1e-6 * j.relative + j.allowed + first):
            yield (
                "wrong number",
                f"{name}: relative {r.relative:.6e}, in long double {j.relative:.6e}, {j.allowed:.1e} allowed",
            )
        if not abs(problem.disk.d - np.array(twin.d, float)).max(initial=0.0) <= 1e-6 * float(
            np.abs(twin.d).max(initial=0)
        ):
            yield "wrong number", f"{name}: d"


def states(spec, problem, solution):
    """Blocks in another state at a tighter answer, and errors beyond their bounds, if the solution is unique."""
    own = solution.states
    if not (own.tolerance >= 0.0).all() or own.unknown != tuple(np.flatnonzero(np.isinf(own.tolerance))):
        yield "wrong number", f"{spec['solver']}: bounds of errors {own.tolerance}"
    if problem.m == 0 or problem.law == "coulomb" or not problem.is_semidefinite:
        return
    other = lv.solve(problem, tol=1e-13)
    tight = other.states
    with np.errstate(all="ignore"):  # impulses that are not finite
        off = problem.on_disk(solution.impulse - other.impulse)
        error = np.sqrt(np.add.reduceat(off**2, problem.cones.ptr[:-1]))
        beyond = error > (own.tolerance + tight.tolerance) * (1.0 + 1e-9)
    if beyond.any():
        yield "false claim", f"{spec['solver']}: an error of {error[beyond]} within {own.tolerance[beyond]}"
    for i in set(range(len(own))) - set(own.boundary) - set(tight.boundary):
        if own.names[i] != tight.names[i]:
            yield "false claim", f"{spec['solver']}: '{own[i]}' is '{tight[i]}' at a tighter answer"


# -- files -----------------------------------------------------------------------------------------------------

FOLDER = tempfile.TemporaryDirectory(prefix="fuzz-")


def check_file(spec):
    path = Path(FOLDER.name, f"{os.getpid()}{spec['suffix']}")
    path.write_bytes(base64.b64decode(spec["data"]))
    try:
        stored = lv.io.read(path, max_bytes=spec.get("max_bytes", 10**7))
    except REFUSED as error:
        if str(path) not in str(error):
            yield "unnamed file", str(error)
        COUNTS["refused"] += 1
        return
    problem = stored.problem
    for x in (problem.b, problem.cones.mu, *stored.guesses):
        if not np.isfinite(x).all():
            yield "bad problem", "a number that is not finite"
    if stored.impulse is not None and len(stored.impulse) != problem.m:
        yield "bad problem", "an impulse of another length"
    if problem.m <= 200:
        for solver in ("auto", "pgs"):
            if lv.get(solver).refuses(problem) is None:
                lv.solve(problem, solver, max_iter=20)


# -- engine ----------------------------------------------------------------------------------------------------


def check_steps(spec):
    scene = scenes.build(spec)
    found, first = play(scene, spec)
    yield from found
    if spec["again"] and play(scenes.build(spec), spec, quiet=True)[1] != first:
        yield "changed bits", "stepped twice, without looking between steps"


def play(scene, spec, quiet=False):
    """Findings, and a hash of all that was seen; `quiet` leaves out what must change nothing."""
    simulation = lv.Simulation(scene)
    seen, found = hashlib.sha256(), []
    kept = None
    for action in spec["actions"]:
        word = action[0]
        if word == "step":
            for _ in range(action[1]):
                try:
                    observation, _, terminated, _, info = simulation.step()
                except REFUSED as error:
                    seen.update(type(error).__name__.encode())
                    return found, seen.digest()
                look(observation, terminated, info, found)
                for key in ("positions", "quaternions", "velocities", "joint_impulses", "solver"):
                    seen.update(observation[key].tobytes())
                seen.update(observation["contacts"]["impulses"].tobytes())
                if terminated:
                    if spec.get("lasts"):
                        found.append(
                            ("false claim", f"{info['lost_body']} is lost, which nothing throws away")
                        )
                    return found, seen.digest()
        elif not (quiet and word in CHANGES_NOTHING):
            try:
                kept = do(simulation, word, action, kept)
            except REFUSED:
                if word not in CHANGES_NOTHING:
                    raise
    return found, seen.digest()


CHANGES_NOTHING = ("file", "problem", "residual")


def do(simulation, word, action, kept):
    """One action beside steps; returns the snapshot that is kept."""
    if word == "sweeps":
        simulation.set_solver_iterations(action[1])
    elif word == "warm":
        simulation.set_warm_start(bool(action[1]))
    elif word == "snapshot":
        return simulation.snapshot()
    elif word == "restore" and kept is not None:
        simulation.restore(kept)
    elif word == "file":
        path = Path(FOLDER.name, f"{os.getpid()}.state")
        simulation.save(path)
        simulation.load(path)
    elif word == "problem":
        problem = simulation.constraint_problem()
        if problem.m:
            lv.solve(problem, "sequential_impulses", max_iter=4)
    elif word == "residual":
        simulation.residual()
    elif word in ("reset", "reseed"):
        simulation.reset(*action[1:])
        return None  # a scene that seeds shake is another one
    return kept


def look(observation, terminated, info, found):
    """Numbers that are not finite are told by `terminated`, in the step in which they appear."""
    state = [observation[key] for key in ("positions", "quaternions", "velocities")]
    finite = all(bool(np.isfinite(x).all()) for x in state)
    if not finite and not terminated:
        found.append(("false claim", "the state is not finite, without terminated"))
    if not terminated:
        for key in ("solver", "joint_impulses"):
            if not np.isfinite(observation[key]).all():
                found.append(("false claim", f"{key} holds a number that is not finite, without terminated"))
        q = observation["quaternions"]
        with np.errstate(all="ignore"):
            lengths = np.einsum("ij,ij->i", q, q)
        if len(q) and not (np.abs(lengths - 1.0).max() < 1e-9):
            found.append(("false claim", "a quaternion that is not of unit length, without terminated"))
    elif "lost_body" not in info:
        found.append(("false claim", "terminated, and no body is named"))


def check_snapshot(spec):
    simulation = lv.Simulation(lv.Scene(spec["name"], **spec["parameters"]))
    for _ in range(spec["steps"]):
        simulation.step()
    path = Path(FOLDER.name, f"{os.getpid()}.snapshot")
    simulation.save(path)
    path.write_bytes(scenes.tampered(path.read_bytes(), spec))
    simulation.load(path)
    for _ in range(4):  # what a forged state says of itself is not promised; that nothing breaks is
        try:
            terminated = simulation.step()[2]
        except REFUSED:
            return ()
        if terminated:
            return ()
    simulation.constraint_problem()
    return ()


# -- folders ---------------------------------------------------------------------------------------------------


def check_folder(spec):
    yield from folders.check(spec)


def check_door(spec):
    yield from doors.check(spec)


# -- promises --------------------------------------------------------------------------------------------------


def check_promise(spec):
    yield from promises.check(spec, COUNTS)


CHECKS = {
    "solve": check_solve,
    "file": check_file,
    "steps": check_steps,
    "snapshot": check_snapshot,
    "folder": check_folder,
    "door": check_door,
    "promise": check_promise,
}
INPUTS = {
    "solve": problems.solve_specs(),
    "file": files.file_specs(),
    "steps": scenes.scene_specs(),
    "snapshot": scenes.snapshot_specs(),
    "folder": folders.folder_specs(),
    "door": doors.door_specs(),
    "promise": promises.promise_specs(),
}
