"""Facts about arrays and files of other engines, each with a function that runs the engine and checks the fact.

docs/engine-arrays.md is written from this table by `python docs/generate.py --pages`.
"""

import contextlib
import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class EngineFact:
    """A fact about an engine, and the handling of it in lavender.

    Parameters
    ----------
    engine : str
    module : str
        Module that must be importable to run `probe`.
    version : str
        Version of the engine with which the fact was found.
    subject, text : str
        Arrays or settings, and what they hold.
    handling : str
        Effect on users of lavender, or how lavender handles it; "" if it does not read this engine's data.
    probe : callable
        Function that returns whether the fact still holds.
    """

    engine: str
    module: str
    version: str
    subject: str
    text: str
    handling: str
    probe: Callable[[], bool]


FACTS: list[EngineFact] = []


def fact(engine, module, version, subject, text, handling=""):
    """Return a decorator that adds a fact with the decorated function as its probe."""

    def add(probe):
        FACTS.append(EngineFact(engine, module, version, subject, text, handling, probe))
        return probe

    return add


# -- MuJoCo --------------------------------------------------------------------------------------------

MUJOCO = "MuJoCo", "mujoco", "4.0.0"


def make_mujoco(xml):
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    return model, mujoco.MjData(model)


def drop_box(option="", geom="", height=0.0999, extra="", size=".1 .1 .1"):
    """Return model and data of a box of 1 kg on a plane."""
    return make_mujoco(
        f"""<mujoco><option timestep="0.002" {option}</option><worldbody><geom type="plane" size="0 0 1" {geom}/>
        <body name="b" pos="0 0 {height}"><freejoint/><geom type="box" size="{size}" mass="1" {geom}/></body>
        </worldbody>{extra}</mujoco>"""
    )


def step_mujoco(model, data, n=1):
    import mujoco

    for _ in range(n):
        mujoco.mj_step(model, data)


@fact(
    *MUJOCO,
    "`margin`, `gap`",
    "The margins of the two geoms of a contact are added, and so are the gaps. A contact has rows below the sum of the "
    "margins. Up to the sum of the gaps above it, it is listed with `exclude` 1 and without rows.",
    "Only contacts with rows are read.",
)
def margins_are_added():
    import mujoco

    counts = []
    for distance in (0.019, 0.021, 0.035, 0.037):
        model, data = drop_box(">", 'margin="0.01" gap="0.008"', 0.1 + distance)
        mujoco.mj_forward(model, data)
        counts.append((data.ncon > 0, data.nefc > 0))
    return counts == [(True, True), (True, False), (True, False), (False, False)]


@fact(
    *MUJOCO,
    "sleeping trees",
    "Contacts and rows of a sleeping tree are absent, and `qacc` of a body that rests on the floor holds gravity.",
    "The problem has no rows of sleeping trees; do not compare its motion with `qacc`.",
)
def sleeping_trees_have_no_rows():
    model, data = drop_box('><flag sleep="enable"/>')
    step_mujoco(model, data, 100)
    return data.tree_asleep[0] >= 0 and data.nefc == 0 and data.ncon == 0 and data.qacc[2] == -9.81


@fact(
    *MUJOCO,
    "adhesion",
    "The pull of an adhesion actuator is in `qfrc_actuator`. The normal force of the contact is weight plus pull.",
    "The pull is part of the smooth force, so the impulses of contacts include it.",
)
def adhesion_is_an_actuator_force():
    extra = '<actuator><adhesion body="b" ctrlrange="0 1" gain="20"/></actuator>'
    model, data = drop_box(">", extra=extra)
    data.ctrl[0] = 1.0
    step_mujoco(model, data, 1000)
    found = data.qfrc_constraint[2], data.qfrc_actuator[2]
    return np.allclose(found, [29.81, -20.0], atol=1e-6)


@fact(
    *MUJOCO,
    "`noslip_iterations`",
    "`efc_force` holds the forces after the noslip pass, which do not solve the problem of the rows. A box that is "
    "pushed with 0.3 of its weight creeps with 0.8 mm/s with elliptic cones, and with less than 1e-6 m/s after 20 "
    "iterations.",
    "The name of the problem has the suffix (noslip), and the judge finds the error of these forces.",
)
def noslip_stops_creep():
    speeds = []
    for n in (0, 20):
        model, data = drop_box(f'cone="elliptic" noslip_iterations="{n}" gravity="3 0 -9.81">')
        step_mujoco(model, data, 500)
        speeds.append(abs(data.qvel[0]))
    return 5e-4 < speeds[0] < 2e-3 and speeds[1] < 1e-6


@fact(
    *MUJOCO,
    "`solref`",
    "A positive time constant below two time steps is raised to two time steps. Negative values (stiffness, damping) "
    "are used as given, however small the time step is.",
    "Both are contained in `efc_aref`, which is read.",
)
def only_time_constants_are_raised():
    import mujoco

    damping = []
    for solref in ("0.0001 1", "0.004 1", "-1e5 -3000"):
        model, data = drop_box(">", f'solref="{solref}"')
        mujoco.mj_forward(model, data)
        damping.append(data.efc_KBIP[0, 1])
    return damping[0] == damping[1] and np.isclose(damping[2], 3000.0 / 0.95)


@fact(
    *MUJOCO,
    "actuator `delay`",
    "A delay is limited by `nsample` time steps: 0.1 s with 3 samples of 2 ms acts after 3 steps.",
)
def delay_is_limited_by_samples():
    model, data = make_mujoco(
        """<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
        <actuator><motor joint="j" delay="0.1" nsample="3"/></actuator></mujoco>"""
    )
    data.ctrl[0] = 1.0
    steps = 0
    while data.actuator_force[0] == 0.0 and steps < 100:
        step_mujoco(model, data)
        steps += 1
    return steps == 4


def make_sheet(elastic, solver, iterations):
    """Return data of a moving sheet after a forward pass of the integrator "discrete"."""
    import mujoco

    model, data = make_mujoco(
        f"""<mujoco><option timestep="0.002" integrator="discrete" tolerance="1e-12" solver="{solver}"
        iterations="{iterations}"/><worldbody><flexcomp name="sheet" type="grid" count="4 4 1" spacing=".06 .06 .06"
        pos="0 0 .23" radius=".005" dim="2" mass=".2" dof="full"><contact selfcollide="none"/>
        <elasticity young="3e4" poisson="0.2" damping="0.01" thickness="4e-3" elastic2d="{elastic}"/></flexcomp>
        </worldbody></mujoco>"""
    )
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    mujoco.set_mju_user_warning(lambda text: None)  # Otherwise MuJoCo writes warnings to a file.
    mujoco.mj_forward(model, data)
    mujoco.set_mju_user_warning(None)
    return data


@fact(
    *MUJOCO,
    '`integrator="discrete"`: `efm_K`',
    'The stiffness of a flex that only bends is in `efm_K` with `solver="Newton"`, and is not stored with "CG".',
    "`from_mujoco` rejects such a step and names the flex and the solver.",
)
def bending_stiffness_is_stored_with_newton_only():
    return [make_sheet("bend", s, 300).efm_K_val.size > 0 for s in ("Newton", "CG")] == [True, False]


@fact(
    *MUJOCO,
    '`integrator="discrete"`: `iterations`',
    "The limit of the solver also limits the iteration that computes `qacc_smooth` with a flex. After one iteration, "
    "it is wrong by 1e-4 of its size.",
    "The exact `qacc_smooth` is computed; the problem does not depend on `iterations`.",
)
def iterations_limit_the_smooth_acceleration():
    early, exact = (make_sheet("bend", "Newton", n).qacc_smooth for n in (1, 300))
    return np.abs(early - exact).max() > 1e-5 * np.abs(exact).max()


# -- one URDF in several engines -----------------------------------------------------------------------

INERTIAL = (
    '<inertial><origin xyz="0.3 0 0"/><mass value="1"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
DYNAMICS = '<dynamics damping="2" friction="1"/>'
LIMIT = '<limit lower="-1" upper="1" effort="5" velocity="3"/>'


def write_urdf(kind="continuous", mimic=False, dynamics=""):
    """Return a URDF of a base and a pendulum, with a second link that mimics the first if `mimic` is set."""
    second = (
        f'<link name="b">{INERTIAL}</link><joint name="j2" type="revolute"><parent link="a"/><child link="b"/>'
        f'<axis xyz="0 1 0"/>{LIMIT}<mimic joint="j1" multiplier="2" offset="0.1"/></joint>'
    )
    return (
        f'<robot name="r"><link name="base">{INERTIAL}</link><link name="a">{INERTIAL}</link>'
        f'<joint name="j1" type="{kind}"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>{LIMIT}{dynamics}'
        f"</joint>{second if mimic else ''}</robot>"
    )


def make_drake(urdf, approximation=None):
    from pydrake.all import AddMultibodyPlantSceneGraph, DiagramBuilder, Parser

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    if approximation is not None:
        plant.set_discrete_contact_approximation(approximation)
    Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant


@fact(
    *MUJOCO,
    "URDF: limits of a continuous joint",
    "A continuous joint has no limits, also if the file has `lower` and `upper`.",
)
def mujoco_ignores_limits_of_continuous_joints():
    return not make_mujoco(write_urdf())[0].jnt_limited.any()


@fact(
    *MUJOCO,
    "URDF: `mimic`",
    "A mimic joint becomes a soft joint equality.",
    "The row has compliance like all rows of MuJoCo.",
)
def mujoco_makes_mimic_joints_soft():
    model, data = make_mujoco(write_urdf("revolute", mimic=True))
    import mujoco

    mujoco.mj_forward(model, data)
    return model.neq == 1 and np.allclose(model.eq_data[0, :2], [0.1, 2.0]) and data.efc_R[0] > 0.0


@fact(
    *MUJOCO,
    "URDF: `effort`, `velocity`, `friction`",
    "`effort` limits the actuator force of the joint, `friction` is friction loss, and `velocity` is dropped.",
)
def mujoco_reads_effort_and_friction():
    model, _ = make_mujoco(write_urdf("revolute", dynamics=DYNAMICS))
    return np.allclose(model.jnt_actfrcrange, [[-5, 5]]) and model.dof_frictionloss[0] == 1.0


DRAKE = "Drake", "pydrake", "1.51.1"


@fact(*DRAKE, "URDF: limits of a continuous joint", "`lower` and `upper` of a continuous joint are enforced.")
def drake_limits_continuous_joints():
    plant = make_drake(write_urdf())
    return plant.GetPositionLowerLimits()[0] == -1.0 and plant.GetPositionUpperLimits()[0] == 1.0


@fact(
    *DRAKE,
    "URDF: `mimic`",
    "A mimic joint is an exact constraint with the approximations kSap and kLagged, and is dropped with kTamsi.",
)
def drake_drops_mimic_with_tamsi():
    from pydrake.all import DiscreteContactApproximation as Approximation

    kinds = Approximation.kSap, Approximation.kLagged, Approximation.kTamsi
    return [make_drake(write_urdf("revolute", mimic=True), k).num_constraints() for k in kinds] == [1, 1, 0]


NEWTON = "newton", "newton", "1.8.0"


@fact(*NEWTON, "URDF: limits of a continuous joint", "`lower` and `upper` of a continuous joint become limits.")
def newton_limits_continuous_joints():
    import newton

    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_urdf(write_urdf())
        model = builder.finalize(device="cpu")
    return model.joint_limit_lower.numpy()[0] == -1.0 and model.joint_limit_upper.numpy()[0] == 1.0


# -- Pinocchio -----------------------------------------------------------------------------------------

PINOCCHIO = "Pinocchio", "pinocchio", "4.1.0"


@fact(
    *PINOCCHIO,
    "URDF: `mimic`",
    "A mimic joint is an independent joint unless `mimic=True` is passed; then it is exact.",
    "`from_pinocchio` has the joints of the model that you pass.",
)
def pinocchio_drops_mimic():
    import pinocchio

    urdf = write_urdf("revolute", mimic=True)
    return pinocchio.buildModelFromXML(urdf).nv == 2 and pinocchio.buildModelFromXML(urdf, mimic=True).nv == 1


@fact(
    *PINOCCHIO,
    "MJCF",
    "Ranges of slide joints in metres are multiplied by π/180 if the file uses degrees. Only the first body of the "
    "world is read, gravity of the file is replaced by 9.81 m/s² and joint equalities are not part of the model.",
    "Compare model.nq, gravity and limits with the file before `from_pinocchio`.",
)
def pinocchio_reads_part_of_mjcf():
    import pinocchio

    xml = """<mujoco model="m"><option gravity="0 0 -3"/><worldbody>
      <body name="one"><joint name="s" type="slide" axis="1 0 0" range="-1 2" limited="true"/>
        <geom type="sphere" size=".1" mass="1"/></body>
      <body name="two"><joint name="h" type="hinge"/><geom type="sphere" size=".1" mass="2"/></body>
    </worldbody><equality><joint joint1="s" joint2="h"/></equality></mujoco>"""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.xml")
        path.write_text(xml)
        model = pinocchio.buildModelFromMJCF(str(path))
    limits = model.lowerPositionLimit[0], model.upperPositionLimit[0]
    return model.nv == 1 and np.allclose(limits, np.deg2rad([-1, 2])) and model.gravity.linear[2] == -9.81


# -- MJX -----------------------------------------------------------------------------------------------

MJX = "MJX", "mujoco.mjx", "3.17.0"
IMPLEMENTATION = "_impl"  # Attribute of mjx.Data that holds the arrays of the rows.


def run_mjx(option=">", height=0.0999, n=0, velocity=0.0):
    """Return MuJoCo's model and the data of MJX after `n` steps, or after one forward pass."""
    import jax
    from mujoco import mjx

    model, _ = drop_box(option, height=height)
    device_model = mjx.put_model(model)
    data = mjx.make_data(device_model)
    data = data.replace(qvel=data.qvel.at[0].set(velocity))
    step = jax.jit(mjx.step if n else mjx.forward)
    for _ in range(max(n, 1)):
        data = step(device_model, data)
    return model, data


@fact(
    *MJX,
    "rows",
    "There is a fixed slot for each possible row. A slot without contact has a zero row of J and `efc_D` above 0.",
    "`from_efc` reads all slots; the impulses of unused ones are 0.",
)
def mjx_has_slots():
    data = getattr(run_mjx(height=5.0)[1], IMPLEMENTATION)
    return not np.asarray(data.efc_J).any() and (np.asarray(data.efc_D) > 0.0).all()


@fact(
    *MJX,
    "`mjx.get_data`",
    "The copy is in float32 precision, and `efc_R` and `efc_b` are not written.",
    "`from_mujoco` rejects such data and names float32 and `from_efc`.",
)
def mjx_get_data_leaves_arrays_unwritten():
    from mujoco import mjx

    model, data = run_mjx()
    copied = mjx.get_data(model, data)
    return copied.nefc > 0 and not np.isclose(copied.efc_R, 1.0 / copied.efc_D).any()


@fact(
    *MJX,
    "`noslip_iterations`",
    "The setting is accepted and has no effect.",
    "Impulses of MJX solve the problem of the rows.",
)
def mjx_ignores_noslip():
    gravity = 'cone="elliptic" gravity="3 0 -9.81"'
    speed = [float(run_mjx(f'{gravity} noslip_iterations="{n}">', n=100)[1].qvel[0]) for n in (0, 20)]
    return speed[0] == speed[1] > 1e-4


@fact(*MJX, '`integrator="discrete"`', "`put_model` accepts it, and the first step raises NotImplementedError.")
def mjx_has_no_discrete_integrator():
    try:
        run_mjx('integrator="discrete">', n=1)
    except NotImplementedError:
        return True
    return False


@fact(
    *MJX,
    "numbers that are not finite",
    "If a velocity is NaN, `qacc` is NaN and `efc_force` is 0.",
    "Pass `qacc` to `from_efc`: the impulses of such worlds are then NaN.",
)
def mjx_has_no_forces_with_nan():
    data = run_mjx(velocity=np.nan)[1]
    return bool(np.isnan(data.qacc).any()) and not np.asarray(getattr(data, IMPLEMENTATION).efc_force).any()


# -- PyBullet and SAPIEN -------------------------------------------------------------------------------

PYBULLET = "PyBullet", "pybullet", "3.2.7"


def make_pybullet(**settings):
    import pybullet

    if not pybullet.isConnected():
        pybullet.connect(pybullet.DIRECT)
    pybullet.resetSimulation()
    pybullet.setPhysicsEngineParameter(**settings)
    pybullet.setGravity(0, 0, -10)
    return pybullet


@fact(
    *PYBULLET,
    "`normalForce` of `getContactPoints`",
    "The force is divided by the number of substeps: the contacts of a box of 10 N add up to 2.5 N with 4 substeps.",
)
def pybullet_divides_forces_by_substeps():
    sums = []
    for n in (1, 4):
        bullet = make_pybullet(numSubSteps=n)
        bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE))
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[0.1] * 3)
        box = bullet.createMultiBody(1, shape, basePosition=[0, 0, 0.1])
        for _ in range(240):
            bullet.stepSimulation()
        sums.append(sum(point[9] for point in bullet.getContactPoints(box)))
    return np.allclose(sums, [10.0, 2.5], rtol=1e-3)


def load_pybullet(bullet, urdf, **options):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(urdf)
        return bullet.loadURDF(str(path), useFixedBase=True, **options)


@fact(
    *PYBULLET,
    "URDF: motors and inertias",
    "Each joint has a velocity motor that holds it until its force is set to 0. Inertias of the file are replaced by "
    "those of the collision shapes unless `URDF_USE_INERTIA_FROM_FILE` is passed.",
)
def pybullet_holds_joints():
    bullet, angles = make_pybullet(), []
    robot = load_pybullet(bullet, write_urdf("revolute"), flags=bullet.URDF_USE_INERTIA_FROM_FILE)
    inertia = bullet.getDynamicsInfo(robot, 0)[2]
    other = bullet.getDynamicsInfo(load_pybullet(bullet, write_urdf("revolute")), 0)[2]
    for force in (None, 0.0):
        if force is not None:
            bullet.setJointMotorControl2(robot, 0, bullet.VELOCITY_CONTROL, force=force)
        for _ in range(50):
            bullet.stepSimulation()
        angles.append(abs(bullet.getJointState(robot, 0)[0]))
    return angles[0] < 1e-6 < 0.1 < angles[1] and np.allclose(inertia, 0.01) and max(other) < 1e-5


@fact(
    "SAPIEN",
    "sapien",
    "3.0.3",
    "`get_contacts`",
    "Impulses of contact points have no friction part, and stay at their last values while a body sleeps.",
)
def sapien_impulses_have_no_friction():
    import sapien

    sapien.physx.set_default_material(1.0, 1.0, 0.0)
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(0.01)
    scene.add_ground(0, render=False)
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.1] * 3, density=125)  # 1 kg
    box = builder.build(name="box")
    box.set_pose(sapien.Pose([0, 0, 0.1]))
    body = box.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
    found = []
    for k in range(300):
        if k < 100:
            body.add_force_at_point([2, 0, 0], box.pose.p)
        scene.step()
        points = [p for contact in scene.physx_system.get_contacts() for p in contact.points]
        found.append(sum((np.array(p.impulse) for p in points), np.zeros(3)))
    return abs(found[99][0]) < 1e-6 < found[99][2] and body.is_sleeping and np.array_equal(found[298], found[299])
