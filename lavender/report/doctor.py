"""Facts for bug reports: versions, processor, compiler, backends, and whether kernels give the expected bits here."""

from __future__ import annotations

import hashlib
import os
import platform
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender._version import __version__
from lavender.problem import Problem
from lavender.report import machine
from lavender.report.machine import describe_build, get_versions
from lavender.sim.engine import Simulation
from lavender.sim.scene.gallery import SCENES
from lavender.solvers.registry import get, known, specs
from lavender.solving.solve import solve
from lavender_ext.sweep import serial

#: Expected hash of each part of the self-test: data are exact in binary, and kernels round equally on every machine.
HASHES = {
    "pgs, coulomb": "13f23d8b114e4370",
    "block_gauss_seidel, coulomb": "6a66d9513caf7de1",
    "nncg, coulomb": "5daa3ddebd9e662e",
    "anderson, cone": "a34bd69d6adedff8",
    "sequential_impulses, bodies": "a581fe01cf320e0d",
    "anderson, bodies": "5fc656dd530084c6",
    "stack, 60 steps": "136149a4c182dd25",
    "gallery, 5 steps": "f77e4c261f88d6b8",
}


def run_self_test() -> dict[str, str]:
    """Compute the hash of each part: sweeps over a matrix and over bodies, exact blocks, steps of scenes.

    `newton`, `direct` and `admm` are left out: parts of them use BLAS and LAPACK, and their bits depend on the library.
    """
    simulation = Simulation("stack")
    for _ in range(20):
        simulation.step()
    bodies = replace(simulation.constraint_problem(), guess=None)
    results = {}
    n = int(bodies.cones.is_contact.sum())
    for name in ("pgs", "block_gauss_seidel", "nncg", "anderson"):
        law = "cone" if name == "anderson" else "coulomb"
        contacts = Problem.contact(bodies.csr, bodies.b, mu=np.full(n, 0.5), friction=law)
        results[f"{name}, {law}"] = solve(contacts, name, tol=0.0, max_iter=12).impulse
    for name in ("sequential_impulses", "anderson"):
        results[f"{name}, bodies"] = solve(bodies, name, tol=0.0, max_iter=12).impulse
    results["stack, 60 steps"] = simulate_positions("stack", 60)
    # The initial positions of scenes are hashed, too. NumPy draws a pile's rotations, which may depend on its libm.
    gallery = [
        name for name, build in SCENES.items() if build.__module__ == "lavender.sim.scene.gallery"
    ]
    positions = [simulate_positions(name, 5) for name in sorted(gallery) if name != "pile"]
    results["gallery, 5 steps"] = np.concatenate(positions)
    hashes = {
        name: hashlib.sha256(np.ascontiguousarray(x).tobytes()) for name, x in results.items()
    }
    return {name: digest.hexdigest()[:16] for name, digest in hashes.items()}


def collect_installation_facts() -> dict[str, Any]:
    """Collect facts about this installation as plain data.

    `run_self_test` gives "same", or the expected and the actual hash, for each part.
    """
    start_time = perf_counter()
    backends = {name: reason for name, reason in known().items() if specs()[name].external}
    hashes = {n: (HASHES.get(n), h) for n, h in run_self_test().items()}
    parts = {n: "same" if x == h else f"{x} expected, {h} found" for n, (x, h) in hashes.items()}
    installed = {
        name: ", ".join(f"{p} {v}" for p, v in get_versions(get(name).requires, base=()).items())
        for name, reason in backends.items()
        if not reason
    }
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "lavender": __version__,
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpu": machine.get_cpu_name(),
        "cores": os.cpu_count() or 1,
        "cores_allowed": len(affinity(0)) if affinity else os.cpu_count() or 1,
        "memory_bytes": machine.get_total_memory(),
        "threads_set": {k: v for k, v in sorted(os.environ.items()) if k.endswith("_NUM_THREADS")},
        "versions": get_versions(["cython", "matplotlib", "h5py", "mujoco"]),
        "build": describe_build() | machine.get_processor_clock(),
        "load": machine.get_load_average(),
        "extension": Path(str(serial.__file__)).name,
        "backends": {
            name: reason or installed[name] or "installed" for name, reason in backends.items()
        },
        "plug_ins": {
            name: get_versions([s.distribution], base=())
            for name, s in specs().items()
            if s.distribution
        },
        "self_test": parts,
        "same_bits": all(x == "same" for x in parts.values()),
        "seconds": round(perf_counter() - start_time, 2),
    }


def simulate_positions(scene: str, n: int) -> Any:
    """Compute the positions of all bodies after n steps of a scene."""
    simulation = Simulation(scene)
    for _ in range(n):
        positions = simulation.step()[0]["positions"]
    return positions.ravel()
