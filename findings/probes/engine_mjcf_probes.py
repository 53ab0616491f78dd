"""Probes of masses, joints and inertias that engines read from MJCF and SDF files; see `engine_facts`."""

import contextlib
import io
import os
import tempfile
from pathlib import Path

import numpy as np
from engine_drake_probes import DRAKE
from engine_facts import fact
from engine_newton_probes import NEWTON
from engine_probes import MUJOCO, PINOCCHIO, PYBULLET, make_pybullet

DART = "DART", "dartpy", "6.20.0"
BOX3D = "Box3D (robox3d)", "robox3d", "0.1.0"
BODY = (
    '<mujoco model="m"><compiler {compiler}/>{defaults}<worldbody><body name="b">'
    '<joint name="j" {joint}/>{content}</body></worldbody></mujoco>'
)
BOX = '<geom type="box" size=".1 .1 .1" mass="2"/>'
FROM_TO = '<geom type="box" size=".05" fromto="0 0 0 .4 0 0" density="500"/>'


def write_mjcf(content, joint='axis="0 1 0"', compiler='angle="radian"', defaults=""):
    return BODY.format(content=content, joint=joint, compiler=compiler, defaults=defaults)


@contextlib.contextmanager
def write_file(text, name):
    """Yield the path of a file with this text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        path.write_text(text)
        yield str(path)


def read_pinocchio(text):
    import pinocchio

    with write_file(text, "model.xml") as path:
        return pinocchio.buildModelFromMJCF(path)


def read_drake_mass(text):
    from pydrake.all import MultibodyPlant, Parser

    plant = MultibodyPlant(0.01)
    Parser(plant).AddModelsFromString(text, "xml")
    plant.Finalize()
    return plant.GetBodyByName("b").get_mass(plant.CreateDefaultContext())


def read_newton(text):
    import newton

    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        builder.add_mjcf(text)
    return builder


@fact(
    *PINOCCHIO,
    "MJCF: classes of defaults",
    "Type and size of a geom and axis, range and armature of a joint are taken from the class. `mass` and `pos` of a "
    "geom and `pos` of a joint are not: a box of 3 kg, 0.1 m off, is a box of 8 kg in the origin.",
    "`lv.compare` shows other mass matrices. Write these attributes at the elements.",
)
def pinocchio_drops_mass_and_pos_of_classes():
    geom = 'type="box" size=".1 .1 .1" mass="3" pos=".1 0 0"'
    defaults = f'<default><default class="c"><geom {geom}/></default></default>'
    inertia = read_pinocchio(write_mjcf('<geom class="c"/>', defaults=defaults)).inertias[1]
    return np.isclose(inertia.mass, 8.0) and inertia.lever[0] == 0.0


@fact(
    *PINOCCHIO,
    "MJCF: `contype`, `limited`",
    "A geom with `contype` and `conaffinity` 0 has no mass, as in no other engine of this table, and a range with "
    '`limited="false"` is a limit.',
    "`from_pinocchio` gets this limit if you pass its constraint.",
)
def pinocchio_weighs_colliding_geoms():
    visual = '<geom type="box" size=".1 .1 .1" mass="2" contype="0" conaffinity="0"/>'
    text = write_mjcf(BOX + visual, joint='axis="0 1 0" limited="false" range="-.5 1"')
    model = read_pinocchio(text)
    return np.isclose(model.inertias[1].mass, 2.0) and model.upperPositionLimit[0] == 1.0


@fact(
    *DRAKE,
    "MJCF: `frame`, `fromto`, `boundmass`",
    "Geoms in a `frame`, and boxes and ellipsoids by `fromto`, are not read: a body of such geoms has no mass. "
    "`boundmass`, `settotalmass` and `inertiagrouprange` change nothing.",
    "`from_drake` has the mass matrix of the plant.",
)
def drake_drops_geoms_in_frames():
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
    masses = [
        read_drake_mass(write_mjcf(f'<frame pos="0 0 .1">{BOX}</frame>')),
        read_drake_mass(write_mjcf(FROM_TO)),
        read_drake_mass(write_mjcf(inertial, compiler='boundmass="9"')),
        read_drake_mass(write_mjcf(BOX, compiler='settotalmass="9"')),
    ]
    return np.allclose(masses, [0.0, 0.0, 1.0, 2.0])


@fact(
    *DRAKE,
    "MJCF: `gear`",
    "The gear of a motor scales the inertia of its rotor, not its torque: a control of 1 with gear 50 is 1 N m, and a "
    "`ctrlrange` of 2 limits the torque to 2 N m; in MuJoCo they are 50 and 100 N m. There is no warning.",
    "`from_drake` reads the torque that acts.",
)
def drake_drops_gear_of_torque():
    from pydrake.all import MultibodyPlant, Parser, Simulator

    mjcf = (
        '<mujoco model="m"><option gravity="0 0 0"/><worldbody><body name="b">'
        '<joint name="j" axis="0 1 0" armature=".01"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/></body></worldbody>'
        '<actuator><motor name="a" joint="j" gear="50" ctrlrange="-2 2"/></actuator></mujoco>'
    )
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModelsFromString(mjcf, "xml")
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.get_actuation_input_port().FixValue(context, [1.0])
    simulator.AdvanceTo(0.1)
    (actuator,) = (plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices())
    return (
        np.isclose(plant.CalcMassMatrix(context)[0, 0], 0.03)
        and np.isclose(plant.GetVelocities(context)[0], 0.1 / 0.03)
        and actuator.effort_limit() == 2.0
    )


@fact(
    *NEWTON,
    "MJCF: `fromto` of a box, `settotalmass`",
    "A box by `fromto` is a cube of its `size` in the origin of the body: 0.5 kg in place of 2 kg. `settotalmass` "
    "changes nothing. `boundmass`, `inertiagrouprange` and `frame` are read.",
)
def newton_reads_boxes_by_fromto_as_cubes():
    masses = [
        read_newton(write_mjcf(FROM_TO)).body_mass[0],
        read_newton(write_mjcf(BOX, compiler='settotalmass="9"')).body_mass[0],
        read_newton(write_mjcf(BOX, compiler='boundmass="9"')).body_mass[0],
        read_newton(write_mjcf(f'<frame pos="0 0 .1">{BOX}</frame>')).body_mass[0],
    ]
    return np.allclose(masses, [0.5, 2.0, 9.0, 2.0])


@fact(
    *NEWTON,
    "MJCF: passive joints in SolverXPBD",
    "`damping` and `stiffness` of a joint change nothing in SolverXPBD. SolverFeatherstone applies both, "
    "SolverMuJoCo also `frictionloss` and `gravcomp`.",
)
def newton_xpbd_drops_passive_joints():
    import newton

    speeds = []
    for joint in ("", 'damping="3" stiffness="30"'):
        content = '<inertial pos=".3 0 0" mass="1" diaginertia=".01 .02 .02"/>'
        model = read_newton(write_mjcf(content, joint=f'axis="0 1 0" {joint}')).finalize(
            device="cpu"
        )
        solver, before, after = newton.solvers.SolverXPBD(model), model.state(), model.state()
        for _ in range(20):
            solver.step(before, after, model.control(), None, 0.005)
            before, after = after, before
        speeds.append(before.body_qd.numpy()[0])
    return np.linalg.norm(speeds[0]) > 0.1 and np.array_equal(*speeds)


@fact(
    *MUJOCO,
    "`MjSpec.attach`: compiler settings",
    "`settotalmass` of the attached model is dropped. `boundmass` acts, and `to_xml` does not write it.",
    "`from_mujoco` has the masses of the compiled model.",
)
def mujoco_attach_drops_settotalmass():
    import mujoco

    masses = []
    for compiler in ('settotalmass="9"', 'boundmass="9"'):
        parent = mujoco.MjSpec.from_string(
            '<mujoco><worldbody><frame name="f"/></worldbody></mujoco>'
        )
        child = mujoco.MjSpec.from_string(write_mjcf(BOX, compiler=compiler))
        parent.attach(child, prefix="x-", frame=parent.frame("f"))
        masses.append(parent.compile().body_mass[1])
        masses.append(mujoco.MjModel.from_xml_string(parent.to_xml()).body_mass[1])
    return np.allclose(masses, [2.0, 2.0, 9.0, 2.0])


@fact(
    *PYBULLET,
    "MJCF: `mass`, `range`",
    "The mass of a box is its volume by 1,000 kg/m³, whatever `mass` is, and a range is read only with "
    '`limited="true"`.',
)
def pybullet_weighs_boxes_by_volume():
    bullet = make_pybullet()
    joint = 'type="hinge" axis="0 1 0" range="-.5 1"'
    with write_file(write_mjcf(BOX, joint=joint), f"model{os.getpid()}.xml") as path:
        body = bullet.loadMJCF(path)[0]
    mass = sum(bullet.getDynamicsInfo(body, i)[0] for i in range(-1, bullet.getNumJoints(body)))
    lower, upper = bullet.getJointInfo(body, 0)[8:10]
    return np.isclose(mass, 8.0) and lower > upper  # no limit


@fact(
    *DART,
    "MJCF: inertias, ranges, `freejoint`",
    "Each body has 1 kg m² about each axis. Ranges in degrees become limits in rad, a joint without a range is limited "
    "to 0, and a body with `freejoint` is fixed.",
)
def dart_reads_no_inertia():
    import dartpy

    text = write_mjcf(BOX, joint='type="hinge" axis="0 1 0" range="-30 60"', compiler="")
    with write_file(text, "model.xml") as path:
        skeleton = dartpy.utils.MjcfParser.readWorld(path).getSkeleton(0)
    return skeleton.getMassMatrix()[0, 0] == 1.0 and skeleton.getPositionUpperLimits()[0] == 60.0


@fact(
    *DART,
    "SDF: pose of an inertial",
    "The position is read and the rotation is dropped. The URDF reader reads both.",
)
def dart_drops_rotation_of_inertial():
    import dartpy

    text = (
        '<sdf version="1.6"><model name="m"><link name="a"><inertial><pose>.1 0 0 1.5707963 0 0</pose><mass>1</mass>'
        "<inertia><ixx>.02</ixx><iyy>.03</iyy><izz>.04</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
        "</link></model></sdf>"
    )
    with write_file(text, "model.sdf") as path:
        inertia = dartpy.utils.SdfParser.readSkeleton(path).getBodyNode(0).getInertia()
    return np.isclose(inertia.getMoment()[1, 1], 0.03) and np.isclose(inertia.getLocalCOM()[0], 0.1)


@fact(
    *BOX3D,
    "`normalImpulse`, `totalNormalImpulse`",
    "`normalImpulse` of a point is that of the last substep. `totalNormalImpulse` is twice the impulse of the step.",
    "The [page on reading a step](../read-a-step.md) records velocities instead.",
)
def box3d_doubles_total_impulse():
    import robox3d
    from robox3d._ffi import ffi, lib

    world = robox3d.World(gravity=(0.0, 0.0, -10.0), substeps=4)
    ground = world.create_body(position=(0.0, 0.0, -0.5), kind="static")
    ground.add_box((9.0, 9.0, 0.5))
    box = world.create_body(position=(0.0, 0.0, 0.5))
    box.add_box((0.5, 0.5, 0.5), density=1.0)
    for _ in range(200):
        world.step(0.01)
    capacity = lib.b3Body_GetContactCapacity(box.id)
    contacts = ffi.new("b3ContactData[]", capacity)
    assert lib.b3Body_GetContactData(box.id, contacts, capacity) == 1
    manifold = contacts[0].manifolds[0]
    points = manifold.points[0 : manifold.pointCount]
    sums = sum(p.normalImpulse for p in points), sum(p.totalNormalImpulse for p in points)
    return np.allclose(sums, (0.025, 0.2), atol=1e-4)
