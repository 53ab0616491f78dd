"""The data file of tests/parity/driver.c: starts of scenes and problems, and what the installed extension made of them.

    python tests/parity/export.py FILE [STEPS]

The scenes and problems are those of the WebAssembly build (tests/wasm/record.py). Starts and problems are recorded as
numbers, so that nothing that builds them is part of what is compared. Scenes start from the same bits everywhere (but
for `pile`, whose turns NumPy draws, now and then by the logarithm of the mathematical library); the problems pass
through NumPy's matrix products.
"""

import struct
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "wasm")]

from newton_steps import NewtonSteps  # noqa: E402
from record import NEWTON_SCENES, NEWTON_STEPS, SCENES, STEPS, problems  # noqa: E402

import lavender as lv  # noqa: E402
from lavender.ordering import block_order  # noqa: E402
from lavender.solvers._factor import TINY, choose  # noqa: E402
from lavender.solvers.pivoting import SWEEPS as GUESSES  # noqa: E402
from lavender_ext.factor.sparse import scan  # noqa: E402
from lavender_ext.host import memory  # noqa: E402
from lavender_ext.pivot.principal import Pivoting  # noqa: E402

MAGIC = b"LAOVPAR1"
ROWS = ("jac", "normal", "tangent", "arm_a", "arm_b", "inv_mass", "inv_inertia")
SWEEPS = ((1, "given"), (7, None), (40, "given"))
ROUNDS = 40  # of pivoting


def numbers(*values):
    return struct.pack(f"<{len(values)}q", *values)


def array(values, dtype="<f8"):
    data = values if isinstance(values, bytes) else np.ascontiguousarray(values).astype(dtype).tobytes()
    return numbers(len(data)) + data + bytes(-len(data) % 8)


def scene(name, parameters, changes, steps):
    """Start, changes of settings, eight values after each step, the last state; by sweeps."""
    made = lv.Scene(name, **parameters)
    simulation = lv.Simulation(made)
    start, places = simulation.snapshot(), memory.layout()["settings_t"][1]
    edits, values = [], []
    for step in range(steps):
        for key, value in changes.get(step, {}).items():
            edits.append((step, places[key], value))
            if key == "iterations":
                simulation.set_solver_iterations(value)
            else:
                simulation.set_warm_start(bool(value))
        values.append(simulation.step()[0]["solver"].copy())
    inputs = beginning(call(name, parameters), made.parameters.substeps, steps, 0.0, start, edits)
    return inputs, inputs + array(values) + array(simulation.snapshot().real)


def newton_scene(name, parameters, changes, steps):
    """The same by Newton's method on the engine's arrays."""
    run = NewtonSteps(name, **parameters)
    start, place = run.simulation.snapshot(), memory.layout()["settings_t"][1]["warm_start"]
    edits, values = [], []
    for step in range(steps):
        if step in changes:
            run.set_warm_start(changes[step]["warm_start"])
            edits.append((step, place, changes[step]["warm_start"]))
        values.append(run.step())
    inputs = beginning(f"newton: {call(name, parameters)}", run.substeps, steps, run.tol, start, edits)
    return inputs, inputs + array(values) + array(run.state.real)


def call(name, parameters):
    return f"{name}({', '.join(f'{key}={value}' for key, value in parameters.items())})"


def beginning(name, substeps, steps, tol, start, edits):
    out = array(name.encode() + b"\0") + numbers(substeps, steps) + array([tol])
    out += array(start.size, "<i4") + array(start.real) + array(start.index, "<i4") + array(start.keys, "<u8")
    return out + array(np.array(edits, np.int32).reshape(-1, 3), "<i4")


def problem(given, sweeps, order, seed):
    """Counts, arrays, and what the extension made of them."""
    solver = "pgs" if given.rows is None else "sequential_impulses"
    more = {"seed": seed} if order == "random" else {}
    start = given.start() if given.guess is None else given.guess
    found = lv.solve(given, solver, tol=0, max_iter=sweeps, impulse=start, order=order, **more)
    o, c, r = block_order(given, order, **more), given.cones, given.rows
    counts = (0, 0, 0) if r is None else (r.n_bodies, r.n_joints, r.n_contacts)
    out = numbers(
        given.n_blocks, given.m, *counts, given.friction == "cone", r is not None, o.split, o.mode, sweeps
    )
    out += struct.pack("<Q", int(o.rng[0]))
    out += array(c.ptr, "<i4") + array(c.kind, "<i4") + array(o.blocks, "<i4")
    out += b"".join(array(x) for x in (c.lower, c.upper, c.mu, c.patch_radius, given.b, start))
    if r is None:
        a = given.csr
        out += array(a.indptr, "<i4") + array(a.indices, "<i4") + array(a.data)
    else:
        out += array(r.joint_body, "<i4") + array(r.contact_body, "<i4")
        out += b"".join(array(getattr(r, key)) for key in ROWS) + array(given.compliance)
    judged, data = found.residual, given.data
    made = (
        given.d,
        data.nu,
        data.step,
        found.impulse,
        found.slack,
        judged.error,
        [judged.energy, judged.velocity],
    )
    return out, out + b"".join(array(x) for x in made)


def pivoted(given):
    """A boxed problem and what `direct`'s pivoting with its own LDL^T made of it; None where it has no part in that."""
    if (
        given.law not in ("linear", "lcp") or given.rows is not None
    ):  # d of rows is not that of their matrix to the bit
        return None
    a, (form, band, order) = given.csr, choose(given)
    *_, gap, size = scan(a.indptr, a.indices, a.data)
    if form != "band" or gap > 1e-12 * size:  # larger ones are LAPACK's or QDLDL's, asymmetric ones LAPACK's
        return None
    start, c = given.start(), given.cones
    rows = Pivoting(given.csr_data, band, order, TINY)
    code, _ = rows.solve(start, GUESSES, ROUNDS)
    rows.slack()
    order = np.arange(given.m) if order is None else order
    out = numbers(given.n_blocks, given.m, band, GUESSES, ROUNDS) + array([TINY])
    out += array(c.ptr, "<i4") + array(c.kind, "<i4") + array(order, "<i4")
    out += b"".join(
        array(x)
        for x in (
            c.lower,
            c.upper,
            c.mu,
            c.patch_radius,
            given.b,
            given.d,
            given.data.nu,
            given.data.step,
            start,
        )
    )
    out += array(a.indptr, "<i4") + array(a.indices, "<i4") + array(a.data)
    return out, out + numbers(code) + array(rows.x) + array(rows.w)


def record(path, steps=STEPS, scenes=SCENES):
    """Write the file; (number of scenes, of problems swept, pivoted, inputs of scenes, of problems), those as bytes."""
    flat = [(name, field) for name, fields in memory.STRUCTS.items() for field in (None, *fields)]
    out = [MAGIC, numbers(*(flat.index((name, None)) for name in ("blocks_t", "csr_t", "rows_t", "score_t")))]
    made = [scene(*given, steps) for given in scenes]
    made += [newton_scene(*given, min(steps, NEWTON_STEPS)) for given in NEWTON_SCENES]
    solved = [
        problem(given, sweeps, order or ("symmetric", "random", "reverse", "colored")[i % 4], i)
        for i, given in enumerate(problems())
        for sweeps, order in SWEEPS
    ]
    exact = [found for found in map(pivoted, problems()) if found]
    for group in (made, solved, exact):
        out.append(numbers(len(group)))
        out += [whole for _, whole in group]
    Path(path).write_bytes(b"".join(out))
    return (
        len(made),
        len(solved),
        len(exact),
        *(b"".join(part for part, _ in group) for group in (made, solved + exact)),
    )


if __name__ == "__main__":
    print(*record(sys.argv[1], *map(int, sys.argv[2:]))[:3])
