"""Probes of how engines read URDF, MJCF and USD files; see `engine_facts`."""

import contextlib
import io
import tempfile
import warnings
from pathlib import Path

import numpy as np
from engine_drake_probes import DRAKE
from engine_facts import fact
from engine_newton_probes import NEWTON, NEWTON_MUJOCO
from engine_probes import (
    GENESIS,
    MUJOCO,
    PINOCCHIO,
    PYBULLET,
    SAPIEN,
    make_genesis,
    make_mujoco,
    make_pybullet,
)

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


@fact(
    *DRAKE,
    "URDF: limits of a continuous joint",
    "`lower` and `upper` of a continuous joint are enforced.",
)
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
    return [make_drake(write_urdf("revolute", mimic=True), k).num_constraints() for k in kinds] == [
        1,
        1,
        0,
    ]


@fact(
    *NEWTON,
    "URDF: limits of a continuous joint",
    "`lower` and `upper` of a continuous joint become limits.",
)
def newton_limits_continuous_joints():
    import newton

    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_urdf(write_urdf())
        model = builder.finalize(device="cpu")
    return model.joint_limit_lower.numpy()[0] == -1.0 and model.joint_limit_upper.numpy()[0] == 1.0


# -- Pinocchio -----------------------------------------------------------------------------------------


@fact(
    *PINOCCHIO,
    "URDF: `mimic`",
    "A mimic joint is an independent joint unless `mimic=True` is passed; then it is exact.",
    "`from_pinocchio` has the joints of the model that you pass.",
)
def pinocchio_drops_mimic():
    import pinocchio

    urdf = write_urdf("revolute", mimic=True)
    return (
        pinocchio.buildModelFromXML(urdf).nv == 2
        and pinocchio.buildModelFromXML(urdf, mimic=True).nv == 1
    )


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
    return (
        model.nv == 1
        and np.allclose(limits, np.deg2rad([-1, 2]))
        and model.gravity.linear[2] == -9.81
    )


def load_pybullet(bullet, urdf, **options):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(urdf)
        return bullet.loadURDF(str(path), useFixedBase=True, **options)


@fact(
    *PYBULLET,
    "URDF: motors and inertias",
    "Each joint has a velocity motor that holds it until its force is set to 0. Inertias of the file are replaced by "
    "inertias of the collision shapes unless `URDF_USE_INERTIA_FROM_FILE` is passed.",
)
def pybullet_holds_joints():
    bullet = make_pybullet()
    angles = []
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


# -- further files -------------------------------------------------------------------------------------

PENDULUM_MJCF = """<mujoco model="m"><compiler angle="radian"/><option gravity="0 0 -3"/><worldbody><body name="a">
  <joint name="h" axis="0 1 0" {joint}/><geom type="sphere" pos=".3 0 0" size=".05" mass="1"/></body></worldbody>
  {extra}</mujoco>"""


@fact(
    *DRAKE,
    "MJCF",
    "Gravity, damping, limits and sliding friction are read. `armature` of a joint is dropped unless an actuator "
    "drives the joint. `stiffness`, `frictionloss` and joint equalities are dropped with a warning.",
    "`from_drake` has the mass matrix and the constraints of the plant.",
)
def drake_drops_armature_without_actuator():
    from pydrake.all import MultibodyPlant, Parser

    inertia = []
    for extra in ("", '<actuator><motor joint="h"/></actuator>'):
        plant = MultibodyPlant(0.01)
        text = PENDULUM_MJCF.format(
            joint='armature="0.5" damping="0.7" range="-1 2" limited="true"', extra=extra
        )
        Parser(plant).AddModelsFromString(text, "xml")
        plant.Finalize()
        context = plant.CreateDefaultContext()
        inertia.append(float(plant.CalcMassMatrix(context)[0, 0]))
        is_read = (
            plant.gravity_field().gravity_vector()[2] == -3.0
            and plant.GetPositionLowerLimits()[0] == -1.0
        )
    return is_read and np.isclose(inertia[1] - inertia[0], 0.5)


@fact(
    *GENESIS,
    "URDF and MJCF: `armature`",
    "A joint without `armature` gets 0.1 kg m² unless `default_armature=0.0` is passed. A pendulum of 0.09 kg m² "
    "accelerates with less than half of the acceleration in MuJoCo. Gravity of the file is ignored.",
    "The mass matrix of the scene, with this armature, is read.",
)
def genesis_adds_armature():
    inertia = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "pendulum.xml")
        path.write_text(PENDULUM_MJCF.format(joint="", extra=""))
        for options in ({}, {"default_armature": 0.0}):
            scene = make_genesis(
                (lambda morphs, options=options: morphs.MJCF(file=str(path), **options), {})
            )
            inertia.append(float(scene.entities[0].get_dofs_armature()[0]))
    return np.allclose(inertia, [0.1, 0.0])


@fact(
    *SAPIEN,
    "URDF: `mimic`, `effort`, `friction`",
    "All three are dropped: a mimic joint is independent, forces are not limited, and the friction of joints is 0.05.",
)
def sapien_drops_mimic_effort_and_friction():
    import sapien

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(write_urdf("revolute", mimic=True, dynamics=DYNAMICS))
        loader = sapien.Scene([sapien.physx.PhysxCpuSystem()]).create_urdf_loader()
        loader.fix_root_link = True
        first = (robot := loader.load(str(path))).get_active_joints()[0]
    return (
        robot.dof == 2
        and first.force_limit > 1e30
        and np.isclose(first.friction, 0.05)
        and first.damping == 2.0
    )


def make_kamino(urdf, has_drive=False):
    """Return newton's model of one world, and its SolverKamino."""
    import newton
    import warp

    warp.config.quiet = True
    builder, world = newton.ModelBuilder(), newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        for item in (builder, world):
            newton.solvers.SolverKamino.register_custom_attributes(item)
        world.add_urdf(urdf)
        if not has_drive:
            world.joint_target_mode = [int(newton.JointTargetMode.NONE)] * len(
                world.joint_target_mode
            )
        builder.add_world(world)
        model = builder.finalize(device="cpu")
        return model, newton.solvers.SolverKamino(model)


@fact(
    *NEWTON,
    "URDF: joints without a drive",
    "`add_urdf` gives them the target mode POSITION with gain 0, which SolverKamino rejects with a ValueError. Set "
    "`builder.joint_target_mode` to NONE.",
    "`from_kamino` reads such models after this change.",
)
def kamino_rejects_urdf_joints_without_a_drive():
    make_kamino(write_urdf("revolute"))
    try:
        make_kamino(write_urdf("revolute"), has_drive=True)
    except ValueError as error:
        return "POSITION" in str(error)
    return False


@fact(
    *NEWTON,
    "URDF: `mimic`",
    "SolverKamino has no row for a mimic joint, without a warning. SolverMuJoCo, XPBD, Featherstone, Steel and VBD "
    "couple the joints.",
    "The problem of `from_kamino` does not couple them either.",
)
def kamino_drops_mimic():
    import newton

    model, solver = make_kamino(write_urdf("revolute", mimic=True))
    before, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, before)
    for _ in range(20):
        solver.step(before, after, control, None, 0.01)
        before, after = after, before
    # The rotations about y of both links; the pendulums move, and the second angle is not 2 q + 0.1.
    quaternions = before.body_q.numpy()[-2:, 3:]
    first, second = 2.0 * np.arctan2(quaternions[:, 1], quaternions[:, 3])
    return (
        model.joint_dof_count == 2
        and first > 0.01
        and abs(second - first - (2.0 * first + 0.1)) > 0.05
    )


@fact(
    "newton",
    "newton pxr newton_usd_schemas",
    "1.8.0",
    "USD: `physics:staticFriction`",
    "Static friction of a material is dropped, and dynamic friction becomes the coefficient of the shape.",
)
def newton_drops_static_friction():
    import newton
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    material = UsdShade.Material.Define(stage, "/material")
    friction = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    friction.CreateStaticFrictionAttr(0.9)
    friction.CreateDynamicFrictionAttr(0.2)
    box = UsdGeom.Cube.Define(stage, "/box").GetPrim()
    for schema in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI, UsdPhysics.MassAPI):
        schema.Apply(box)
    UsdShade.MaterialBindingAPI.Apply(box).Bind(
        material, UsdShade.Tokens.weakerThanDescendants, "physics"
    )
    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_usd(stage)
    return np.allclose(builder.shape_material_mu, [0.2])


@fact(
    *NEWTON_MUJOCO,
    "`save_to_mjcf` of SolverMuJoCo",
    "`solreflimit` is not written: joint limits have MuJoCo's default of 0.02 s in the file, and the stiffness and "
    "damping of `limit_ke` and `limit_kd` in the solver. The time step of the file is 2 ms.",
    "`from_mujoco` reads the limits of the file, and `from_newton_mujoco` reads the limits of the solver.",
)
def newton_drops_limit_stiffness_in_mjcf():
    import mujoco
    import newton

    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_urdf(write_urdf("revolute"))
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # newton 1.8 warns of newer versions of MuJoCo.
        path = str(Path(folder, "model.xml"))
        solver = newton.solvers.SolverMuJoCo(builder.finalize(device="cpu"), save_to_mjcf=path)
        model = mujoco.MjModel.from_xml_path(path)
    used = solver.mjw_model.jnt_solref.numpy().reshape(-1, 2)[0]
    return np.allclose(model.jnt_solref[0], [0.02, 1.0]) and not np.allclose(
        used, [0.02, 1.0], rtol=0.1
    )


@fact(
    "newton",
    "newton pxr urdf_usd_converter",
    "1.8.0",
    "URDF converted by urdf-usd-converter 0.3.4",
    "`effort` of a joint is stored as `urdf:limit:effort`, which `add_usd` does not read: the limit is 1e6 in place of "
    "5. `add_urdf` reads it.",
    "The problem has the limits of the model, so compare `joint_effort_limit` with the file.",
)
def newton_loses_effort_limits_in_usd():
    import newton
    import urdf_usd_converter
    from pxr import Usd

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder, "robot.urdf")
        path.write_text(write_urdf("revolute"))
        converted = urdf_usd_converter.Converter().convert(str(path), str(Path(folder, "usd")))
        by_usd, by_urdf = newton.ModelBuilder(), newton.ModelBuilder()
        by_usd.add_usd(Usd.Stage.Open(converted.path))
        by_urdf.add_urdf(write_urdf("revolute"))
    return max(by_usd.joint_effort_limit) == 1e6 and max(by_urdf.joint_effort_limit) == 5.0
