"""Engines of the scorecard: pinned packages, settings of both columns with their sources. Written before the first run.

"default" has no option except those that the scene needs; "accurate" has the options that the engine documents for
accuracy, without sleep and damping. Engines with several contact solvers have one entry for each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Entry:
    """An engine; `packages` are pinned requirements of pip, or of npm if `node` is true."""

    title: str
    adapter: str  # file of `adapters`, or of benchmarks/engines if `node`
    packages: tuple[str, ...]
    accurate: Options
    source: str  # of the accurate settings
    common: Options = field(
        default_factory=dict
    )  # options of both columns: the choice of the solver
    node: bool = False
    fresh: bool = (
        False  # a new process for each cell, because the memory of old scenes is not returned
    )


_MUJOCO = {
    "cone": "elliptic",
    "impratio": 100,
    "tolerance": 1e-12,
    "iterations": 500,
    "integrator": "implicit",
    "hard": True,
}
_MUJOCO_SOURCE = (
    "Modeling: elliptic cone, impratio against slip; solref 2 dt, solimp 0.99 to 0.9999"
)
_BULLET = {
    "numSolverIterations": 500,
    "solverResidualThreshold": 0,
    "enableConeFriction": 1,
    "restitutionVelocityThreshold": 0.01,
    "free": True,
}
_DART = {"detector": "DARTCollisionDetector", "split": True}
_DART_SOURCE = "ConstraintSolver: setSplitImpulseEnabled, setCollisionDetector"
_DRAKE = {"approximation": "kLagged", "stiction": 1e-5}
_JOLT = {
    "sweeps": 200,
    "positions": 20,
    "slop": 1e-5,
    "bounceSpeed": 0.01,
    "sleep": False,
    "damping": 0,
    "gyroscopic": True,
}
_RAPIER = {"iterations": 100, "sleep": False, "allowedError": 1e-5, "frequency": 0.1}
ENGINES: Mapping[str, Entry] = {
    "lavender": Entry(
        "LavenderSim",
        "lavender_sim",
        (),
        {"solver": "newton", "restitution_threshold": 0.01},
        "engine.md: newton solves each step to a tolerance; bounces above 0.01 m/s",
    ),
    "mujoco": Entry("MuJoCo, Newton", "mujoco_c", ("mujoco==4.0.0",), _MUJOCO, _MUJOCO_SOURCE),
    "mujoco-pgs": Entry(
        "MuJoCo, PGS", "mujoco_c", ("mujoco==4.0.0",), _MUJOCO, _MUJOCO_SOURCE, {"solver": "PGS"}
    ),
    "pybullet": Entry(
        "PyBullet",
        "bullet",
        ("pybullet==3.2.7", "numpy<2"),
        _BULLET,
        "Quickstart guide: setPhysicsEngineParameter, changeDynamics",
    ),
    "dart": Entry("DART, Dantzig", "dart", ("dartpy==6.20.0", "numpy"), _DART, _DART_SOURCE),
    "dart-nsgs": Entry(
        "DART, NSGS",
        "dart",
        ("dartpy==6.20.0", "numpy"),
        _DART,
        _DART_SOURCE,
        {"solver": "NsgsFrictionSolver"},
    ),
    "drake": Entry(
        "Drake, point contact",
        "drake_plant",
        ("drake==1.51.1",),
        _DRAKE,
        "MultibodyPlant: set_stiction_tolerance, lagged approximation",
    ),
    "drake-hydro": Entry(
        "Drake, hydroelastic",
        "drake_plant",
        ("drake==1.51.1",),
        _DRAKE,
        "as above, and a finer mesh of spheres",
        {"hydroelastic": 0.1},
    ),
    "physx": Entry(
        "PhysX 5 (sapien)",
        "physx",
        ("sapien==3.0.3", "numpy", "setuptools<81"),
        {
            "bounce_threshold": 0.01,
            "solver_position_iterations": 255,
            "sleep_threshold": 0.0,
            "free": True,
        },
        "PhysX guide: iterations, bounce threshold, sleep threshold, damping",
    ),
    "box3d": Entry(
        "Box3D (robox3d)",
        "box3d",
        ("robox3d==0.1.0", "numpy"),
        {"substeps": 32, "sleep": False, "bounce_speed": 0.01},
        "b3World_Step: substeps; b3World_SetRestitutionThreshold",
    ),
    "jolt": Entry(
        "Jolt",
        "jolt",
        ("jolt-physics@1.1.0",),
        _JOLT,
        "PhysicsSettings, BodyCreationSettings",
        node=True,
    ),
    "rapier": Entry(
        "Rapier",
        "rapier",
        ("@dimforge/rapier3d-compat@0.21.0",),
        _RAPIER,
        "IntegrationParameters; frequency of contacts 0.1 / dt in place of 30 Hz",
        node=True,
    ),
    "havok": Entry(
        "Havok",
        "havok",
        ("@babylonjs/havok@1.3.14",),
        {"idealStep": 0, "sleep": False, "damping": 0},
        "HavokPhysics.d.ts: ideal step time 0 leaves the solver's stiffness alone",
        node=True,
    ),
    "cannon": Entry(
        "cannon-es",
        "cannon",
        ("cannon-es@0.20.0",),
        {"iterations": 500, "tolerance": 0, "quatNormalizeSkip": 0, "sleep": False, "damping": 0},
        "GSSolver, World",
        node=True,
    ),
    "ammo": Entry(
        "ammo.js (Bullet)",
        "ammo",
        ("ammo.js@0.0.10",),
        {"margin": 0.001, "sleep": False, "damping": 0},
        "btRigidBody, btBoxShape; the build has no setting of iterations",
        node=True,
        fresh=True,
    ),
    "box2d": Entry(
        "Box2D 2.3 (2D)",
        "box2d",
        ("box2d==2.3.10",),
        {"velocity": 500, "position": 100, "sleep": False},
        "manual: more iterations; its suggestion, 8 and 3, is the default column",
    ),
    "pymunk": Entry(
        "Chipmunk (2D)",
        "chipmunk",
        ("pymunk==7.3.1",),
        {"iterations": 500, "collision_slop": 1e-5},
        "Space: iterations, collision_slop",
    ),
}
#: Engines that were tried and are not in the table, with the reason.
NOT_RUN: Mapping[str, str] = {
    "DART, PGS": "PgsBoxedLcpSolver has no constructor in Python",
    "MuJoCo MJX, brax, newton": "not tried: no adapter yet, and they compile each scene on a CPU",
    "genesis-world": "not tried: no set of binary packages was found within four minutes",
    "Exudyn": "not tried: no adapter yet",
    "planck, oimo": "npm found no package of the pinned version",
    "matter-js, p2-es, motrixsim": "installed; no adapter yet",
}
