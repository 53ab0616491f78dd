"""Engines of the scorecard: pinned packages, the rule of the accurate columns, and how each engine meets it.

"default" has no option except those that the scene needs. "accurate" follows `RULE`, which names every kind of knob
that engines document for accuracy. An entry sets each kind, with the source, or says why it does not. Rule and settings
are committed before the run. Several solvers of one engine are rows; so are settings of which the documentation says
that one is gained at the cost of another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Options = Mapping[str, Any]

#: What the accurate columns do with each kind of knob, in every engine alike.
RULE: Mapping[str, str] = {
    "iterations": "every count is 500, or the largest that is accepted; tolerances that end them are 0, or 1e-12. "
    "Engines whose step on a CPU takes milliseconds because they are made for GPUs: "
    "50, or the shipped number if it is larger",
    "substeps": "as shipped, unless the solver makes one iteration in each: then 32, "
    "and a second row keeps the shipped number",
    "stiffness": "contacts and joints are as stiff as the documentation allows at the time step; "
    "if it has no limit, their frequency is an eighth of the rate of substeps",
    "friction": "a round cone at each contact point",
    "slip": "documented remedies against creep are on, and the speed that regularizes friction is 1e-5 m/s; "
    "a remedy that its documentation calls a correction after the solution has a row of its own",
    "margin": "allowed penetration is 1e-5 m, rounding of shapes 0, or 1e-5 m if 0 is not accepted, "
    "cached contact points are not reused; bounces count from 0.01 m/s",
    "sleep": "off",
    "damping": "0",
    "integration": "the documented choice for accuracy, gyroscopic torque included",
}


@dataclass(frozen=True)
class Knob:
    """Options of an adapter that set one kind of knob, and where the engine documents them."""

    kind: str
    options: Options
    source: str


@dataclass(frozen=True)
class Entry:
    """A row of the scorecard; `packages` are pinned requirements of pip, or of npm if `node` is true."""

    title: str
    engine: str  # rows of one engine are counted once, and share an environment
    adapter: str  # file of `adapters`, or of benchmarks/engines if `node`
    packages: tuple[str, ...]
    knobs: tuple[Knob, ...]
    unset: Mapping[str, str]  # kinds of `RULE` without a knob -> the reason
    common: Options = field(
        default_factory=dict
    )  # options of all columns: the choice of the solver
    node: bool = False
    fresh: bool = (
        False  # a new process for each cell, because the memory of old scenes is not returned
    )
    patience: float = 1.0  # multiple of the limit of CPU time

    @property
    def accurate(self) -> dict[str, Any]:
        """Return the options of the accurate columns."""
        return {key: value for knob in self.knobs for key, value in knob.options.items()}


NO_KNOB = "no such setting"
_GPU = 5.0  # patience with engines whose step on a CPU takes milliseconds because they are made for GPUs


def _make_mujoco(title: str, common: Options, **replaced: Knob | None) -> Entry:
    """Return a row of MuJoCo; `replaced` knobs take the place of those of their kind."""
    knobs = {
        "iterations": Knob(
            "iterations",
            {"iterations": 500, "tolerance": 1e-12},
            "Modeling, Solver settings: very small tolerance; ls_iterations 500 and ls_tolerance 1e-12 change no "
            "cell of MuJoCo (Newton) by more than 1 %",
        ),
        "stiffness": Knob(
            "stiffness",
            {"hard": True},
            "Modeling, Solver parameters: solref at least 2 dt; solimp to 0.9999. diagexact, which the XML reference "
            "offers for models with complex kinematic coupling, has a row",
        ),
        "friction": Knob(
            "friction",
            {"cone": "elliptic"},
            "Modeling, Solver settings: elliptic cones are closer to reality",
        ),
        "slip": Knob(
            "slip",
            {"impratio": 100},
            "Modeling, Solver settings: elliptic cones, large impratio, Newton",
        ),
        "integration": Knob(
            "integration",
            {"integrator": "implicit"},
            "Computation, Integrators: implicit for coupled rotation; discrete is for stiff springs and dampings",
        ),
    }
    unset = {
        "substeps": NO_KNOB,
        "margin": "geoms have no margin and no rounding as shipped; no threshold of bounces",
        "sleep": "off as shipped",
        "damping": "0 as shipped",
    }
    for kind, knob in replaced.items():
        if knob is None:
            del knobs[kind]
            unset[kind] = "as shipped in this row"
        else:
            knobs[kind] = knob
    return Entry(
        title, "mujoco", "mujoco_c", ("mujoco==4.0.0",), tuple(knobs.values()), unset, common
    )


def _make_dart(title: str, common: Options, sweeps: bool) -> Entry:
    """Return a row of DART."""
    knobs = (
        Knob(
            "stiffness",
            {"split": True},
            "ConstraintSolver: setSplitImpulseEnabled corrects positions without energy",
        ),
        Knob(
            "margin",
            {"detector": "DARTCollisionDetector"},
            "ConstraintSolver: setCollisionDetector; exact boxes and spheres",
        ),
    )
    unset = {
        "substeps": NO_KNOB,
        "slip": NO_KNOB,
        "sleep": "off as shipped",
        "damping": "0 as shipped",
        "integration": NO_KNOB,
        "friction": "Coulomb's law as shipped"
        if sweeps
        else "a box of friction; NSGS has the cone",
    }
    if sweeps:
        knobs = (
            Knob(
                "iterations", {"maxSweeps": 500, "tolerance": 1e-12}, "NsgsFrictionSolver.Options"
            ),
            *knobs,
        )
    else:
        unset["iterations"] = "a direct method"
    return Entry(title, "dart", "dart", ("dartpy==6.20.0", "numpy"), knobs, unset, common)


def _make_drake(title: str, common: Options, approximation: str = "kLagged") -> Entry:
    """Return a row of Drake."""
    knobs = (
        Knob(
            "stiffness",
            {"penetration": 1e-5},
            "AddContactMaterial: point_stiffness, here the weight of the heaviest body per allowed penetration and at "
            "least the shipped 1e6 N/m; set_sap_near_rigid_threshold is for kSap",
        )
        if not common
        else Knob(
            "stiffness",
            {"modulus": 1e9, "hydroelastic": 0.05},
            "Hydroelastic user guide: modulus; a finer mesh of spheres",
        ),
        Knob("slip", {"stiction": 1e-5}, "MultibodyPlant: set_stiction_tolerance"),
        Knob(
            "integration",
            {"approximation": approximation},
            "DiscreteContactApproximation: kLagged is preferred, and kSimilar for strong transients"
            + ("" if common else "; of point contacts kSimilar does not converge"),
        ),
    )
    unset = {
        "iterations": "Newton's method to a tolerance; not set in Python",
        "substeps": NO_KNOB,
        "friction": "a round cone as shipped",
        "margin": "no margin as shipped",
        "sleep": NO_KNOB,
        "damping": "0 as shipped",
    }
    return Entry(title, "drake", "drake_plant", ("drake==1.51.1",), knobs, unset, common)


def _make_box3d(title: str, common: Options, substeps: int) -> Entry:
    """Return a row of Box3D."""
    knobs = (
        Knob(
            "stiffness",
            {"contact_hertz": 1e6, "joint_hertz": 1e6},
            "b3World_SetContactTuning, b3Joint_SetConstraintTuning; the engine reduces both to "
            "1/8 and 1/4 of the rate of substeps",
        ),
        Knob(
            "margin",
            {"bounce_speed": 0.01, "recycle": 0.0},
            "b3World_SetRestitutionThreshold, b3World_SetContactRecycleDistance",
        ),
        Knob("sleep", {"sleep": False}, "b3World_EnableSleeping"),
    )
    unset = {
        "iterations": "one in each substep",
        "friction": "one point for each manifold; " + NO_KNOB,
        "slip": NO_KNOB,
        "damping": "0 as shipped",
        "integration": NO_KNOB,
    }
    if substeps:
        knobs = (
            Knob("substeps", {"substeps": substeps}, "Simulation: more substeps are more accurate"),
            *knobs,
        )
    else:
        unset["substeps"] = "4 as shipped, the second row"
    return Entry(title, "box3d", "box3d", ("robox3d==0.1.0", "numpy"), knobs, unset, common)


def _make_rapier(title: str, common: Options, substeps: int) -> Entry:
    """Return a row of Rapier."""
    shipped = 4
    knobs = (
        Knob(
            "iterations",
            {"inner": 16 if substeps else 125},
            "IntegrationParameters: numInternalPgsIterations; 500 with the substeps",
        ),
        Knob(
            "stiffness",
            {"frequency": (substeps or shipped) / 8},
            "IntegrationParameters: contact_natural_frequency, here in 1/dt; the package of npm has no setting of the "
            "damping ratio, and none of contacts with fixed bodies",
        ),
        Knob(
            "margin",
            {"allowedError": 1e-5},
            "IntegrationParameters: normalizedAllowedLinearError; the package of npm has no contact_recycling",
        ),
        Knob("sleep", {"sleep": False}, "RigidBodyDesc.setCanSleep"),
    )
    unset = {
        "friction": "one point and one twist for each manifold; the choice FrictionModel::Coulomb is missing in the "
        "package of npm",
        "slip": NO_KNOB,
        "damping": "0 as shipped",
        "integration": NO_KNOB,
    }
    if substeps:
        knobs = (
            Knob(
                "substeps",
                {"iterations": substeps},
                "IntegrationParameters: numSolverIterations are substeps",
            ),
            *knobs,
        )
    else:
        unset["substeps"] = "4 as shipped, the second row"
    return Entry(
        title,
        "rapier",
        "rapier",
        ("@dimforge/rapier3d-compat@0.21.0",),
        knobs,
        unset,
        common,
        node=True,
    )


_NEWTON = (
    "newton==1.8.0",
    "warp-lang==1.19.0",
    "mujoco==3.17.0",
    "mujoco-warp==3.17.0",
    "scipy",
)


def _make_newton(
    title: str,
    solver: str,
    knobs: tuple[Knob, ...],
    unset: Mapping[str, str],
    patience: float = _GPU,
) -> Entry:
    """Return a row of newton."""
    shared = {
        "substeps": NO_KNOB,
        "margin": "no margin as shipped; no threshold of bounces",
        "sleep": NO_KNOB,
        "integration": NO_KNOB,
        "damping": "0 as shipped",
    }
    shared = {kind: why for kind, why in shared.items() if kind not in [k.kind for k in knobs]}
    return Entry(
        title,
        "newton",
        "newton_warp",
        _NEWTON,
        knobs,
        shared | unset,
        {"solver": solver},
        patience=patience,
    )


_RIGID = "rigid contacts; their rate of correction stays as shipped"
ENGINES: Mapping[str, Entry] = {
    "lavender": Entry(
        "LavenderSim",
        "lavender",
        "lavender_sim",
        (),
        (
            Knob(
                "iterations",
                {"solver": "newton", "position_iterations": 500},
                "engine.md: newton solves a step to a tolerance",
            ),
            Knob(
                "margin",
                {"slop": 1e-5, "restitution_threshold": 0.01},
                "Parameters: slop, restitution_threshold",
            ),
        ),
        {
            "substeps": "none with newton",
            "stiffness": _RIGID,
            "friction": "a round cone at each point as shipped",
            "slip": NO_KNOB,
            "sleep": NO_KNOB,
            "damping": NO_KNOB,
            "integration": NO_KNOB,
        },
    ),
    "mujoco": _make_mujoco("MuJoCo (Newton)", {}),
    "mujoco-noslip": _make_mujoco(
        "MuJoCo (noslip)",
        {},
        slip=Knob(
            "slip",
            {"impratio": 100, "noslip_iterations": 500, "noslip_tolerance": 1e-12},
            "Modeling, Solver settings: if that is not sufficient, noslip",
        ),
    ),
    "mujoco-soft": _make_mujoco("MuJoCo (soft contacts)", {}, stiffness=None),
    "mujoco-exact": _make_mujoco(
        "MuJoCo (diagexact)",
        {},
        stiffness=Knob(
            "stiffness",
            {"hard": True, "diagexact": "enable"},
            "as in MuJoCo (Newton); XML reference, flag diagexact: a more accurate impedance",
        ),
    ),
    "mujoco-rk4": _make_mujoco(
        "MuJoCo (RK4)",
        {},
        integration=Knob(
            "integration",
            {"integrator": "RK4"},
            "Computation, Integrators: RK4 for motions that conserve energy",
        ),
    ),
    "mujoco-pgs": _make_mujoco("MuJoCo (PGS)", {"solver": "PGS"}),
    "pybullet": Entry(
        "PyBullet",
        "pybullet",
        "bullet",
        ("pybullet==3.2.7", "numpy<2"),
        (
            Knob(
                "iterations",
                {"numSolverIterations": 500, "solverResidualThreshold": 0},
                "Quickstart guide: setPhysicsEngineParameter",
            ),
            Knob(
                "friction",
                {"enableConeFriction": 1},
                "Quickstart guide: setPhysicsEngineParameter",
            ),
            Knob(
                "margin",
                {"restitutionVelocityThreshold": 0.01, "collisionMargin": 1e-5},
                "Quickstart guide: setPhysicsEngineParameter; changeDynamics, collisionMargin",
            ),
            Knob(
                "sleep", {"activationState": 2}, "Quickstart guide: changeDynamics, activationState"
            ),
            Knob(
                "damping",
                {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0},
                "Quickstart guide: changeDynamics, linearDamping, angularDamping, jointDamping",
            ),
        ),
        {
            "substeps": "numSubSteps divides the time step",
            "stiffness": _RIGID,
            "slip": NO_KNOB,
            "integration": NO_KNOB,
        },
    ),
    "dart": _make_dart("DART (Dantzig)", {}, False),
    "dart-nsgs": _make_dart("DART (NSGS)", {"solver": "NsgsFrictionSolver"}, True),
    "drake": _make_drake("Drake (point contact)", {}),
    "drake-hydro": _make_drake("Drake (hydroelastic)", {"hydroelastic": 0.1}),
    "drake-similar": _make_drake("Drake (kSimilar)", {"hydroelastic": 0.1}, "kSimilar"),
    "physx": Entry(
        "PhysX 5 (sapien)",
        "physx",
        "physx",
        ("sapien==3.0.3", "numpy", "setuptools<81"),
        (
            Knob(
                "iterations",
                {"solver_position_iterations": 255},
                "Guide, Rigid Body Dynamics: at most 255 position iterations; "
                "velocity iterations stay 1, because TGS wants few",
            ),
            Knob("margin", {"bounce_threshold": 0.01}, "PxSceneDesc: bounceThresholdVelocity"),
            Knob("sleep", {"sleep_threshold": 0.0}, "PxRigidDynamic: setSleepThreshold"),
            Knob("damping", {"free": True}, "PxRigidBody: setLinearDamping, setAngularDamping"),
        ),
        {
            "substeps": "TGS makes one in each position iteration",
            "stiffness": _RIGID,
            "friction": "friction patches; " + NO_KNOB,
            "slip": NO_KNOB,
            "integration": "gyroscopic forces are not offered by sapien",
        },
    ),
    "box3d": _make_box3d("Box3D", {}, 32),
    "box3d-shipped": _make_box3d("Box3D (4 substeps)", {}, 0),
    "jolt": Entry(
        "Jolt",
        "jolt",
        "jolt",
        ("jolt-physics@1.1.0",),
        (
            Knob(
                "iterations",
                {"sweeps": 500, "positions": 500},
                "PhysicsSettings: mNumVelocitySteps, mNumPositionSteps",
            ),
            Knob(
                "margin",
                {"slop": 1e-5, "radius": 0, "bounceSpeed": 0.01, "cache": False},
                "PhysicsSettings: mPenetrationSlop, mMinVelocityForRestitution, "
                "mUseBodyPairContactCache; BoxShape: inConvexRadius",
            ),
            Knob("sleep", {"sleep": False}, "BodyCreationSettings: mAllowSleeping"),
            Knob(
                "damping",
                {"damping": 0},
                "BodyCreationSettings: mLinearDamping, mAngularDamping",
            ),
            Knob(
                "integration",
                {"gyroscopic": True},
                "BodyCreationSettings: mApplyGyroscopicForce",
            ),
        ),
        {
            "substeps": "collision steps divide the time step",
            "stiffness": _RIGID,
            "friction": "one point and one twist for each manifold, release notes; " + NO_KNOB,
            "slip": NO_KNOB,
        },
        node=True,
    ),
    "rapier": _make_rapier("Rapier", {}, 32),
    "rapier-shipped": _make_rapier("Rapier (4 substeps)", {}, 0),
    "havok": Entry(
        "Havok",
        "havok",
        "havok",
        ("@babylonjs/havok@1.3.14",),
        (
            Knob(
                "stiffness",
                {"idealStep": "dt"},
                "HavokPhysics.d.ts: the ideal step time is the intended step, as shipped 1/60 s",
            ),
            Knob("sleep", {"sleep": False}, "HavokPhysics.d.ts: HP_Body_SetActivationControl"),
            Knob(
                "damping",
                {"damping": 0},
                "HavokPhysics.d.ts: HP_Body_SetLinearDamping, HP_Body_SetAngularDamping",
            ),
        ),
        dict.fromkeys(
            ("iterations", "substeps", "friction", "slip", "margin", "integration"), NO_KNOB
        ),
        node=True,
    ),
    "cannon": Entry(
        "cannon-es",
        "cannon",
        "cannon",
        ("cannon-es@0.20.0",),
        (
            Knob(
                "iterations",
                {"iterations": 500, "tolerance": 0},
                "GSSolver: iterations, tolerance",
            ),
            Knob(
                "stiffness",
                {"frequency": 0.125},
                "ContactMaterial: contactEquationStiffness, here from a frequency in 1/dt, "
                "and at least the shipped 1e7 N/m",
            ),
            Knob("sleep", {"sleep": False}, "Body: allowSleep"),
            Knob("damping", {"damping": 0}, "Body: linearDamping, angularDamping"),
            Knob("integration", {"quatNormalizeSkip": 0}, "World: quatNormalizeSkip"),
        ),
        {
            "substeps": NO_KNOB,
            "friction": "a box of friction at each point; " + NO_KNOB,
            "slip": NO_KNOB,
            "margin": NO_KNOB,
        },
        node=True,
    ),
    "ammo": Entry(
        "ammo.js (Bullet)",
        "ammo",
        "ammo",
        ("ammo.js@0.0.10",),
        (
            Knob("margin", {"margin": 1e-5}, "btConvexInternalShape: setMargin"),
            Knob("sleep", {"sleep": False}, "btCollisionObject: setActivationState"),
            Knob("damping", {"damping": 0}, "btRigidBody: setDamping"),
        ),
        {
            "iterations": "the build has no setting",
            "substeps": NO_KNOB,
            "stiffness": _RIGID,
            "friction": NO_KNOB,
            "slip": NO_KNOB,
            "integration": NO_KNOB,
        },
        node=True,
        fresh=True,
    ),
    "box2d": Entry(
        "Box2D 2.3 (2D)",
        "box2d",
        "box2d",
        ("box2d==2.3.10",),
        (
            Knob(
                "iterations",
                {"velocity": 500, "position": 500},
                "manual: more iterations; its suggestion, 8 and 3, is the default column",
            ),
            Knob("sleep", {"sleep": False}, "b2World: allowSleeping"),
        ),
        {
            "substeps": "subStepping is for continuous collision",
            "stiffness": _RIGID,
            "friction": "exact in the plane",
            "slip": NO_KNOB,
            "margin": "constants of the build",
            "damping": "0 as shipped",
            "integration": NO_KNOB,
        },
    ),
    "pymunk": Entry(
        "Chipmunk (2D)",
        "pymunk",
        "chipmunk",
        ("pymunk==7.3.1",),
        (
            Knob("iterations", {"iterations": 500}, "Space: iterations"),
            Knob("margin", {"collision_slop": 1e-5}, "Space: collision_slop"),
        ),
        {
            "substeps": NO_KNOB,
            "stiffness": _RIGID,
            "friction": "exact in the plane",
            "slip": NO_KNOB,
            "sleep": "off as shipped",
            "damping": "0 as shipped",
            "integration": NO_KNOB,
        },
    ),
    "p2": Entry(
        "p2-es (2D)",
        "p2",
        "p2",
        ("p2-es@1.2.3",),
        (
            Knob(
                "iterations", {"iterations": 500, "tolerance": 0}, "GSSolver: iterations, tolerance"
            ),
            Knob(
                "stiffness",
                {"frequency": 0.125},
                "ContactMaterial: stiffness, here from a frequency in 1/dt, and at least the shipped 1e6 N/m",
            ),
            Knob("damping", {"damping": 0}, "Body: damping, angularDamping"),
        ),
        {
            "substeps": NO_KNOB,
            "friction": "exact in the plane",
            "slip": NO_KNOB,
            "margin": NO_KNOB,
            "sleep": "off as shipped",
            "integration": NO_KNOB,
        },
        node=True,
    ),
    "planck": Entry(
        "planck (2D)",
        "planck",
        "planck",
        ("planck@1.5.0",),
        (
            Knob("iterations", {"velocity": 500, "position": 500}, "World.step: iterations"),
            Knob(
                "margin",
                {"slop": 1e-5, "bounceSpeed": 0.01},
                "Settings: linearSlop, whose double is the radius of polygons, velocityThreshold",
            ),
            Knob("sleep", {"sleep": False}, "WorldDef: allowSleep"),
        ),
        {
            "substeps": "subStepping is for continuous collision",
            "stiffness": _RIGID,
            "friction": "exact in the plane",
            "slip": NO_KNOB,
            "damping": "0 as shipped",
            "integration": NO_KNOB,
        },
        node=True,
    ),
    "oimo": Entry(
        "oimo",
        "oimo",
        "oimo",
        ("oimo@1.0.9",),
        (
            Knob("iterations", {"iterations": 500}, "World: iterations"),
            Knob("sleep", {"sleep": False}, "World.add: neverSleep"),
        ),
        {
            "substeps": NO_KNOB,
            "stiffness": _RIGID,
            "friction": "a round cone at each point as shipped",
            "slip": NO_KNOB,
            "margin": NO_KNOB,
            "damping": "0 as shipped",
            "integration": NO_KNOB,
        },
        node=True,
    ),
    "exudyn": Entry(
        "Exudyn (no contacts)",
        "exudyn",
        "exudyn_mbs",
        ("exudyn==1.13.6", "numpy"),
        (),
        {
            "iterations": "tolerances of 1e-12 are below rounding: some steps do not end",
            "substeps": "as shipped",
            "stiffness": "ideal joints",
            "friction": "no contacts here",
            "slip": "no contacts here",
            "margin": "no contacts here",
            "sleep": NO_KNOB,
            "integration": "generalized alpha, of second order, as shipped",
            "damping": "0 as shipped; without the integrator's own damping a step of tumble does not end",
        },
    ),
    "motrixsim": Entry(
        "MotrixSim",
        "motrixsim",
        "motrix",
        ("motrixsim==0.10.1", "numpy"),
        (
            Knob(
                "iterations",
                {"max_iterations": 500, "solver_tolerance": 1e-12},
                "Options: max_iterations, solver_tolerance",
            ),
            Knob("stiffness", {"hard": True}, "MJCF as in MuJoCo: solref at least 2 dt, solimp"),
        ),
        {
            "substeps": NO_KNOB,
            "friction": NO_KNOB,
            "slip": NO_KNOB,
            "margin": "geoms have no margin and no rounding as shipped",
            "sleep": NO_KNOB,
            "damping": "0 as shipped",
            "integration": NO_KNOB,
        },
    ),
    "newton-xpbd": _make_newton(
        "newton (XPBD)",
        "SolverXPBD",
        (
            Knob(
                "iterations",
                {"iterations": 50, "rigid_contact_restitution_iterations": 50},
                "SolverXPBD: iterations, rigid_contact_restitution_iterations",
            ),
        ),
        {
            "stiffness": "no compliance as shipped",
            "friction": "a round cone at each point as shipped",
            "slip": NO_KNOB,
        },
        patience=1.0,
    ),
    "newton-vbd": _make_newton(
        "newton (VBD)",
        "SolverVBD",
        (
            Knob("iterations", {"iterations": 50}, "SolverVBD: iterations"),
            Knob("slip", {"friction_epsilon": 1e-5}, "SolverVBD: friction_epsilon"),
        ),
        {
            "stiffness": "hard constraints by augmented Lagrangians as shipped",
            "friction": "a round cone at each point as shipped",
        },
    ),
    "newton-featherstone": _make_newton(
        "newton (Featherstone)",
        "SolverFeatherstone",
        (
            Knob(
                "stiffness",
                {"frequency": 0.125},
                "ShapeConfig: ke and kd, here from a frequency in 1/dt with critical damping",
            ),
            Knob("slip", {"friction_smoothing": 1e-5}, "SolverFeatherstone: friction_smoothing"),
            Knob("damping", {"angular_damping": 0.0}, "SolverFeatherstone: angular_damping"),
        ),
        {
            "iterations": "explicit forces of contacts",
            "friction": "a round cone at each point as shipped",
        },
    ),
    "newton-mujoco": _make_newton(
        "newton (MuJoCo Warp)",
        "SolverMuJoCo",
        (
            Knob(
                "iterations",
                {"iterations": 100, "tolerance": 1e-12},
                "SolverMuJoCo: iterations, tolerance",
            ),
            Knob("stiffness", {"hard": True}, "ShapeConfig: ke and kd, a solref of 2 dt"),
            Knob("friction", {"cone": "elliptic"}, "SolverMuJoCo: cone"),
            Knob("slip", {"impratio": 100.0}, "SolverMuJoCo: impratio"),
            Knob("integration", {"integrator": "implicitfast"}, "SolverMuJoCo: integrator"),
        ),
        {},
    ),
    "mjx": Entry(
        "MuJoCo MJX",
        "mjx",
        "mjx_jax",
        ("mujoco-mjx==3.17.0", "mujoco==3.17.0", "scipy"),
        (
            Knob(
                "iterations",
                {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-12},
                "MJX, Performance tuning: iterations and ls_iterations; tolerance as in MuJoCo",
            ),
            Knob("stiffness", {"hard": True}, "as MuJoCo"),
            Knob("friction", {"cone": "elliptic"}, "as MuJoCo"),
            Knob("slip", {"impratio": 100}, "as MuJoCo"),
            Knob("integration", {"double": True}, "MJX: float64 by jax_enable_x64"),
        ),
        {
            "substeps": NO_KNOB,
            "margin": "geoms have no margin and no rounding as shipped; no threshold of bounces",
            "sleep": "off as shipped",
            "damping": "0 as shipped",
        },
        patience=_GPU,
    ),
}
#: Engines that were tried and are not in the table, with the reason.
NOT_RUN: Mapping[str, str] = {
    "DART, PGS": "PgsBoxedLcpSolver has no constructor in Python",
    "newton, Kamino": "a step takes 45 to 59 ms on a CPU: nearly all cells would be too slow",
    "newton, SemiImplicit": "as Featherstone: explicit forces of contacts",
    "Genesis": "its first step compiles for more than 150 s on a CPU",
    "brax": "the step of ten boxes compiles for minutes on a CPU; its package is no longer maintained",
    "Exudyn, scenes with contacts": "contacts of boxes need meshes",
    "Simbody (opensim)": "installed; its contacts are of meshes and ellipsoids, no adapter yet",
    "Chrono": "no package with the engine: pychrono is another project, projectchrono a reserved name",
    "matter-js": "an adapter was written: with true moments of inertia its pendulum explodes, "
    "and neither motors nor belts can be expressed",
}
