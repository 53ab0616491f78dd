"""Facts for bug reports: versions, processor, compiler, backends, and whether kernels give the expected bits here."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender._version import __version__
from lavender.problem import Problem
from lavender.problem.rows import Rows
from lavender.report.machine import (
    describe_build,
    get_cpu_name,
    get_load_average,
    get_processor_clock,
    get_total_memory,
    get_versions,
)
from lavender.sim.engine import Simulation
from lavender.sim.scene.gallery import SCENES
from lavender.solvers.registry import get, known, specs
from lavender.solving.solve import solve
from lavender_ext.sweep import serial

#: Expected hash of each part of the self-test: data are exact in binary, and kernels round equally on every machine.
HASHES = {
    "pgs, coulomb": "4d51c4d5ba92212c",
    "block_gauss_seidel, coulomb": "c08c92ae0a6354d6",
    "nncg, coulomb": "82f4e616d5f5208b",
    "anderson, cone": "b0e6e8bb55d403de",
    "sequential_impulses, bodies": "c9273bfb07c7c548",
    "anderson, bodies": "c354da73432a620b",
    "stack, 60 steps": "e5f91394fb7c66b5",
    "gallery, 5 steps": "e6ecaf800bc6ccd7",
}


def run_self_test() -> dict[str, str]:
    """Compute the hash of each part: sweeps over a matrix and over bodies, exact blocks, steps of scenes.

    `newton`, `direct` and `admm` are left out: parts of them use BLAS and LAPACK, and their bits depend on the library.
    """
    results = {}
    for name in ("pgs", "block_gauss_seidel", "nncg", "anderson"):
        law = "cone" if name == "anderson" else "coulomb"
        results[f"{name}, {law}"] = solve(_build_test_contacts(law), name, tol=0.0, max_iter=12).impulse
    for name in ("sequential_impulses", "anderson"):
        results[f"{name}, bodies"] = solve(_build_test_bodies(), name, tol=0.0, max_iter=12).impulse
    results["stack, 60 steps"] = simulate_positions("stack", 60)
    # The initial positions of scenes are hashed, too. NumPy draws a pile's rotations, which may depend on its libm.
    gallery = [name for name, build in SCENES.items() if build.__module__ == "lavender.sim.scene.gallery"]
    results["gallery, 5 steps"] = np.concatenate(
        [simulate_positions(name, 5) for name in sorted(gallery) if name != "pile"]
    )
    return {
        name: hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()[:16]
        for name, x in results.items()
    }


def collect_installation_facts() -> dict[str, Any]:
    """Collect facts about this installation as plain data.

    `run_self_test` gives "same", or the expected and the actual hash, for each part.
    """
    start_time = perf_counter()
    backends = {name: reason for name, reason in known().items() if specs()[name].external}
    parts = {
        n: "same" if h == HASHES.get(n) else f"{HASHES.get(n)} expected, {h} found"
        for n, h in run_self_test().items()
    }
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "lavender": __version__,
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpu": get_cpu_name(),
        "cores": os.cpu_count() or 1,
        "cores_allowed": len(affinity(0)) if affinity else os.cpu_count() or 1,
        "memory_bytes": get_total_memory(),
        "threads_set": {k: v for k, v in sorted(os.environ.items()) if k.endswith("_NUM_THREADS")},
        "versions": get_versions(["cython", "matplotlib", "h5py", "mujoco"]),
        "build": describe_build() | get_processor_clock(),
        "load": get_load_average(),
        "extension": Path(str(serial.__file__)).name,
        "backends": {name: reason or get_backend_versions(name) for name, reason in backends.items()},
        "plug_ins": {
            name: get_versions([s.distribution], base=()) for name, s in specs().items() if s.distribution
        },
        "self_test": parts,
        "same_bits": all(x == "same" for x in parts.values()),
        "seconds": round(perf_counter() - start_time, 2),
    }


def get_backend_versions(solver: str) -> str:
    """Return the versions of the packages that a backend needs."""
    package_versions = get_versions(get(solver).requires, base=())
    return ", ".join(f"{name} {v}" for name, v in package_versions.items()) or "installed"


def simulate_positions(scene: str, n: int) -> Any:
    """Compute the positions of all bodies after n steps of a scene."""
    simulation = Simulation(scene)
    for _ in range(n):
        positions = simulation.step()[0]["positions"]
    return positions.ravel()


def _build_test_contacts(law: str) -> Problem:
    """Build eight contacts of three rows from integers and halves only, so that no library rounds the start."""
    m = 24
    i, j = np.indices((m, m))
    band = np.where(np.abs(i - j) <= 3, -0.5, 0.0)
    a = np.where(i == j, 4.0, band) + np.where((i + j) % 7 == 0, 0.125, 0.0)
    b = ((np.arange(m) * 37) % 11 - 5) / 4.0
    b[::3] = 1.0 + np.arange(m // 3) / 8.0
    return Problem.contact(a, b, mu=np.full(m // 3, 0.5), friction=law)


def _build_test_bodies() -> Problem:
    """Build six boxes on each other with four contacts each, pushed sideways; every number is a dyadic fraction."""
    n, corners = 6, np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
    arm = np.repeat([[0.0, 0.0, 0.5]], 4, axis=0)
    arm[:, :2] = corners
    lower_arm = arm * [1.0, 1.0, -1.0]
    bodies = np.repeat(np.array([[i - 1, i] for i in range(n)], np.int32), 4, axis=0)
    c = 4 * n
    inverse = np.array([2.0**-i for i in range(n)])
    v = np.zeros((n, 6))
    v[:, 2], v[:, 0] = -0.125, np.arange(n) / 16.0
    rows = Rows(
        inv_mass=inverse,
        inv_inertia=np.multiply.outer(6.0 * inverse, np.eye(3)),
        v_free=v,
        jac=np.zeros((0, 12)),
        joint_ptr=np.zeros(1, np.int32),
        joint_body=np.zeros((0, 2), np.int32),
        normal=np.tile([0.0, 0.0, 1.0], (c, 1)),
        tangent=np.tile([1.0, 0.0, 0.0], (c, 1)),
        arm_a=np.tile(arm, (n, 1)),
        arm_b=np.tile(lower_arm, (n, 1)),
        contact_body=bodies,
    )
    return Problem.from_rows(rows, mu=0.5 * np.ones(c))
