"""What the parity table runs through lavender.h: scenes and problems, with what the installed extension made of them.

    python tests/export/parity/export.py FOLDER [STEPS]

The scenes are those of the WebAssembly build (tests/sim/web/record.py). Starts and problems are recorded as
numbers, so that nothing that builds them is part of what is compared. Scenes start from the same bits everywhere (but
for `pile`, whose turns NumPy draws, now and then by the logarithm of the mathematical library); the problems pass
through NumPy's matrix products.
"""

import struct
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1]), str(HERE.parents[1] / "sim" / "web")]

import vectors  # noqa: E402
from random_problems import as_matrix, random_contact_problem, random_lcp  # noqa: E402
from record import SCENES, STEPS  # noqa: E402
from vectors import NotSupported  # noqa: E402

import lavender as lv  # noqa: E402
from lavender.export import engine_image  # noqa: E402
from lavender_ext.engine.arrays import make_array_views  # noqa: E402

ORDERS = ("symmetric", "random", "reverse")
#: Tolerance, iterations and options of each solver.
SOLVED = {
    "jacobi": [(0.0, 9, {})],
    "block_gauss_seidel": [(0.0, 9, {})],
    "anderson": [(0.0, 40, {})],
    "nncg": [(0.0, 40, {})],
    "newton": [(1e-8, 100, {})],
    "direct": [(1e-8, 100, {})],
}


def numbers(*values):
    return struct.pack(f"<{len(values)}q", *values)


def array(data):
    return numbers(len(data)) + data + bytes(-len(data) % 8)


def scene(name, parameters, changes, steps):
    """Name, substeps and images, one for each change; of every step eight values and the places after it."""
    made = lv.Scene(name, **parameters)
    simulation = lv.Simulation(made)
    parts = []
    for step in range(steps):
        for key, value in changes.get(step, {}).items():
            if key == "iterations":
                simulation.set_solver_iterations(value)
            else:
                simulation.set_warm_start(bool(value))
        if step in changes or step == 0:
            parts.append((engine_image(simulation), []))
        values = simulation.step()[0]["solver"]
        s = simulation.snapshot()
        found = make_array_views(s.size, s.real, s.index, s.keys)
        places = np.concatenate([found["x"], found["q"]], axis=1)
        parts[-1][1].append(values.tobytes() + places.tobytes())
    words = ", ".join(f"{key}={value}" for key, value in parameters.items())
    out = array(f"{name}({words})".encode() + b"\0") + numbers(made.parameters.substeps, len(parts))
    return out + b"".join(array(image) + array(b"".join(of_steps)) for image, of_steps in parts)


def of_velocities():
    """Contacts on two bodies as J and M, so many that A would cost more, under both laws; two of them boxes."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        count = 8 + 4 * seed
        root = np.zeros((12, 12))
        root[:6, :6], root[6:, 6:] = rng.normal(size=(2, 6, 6))
        mass = np.eye(12) + 0.1 * root @ root.T
        cones = lv.Cones.contacts(0.5, count=count, shape="box" if seed > 3 else "disk")
        jac = rng.normal(size=(3 * count, 12))
        friction = ("coulomb", "cone")[seed % 2]
        yield lv.Problem.from_jacobian(
            jac, mass, rng.normal(size=12), cones=cones, friction=friction
        )


def solved(given, number):
    """The vectors of a problem: each solver that the library has for it."""
    swept = "pgs" if given.rows is None else "sequential_impulses"
    order = {"order": ORDERS[number % len(ORDERS)]}
    for solver, asked in {swept: [(0.0, 1, {}), (0.0, 7, order), (0.0, 40, {})], **SOLVED}.items():
        for tol, iterations, options in asked:
            try:
                yield vectors.make_test_vector(given, solver, tol, iterations, options)[0]
            except (NotSupported, lv.CapabilityError):
                continue


def problems():
    """Linear, boxed, with contacts in two and three dimensions, with spin, factored, recorded from scenes."""
    for seed in range(40):
        yield random_lcp(seed, m=8 + seed, rank=6 if seed % 5 == 4 else None)
        tangents = (0, 1, 2, None)[seed % 4]
        factored = random_contact_problem(
            seed, tangents=tangents, spin=seed % 3 == 0, bodies=4 + seed % 9
        )
        yield factored
        yield as_matrix(factored)
    rng = np.random.default_rng(40)
    for n in (1, 7, 30):
        g = rng.normal(size=(n, n + 2))
        yield lv.Problem.linear(g @ g.T, rng.normal(size=n), name=f"linear {n}")
    for name in ("stack", "pyramid", "bridge"):
        simulation = lv.Simulation(name)
        for _ in range(5):
            simulation.step()
        yield simulation.constraint_problem()
    yield lv.suite.case("granularF(n=4, sliding=2, seed=10)").problem  # `newton` needs Euler steps.


def record(folder, steps=STEPS, scenes=SCENES):
    """Write FOLDER/scenes.bin and FOLDER/vectors.bin; how many scenes and vectors there are."""
    made = [scene(*given, steps) for given in scenes]
    (folder / "scenes.bin").write_bytes(numbers(len(made)) + b"".join(made))
    given = [*problems(), *of_velocities()]
    packed = [vector for i, problem in enumerate(given) for vector in solved(problem, i)]
    (folder / "vectors.bin").write_bytes(vectors.join_vectors(packed))
    return len(made), len(packed)


if __name__ == "__main__":
    print(*record(Path(sys.argv[1]), *map(int, sys.argv[2:])))
