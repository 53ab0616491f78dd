"""Probes of arrays and settings of engines; see `engine_facts`."""

import contextlib
import io

import numpy as np
from engine_facts import fact

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
    return [make_sheet("bend", s, 300).efm_K_val.size > 0 for s in ("Newton", "CG")] == [
        True,
        False,
    ]


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


@fact(
    *MUJOCO,
    "meshes that touch at a point",
    "Two cones of 16 sides with touching tips have four contacts at one point with a common normal that is tilted by "
    "45 degrees, although the scene is symmetric. At a distance of 1 mm, they have one contact with a vertical normal.",
    "Rows of such contacts repeat each other: impulses are not unique, velocities are.",
)
def tips_have_tilted_repeated_contacts():
    import mujoco

    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.0 * angle], axis=1)
    up, down = (
        " ".join(f"{x:.6f}" for x in np.vstack([ring, [[0.0, 0.0, tip]]]).ravel())
        for tip in (0.1, -0.1)
    )
    found = []
    for gap in (0.001, 0.0):
        model, data = make_mujoco(
            f"""<mujoco><asset><mesh name="u" vertex="{up}"/><mesh name="d" vertex="{down}"/></asset><worldbody>
            <geom type="mesh" mesh="u" margin="0.002"/><body pos="0 0 {0.2 + gap}"><freejoint/>
            <geom type="mesh" mesh="d" mass="1"/></body></worldbody></mujoco>"""
        )
        mujoco.mj_forward(model, data)
        found.append((data.ncon, data.contact.frame[:, :3], np.ptp(data.contact.pos, axis=0).max()))
    (n_apart, apart, _), (n_touching, touching, spread) = found
    return (
        n_apart == 1 < n_touching
        and np.allclose(apart, [0.0, 0.0, 1.0])
        and np.allclose(touching, touching[0], atol=1e-6)
        and abs(touching[0, 2]) < 0.9
        and spread < 1e-6
    )


@fact(
    *MUJOCO,
    "rolling friction",
    "It is viscous: at 1 m/s, a ball with the default coefficient gets 5 % of μ N from pyramidal cones and 11 % from "
    "elliptic ones, and rolls down a slope on which Coulomb's law holds it.",
    "The compliance of the rows is the cause: an exact solution of the problem creeps, too.",
)
def rolling_friction_is_viscous():
    ratios = []
    for cone in ("pyramidal", "elliptic"):
        model, data = make_mujoco(
            f"""<mujoco><option timestep="0.002" cone="{cone}"/><worldbody><geom type="plane" size="0 0 1" condim="6"/>
            <body pos="0 0 .1"><freejoint/><geom type="sphere" size=".1" mass="1" condim="6"/></body></worldbody>
            </mujoco>"""
        )
        data.qvel[[0, 4]] = 1.0, 10.0
        step_mujoco(model, data, 100)
        before = data.qvel[0]
        step_mujoco(model, data, 100)
        moment = (
            1.4 * 0.1 * (before - data.qvel[0]) / 0.2
        )  # Of a solid sphere of 1 kg and 0.1 m, about the contact.
        ratios.append(moment / (model.geom_friction[0, 2] * 9.81))
    return np.allclose(ratios, [0.05, 0.113], rtol=0.1)


@fact(
    *MUJOCO,
    "first friction coefficient",
    "On a horizontal plane, the first of the two coefficients of sliding acts along the y axis of the world, because "
    "`frame` of the contact begins with z, y, -x.",
    "Blocks have the tangents of `frame`, and each its own coefficient.",
)
def first_friction_coefficient_acts_along_y():
    speeds = []
    for axis in (0, 1):
        gravity = np.array([0.0, 0.0, -9.81])
        gravity[axis] = 4.0
        model, data = make_mujoco(
            f"""<mujoco><option timestep="0.002" cone="elliptic" gravity="{gravity[0]} {gravity[1]} {gravity[2]}"/>
            <worldbody><geom name="p" type="plane" size="0 0 1"/><body pos="0 0 .1"><freejoint/>
            <geom name="b" type="box" size=".1 .1 .1" mass="1"/></body></worldbody><contact>
            <pair geom1="p" geom2="b" condim="4" friction="0.9 0.1 0.005 0.0001 0.0001"/></contact></mujoco>"""
        )
        step_mujoco(model, data, 500)
        speeds.append(data.qvel[axis])
    return speeds[0] > 2.5 and abs(speeds[1]) < 0.01


@fact(
    *MUJOCO,
    "`margin` of a joint limit",
    "The joint rests at its range minus the margin, not at its range: at 0.95 m with a range of 1 m and 0.05 m.",
    "The target velocity of the row contains the margin.",
)
def margin_moves_the_limit():
    model, data = make_mujoco(
        """<mujoco><worldbody><body><joint type="slide" axis="0 0 -1" range="-1 1" limited="true" margin="0.05"/>
        <geom size=".1" mass="1"/></body></worldbody></mujoco>"""
    )
    step_mujoco(model, data, 4000)
    return abs(data.qpos[0] - 0.95) < 0.001


@fact(
    *MUJOCO,
    "mass changed at run time",
    "Without `mj_setConst`, the compliance of contacts still belongs to the old mass: with 100 times the mass, a box "
    "rests 45 times as deep.",
    "Compliances are read as used, so call `mj_setConst` before `from_mujoco` after such a change.",
)
def compliance_belongs_to_the_old_mass():
    depths = []
    for is_updated in (True, False):
        model, data = drop_box(">", height=0.1)
        model.body_mass[1] *= 100.0
        model.body_inertia[1] *= 100.0
        if is_updated:
            import mujoco

            mujoco.mj_setConst(model, data)
            mujoco.mj_resetData(model, data)
        step_mujoco(model, data, 1500)
        depths.append(0.1 - data.qpos[2])
    return 40.0 < depths[1] / depths[0] < 50.0


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
    speed = [
        float(run_mjx(f'{gravity} noslip_iterations="{n}">', n=100)[1].qvel[0]) for n in (0, 20)
    ]
    return speed[0] == speed[1] > 1e-4


@fact(
    *MJX,
    '`integrator="implicitfast"`',
    "It leaves out the derivative of gyroscopic forces, which MuJoCo's and MuJoCo Warp's contain: a box that tumbles "
    "with 20 rad/s, in steps of 5 ms, has 1.22 times its energy after 2 s, and 0.83 times in MuJoCo.",
    "`step_from_mjx` records the velocities of MJX itself.",
)
def mjx_implicitfast_leaves_out_gyroscopic_forces():
    import jax
    import mujoco
    from mujoco import mjx

    spin = np.array([1.0, 20.0, 1.0])
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/><worldbody><body><freejoint/>'
        '<geom type="box" size=".05 .1 .15" mass="1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[3:] = spin
    state, device_model, step = mjx.put_data(model, data), mjx.put_model(model), jax.jit(mjx.step)
    for _ in range(400):
        mujoco.mj_step(model, data)
        state = step(device_model, state)
    energies = [
        model.body_inertia[1] @ np.asarray(v)[3:] ** 2 / (model.body_inertia[1] @ spin**2)
        for v in (data.qvel, state.qvel)
    ]
    return np.allclose(energies, [0.83, 1.22], atol=0.01)


@fact(
    *MJX,
    '`integrator="discrete"`',
    "`put_model` accepts it, and the first step raises NotImplementedError.",
)
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
    return (
        bool(np.isnan(data.qacc).any())
        and not np.asarray(getattr(data, IMPLEMENTATION).efc_force).any()
    )


@fact(
    *MJX,
    "`surfacevel`, actuator `delay`, sleep flag",
    "All three are accepted and not simulated: a moving surface is at rest, an actuator acts at once, and bodies "
    "do not sleep.",
    "`lavender audit --engine mjx` names the settings of the model that MJX does not simulate.",
)
def mjx_ignores_surfaces_delays_and_sleep():
    import jax
    from mujoco import mjx

    model, _ = make_mujoco(
        """<mujoco><option timestep="0.002"><flag sleep="enable"/></option><worldbody>
        <geom type="plane" size="0 0 1" surfacevel="0.5 0 0 0 0 0"/><body pos="0 0 .0999"><freejoint/>
        <geom type="box" size=".1 .1 .1" mass="1"/></body><body pos="0 0 1"><joint name="j" type="slide"/>
        <geom size=".1" mass="1"/></body></worldbody>
        <actuator><motor joint="j" delay="0.1" nsample="50"/></actuator></mujoco>"""
    )
    device_model = mjx.put_model(model)
    data = mjx.make_data(device_model)
    data = data.replace(ctrl=data.ctrl.at[0].set(1.0))
    step = jax.jit(mjx.step)
    forces = []
    for _ in range(60):
        data = step(device_model, data)
        forces.append(float(data.actuator_force[0]))
    normal = float(np.sum(np.asarray(getattr(data, IMPLEMENTATION).efc_force)))
    return forces[0] == 1.0 and abs(float(data.qvel[0])) < 0.01 and abs(normal - 9.81) < 0.5


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


@fact(
    *PYBULLET,
    "friction of two shapes",
    "The product of both coefficients acts: 0.2 and 0.8 give 0.16, and 0.5 and 0.5 give 0.25.",
)
def pybullet_multiplies_friction():
    ratios = []
    for pair in ((0.2, 0.8), (0.5, 0.5)):
        bullet = make_pybullet(fixedTimeStep=0.005)
        bullet.setGravity(9.0, 0.0, -10.0)
        shapes = (
            bullet.createCollisionShape(bullet.GEOM_PLANE),
            bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.1),
        )
        bodies = (
            bullet.createMultiBody(0, shapes[0]),
            bullet.createMultiBody(1, shapes[1], basePosition=[0, 0, 0.1]),
        )
        for body, friction in zip(bodies, pair, strict=True):
            bullet.changeDynamics(body, -1, lateralFriction=friction)
        for _ in range(60):
            bullet.stepSimulation()
        (point,) = bullet.getContactPoints(bodies[1])
        ratios.append(np.hypot(point[10], point[12]) / point[9])
    return np.allclose(ratios, [0.16, 0.25], rtol=1e-2)


@fact(
    *PYBULLET,
    "`getConstraintState`",
    "Point-to-point and fixed constraints have opposite signs: a body of 10 N that hangs below a fixed body has +10 N "
    "along z with the first and -10 N with the second.",
)
def pybullet_constraint_forces_have_two_signs():
    forces = []
    for kind in ("JOINT_POINT2POINT", "JOINT_FIXED"):
        bullet = make_pybullet()
        shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.1)
        upper, lower = (
            bullet.createMultiBody(mass, shape, basePosition=[0, 0, z])
            for mass, z in ((0, 1.0), (1, 0.5))
        )
        ends = [0, 0, -0.25], [0, 0, 0.25]
        constraint = bullet.createConstraint(
            upper, -1, lower, -1, getattr(bullet, kind), [0, 0, 0], *ends
        )
        for _ in range(240):
            bullet.stepSimulation()
        forces.append(bullet.getConstraintState(constraint)[2])
    return np.allclose(forces, [10.0, -10.0], atol=0.01)


SAPIEN = "SAPIEN", "sapien", "3.0.3"


@fact(
    *SAPIEN,
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
    return (
        abs(found[99][0]) < 1e-6 < found[99][2]
        and body.is_sleeping
        and np.array_equal(found[298], found[299])
    )


# -- MuJoCo Warp ---------------------------------------------------------------------------------------

WARP = "MuJoCo Warp", "mujoco_warp", "4.0.0"


def run_warp(option=">", n=1, **sizes):
    """Return MuJoCo's model and the data of MuJoCo Warp after `n` steps of a box on a plane."""
    import mujoco_warp
    import warp

    warp.config.quiet = True
    model, data = drop_box(option)
    with contextlib.redirect_stdout(io.StringIO()), warp.ScopedDevice("cpu"):
        device_model = mujoco_warp.put_model(model)
        device_data = mujoco_warp.make_data(model, **sizes)
        for _ in range(n):
            mujoco_warp.step(device_model, device_data)
    return model, data, device_data


@fact(
    *WARP,
    "`nacon`, `nefc`",
    "Both are the numbers that the step needed. If `nacon` exceeds the number of stored contacts, the others have no "
    "rows, and `nefc` does not count these rows. If `nefc` exceeds the number of stored rows, the last are dropped.",
    '`from_newton_mujoco` reports both as "dropped_contacts" and "dropped_rows" in `claims.residuals`.',
)
def warp_counts_what_it_drops():
    few_contacts, few_rows = run_warp(nconmax=2, njmax=64)[2], run_warp(nconmax=64, njmax=8)[2]
    counts = [(int(d.nacon.numpy()[0]), int(d.nefc.numpy()[0])) for d in (few_contacts, few_rows)]
    return counts == [(4, 8), (4, 16)]


@fact(
    *WARP,
    "`get_data_into`",
    "The copy is in float32 precision, and `efc_R` is not written.",
    "`from_mujoco` rejects such data and names float32 and `from_efc`.",
)
def warp_get_data_leaves_arrays_unwritten():
    import mujoco_warp

    model, data, device_data = run_warp(nconmax=64, njmax=64)
    mujoco_warp.get_data_into(data, model, device_data)
    return data.nefc > 0 and not np.isclose(data.efc_R, 1.0 / data.efc_D).any()


@fact(
    *WARP,
    "`noslip_iterations`",
    "The pass is applied, as in MuJoCo and unlike in MJX.",
    "Impulses of such steps do not solve the problem of the rows, and the judge finds their error.",
)
def warp_applies_noslip():
    speeds = []
    for n in (0, 20):
        option = f'cone="elliptic" noslip_iterations="{n}" gravity="3 0 -9.81">'
        speeds.append(abs(float(run_warp(option, 200, nconmax=64, njmax=64)[2].qvel.numpy()[0, 0])))
    return speeds[1] < 1e-6 < 5e-4 < speeds[0]


@fact(
    *WARP,
    "arrays beyond `nefc` and `nacon`",
    "They hold the rows, forces and distances of earlier steps: 9.8 N for a box that has been lifted off the floor.",
    "Pass `nefc` and the first `nacon` contacts to `from_efc`; without `nefc`, it rejects forces that do not belong to "
    "`qacc`.",
)
def warp_leaves_old_rows():
    import mujoco_warp
    import warp

    model, _, data = run_warp(n=20, nconmax=64, njmax=64)
    position = data.qpos.numpy()
    position[0, 2] = 5.0
    with warp.ScopedDevice("cpu"):
        data.qpos.assign(position)
        mujoco_warp.step(mujoco_warp.put_model(model), data)
    counts = [data.nefc.numpy()[0], data.nacon.numpy()[0]]
    force = data.efc.force.numpy()[0].sum()
    return counts == [0, 0] and 8.0 < force < 12.0 and data.contact.dist.numpy()[0] < 0.0


@fact(
    *WARP,
    "`tolerance`",
    "A tolerance below 1e-6 is raised to 1e-6.",
    "The judge reports the error of the impulses, whatever the tolerance.",
)
def warp_raises_the_tolerance():
    import mujoco_warp
    import warp

    model, _ = drop_box('tolerance="1e-10">')
    with warp.ScopedDevice("cpu"):
        return np.isclose(mujoco_warp.put_model(model).opt.tolerance.numpy()[0], 1e-6)


@fact(
    *WARP,
    "contacts of two boxes",
    "A box that is turned by 45° on a box of the same size has 4 contacts, and 8 in MuJoCo.",
    "Do not compare impulses of single contacts between the two.",
)
def warp_has_fewer_contacts_of_boxes():
    import mujoco
    import mujoco_warp
    import warp

    turn = np.pi / 8
    model, data = make_mujoco(
        f"""<mujoco><worldbody><geom type="box" size=".1 .1 .1"/><body pos="0 0 .1999"
        quat="{np.cos(turn)} 0 0 {np.sin(turn)}"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
        </worldbody></mujoco>"""
    )
    mujoco.mj_forward(model, data)
    with warp.ScopedDevice("cpu"):
        device_data = mujoco_warp.make_data(model, nconmax=64, njmax=256)
        mujoco_warp.forward(mujoco_warp.put_model(model), device_data)
    return data.ncon == 8 and device_data.nacon.numpy()[0] == 4


# -- Pinocchio -----------------------------------------------------------------------------------------

PINOCCHIO = "Pinocchio", "pinocchio", "4.1.0"


def solve_pinocchio(kind, delassus, **options):
    """Return the impulses (3,) and the result of one contact with free velocity (2, 0, -1) m/s, tangents first."""
    import pinocchio

    model = pinocchio.Model()
    joint = model.addJoint(0, pinocchio.JointModelFreeFlyer(), pinocchio.SE3.Identity(), "body")
    models, datas = pinocchio.StdVec_ConstraintModel(), pinocchio.StdVec_ConstraintData()
    contact = pinocchio.PointContactConstraintModel(model, joint)
    contact.setFriction(0.5)
    models.append(pinocchio.ConstraintModel(contact))
    datas.append(pinocchio.ConstraintData(contact.createData()))
    settings, result = (
        getattr(pinocchio, f"{kind}Solver{word}")() for word in ("Settings", "Result")
    )
    for name, value in options.items():
        setattr(settings, name, value)
    matrix = pinocchio.DelassusOperatorDense(np.asfortranarray(delassus))
    solver = getattr(pinocchio, f"{kind}ConstraintSolver")(3)
    solver.solve(matrix, np.array([2.0, 0.0, -1.0]), models, datas, settings, result)
    return np.array(result.retrieveConstraintImpulses()), result


@fact(
    *PINOCCHIO,
    "`solve_ncp`",
    "With `solve_ncp=False`, ADMM solves the convex relaxation, and PGS still solves Coulomb's law.",
    'Compare impulses of PGS with the law "coulomb" only.',
)
def pinocchio_pgs_ignores_solve_ncp():
    found = [
        solve_pinocchio(k, np.eye(3), solve_ncp=ncp)[0][2]
        for k in ("ADMM", "PGS")
        for ncp in (True, False)
    ]
    return np.allclose(found, [1.0, 1.6, 1.0, 1.0], atol=1e-4)


@fact(
    *PINOCCHIO,
    "tolerances of ADMM",
    "A tolerance is met if the absolute or the relative one is, and the absolute ones do not scale with the mass. A "
    "body of 1 mg that hits the ground with 1 m/s counts as converged, with `dual_feasibility` 2e-8, while it still "
    "moves into the ground with 0.04 m/s.",
    "The judge reports the velocity error of such impulses.",
)
def pinocchio_tolerances_are_absolute():
    impulse, result = solve_pinocchio("ADMM", 1e6 * np.eye(3))
    velocity = 1e6 * impulse[2] - 1.0
    return result.converged and result.dual_feasibility < 1e-6 and velocity < -0.01


@fact(
    *PINOCCHIO,
    "joint friction",
    "`JointFrictionConstraintModel` bounds its impulse by limit times its own time step, which is 1 s until "
    "`setTimeStep` is called, whatever the step of the simulation is.",
    "`from_pinocchio` uses its argument `dt`: call `setTimeStep(dt)` before you compare impulses.",
)
def pinocchio_joint_friction_has_its_own_time_step():
    import pinocchio

    model = pinocchio.Model()
    joint = model.addJoint(0, pinocchio.JointModelPX(), pinocchio.SE3.Identity(), "joint")
    impulses = []
    for dt in (None, 0.01):
        models, datas = pinocchio.StdVec_ConstraintModel(), pinocchio.StdVec_ConstraintData()
        friction = pinocchio.JointFrictionConstraintModel(
            model, [joint], np.array([-2.0]), np.array([2.0])
        )
        if dt is not None:
            friction.setTimeStep(dt)
        models.append(pinocchio.ConstraintModel(friction))
        datas.append(pinocchio.ConstraintData(friction.createData()))
        settings, result = pinocchio.PGSSolverSettings(), pinocchio.PGSSolverResult()
        matrix = pinocchio.DelassusOperatorDense(np.asfortranarray(np.eye(1)))
        pinocchio.PGSConstraintSolver(1).solve(
            matrix, np.array([-100.0]), models, datas, settings, result
        )
        impulses.append(result.retrieveConstraintImpulses()[0])
    return np.allclose(impulses, [2.0, 0.02])


# -- Genesis -------------------------------------------------------------------------------------------

GENESIS = "Genesis", "genesis", "1.4.5"


def make_genesis(*entities, gravity=(0.0, 0.0, -9.81)):
    """Return a built scene with the given (morph, options of the material)."""
    import genesis

    if not getattr(genesis, "_initialized", False):
        genesis.init(backend=genesis.cpu, logging_level="error")
    options = genesis.options.SimOptions(dt=0.005, gravity=gravity)
    scene = genesis.Scene(show_viewer=False, sim_options=options)
    for morph, material in entities:
        scene.add_entity(morph(genesis.morphs), material=genesis.materials.Rigid(**material))
    scene.build()
    return scene


@fact(
    *GENESIS,
    "friction, `get_contacts`",
    "The larger of the two friction coefficients acts. `force_a` is the force on `link_a` in N, with friction.",
    "Both are contained in the rows, which are read.",
)
def genesis_uses_the_larger_friction():
    def floor(morphs):
        return morphs.Plane()

    def box(morphs):
        return morphs.Box(size=(0.2,) * 3, pos=(0, 0, 0.1))

    scene = make_genesis(
        (floor, {"friction": 0.2}), (box, {"friction": 0.8, "rho": 125}), gravity=(5.0, 0.0, -10.0)
    )
    for _ in range(80):
        scene.step()
    plane, body = scene.entities
    force = np.asarray(body.get_contacts(with_entity=plane)["force_a"]).sum(axis=0)
    return np.allclose(force, [5.0, 0.0, -10.0], atol=1e-2) and abs(float(body.get_vel()[0])) < 0.01


# -- Box2D and Siconos ---------------------------------------------------------------------------------


@fact(
    "Box2D",
    "box2d._box2d",
    "3.1.0",
    "`normalImpulse` of `b2ManifoldPoint`",
    "The impulse is that of the last substep: with 4 substeps, the points of a resting box add up to a quarter of its "
    "weight times the time step. Without warm starting, they add up to the full amount.",
)
def box2d_impulses_are_of_the_last_substep():
    from box2d import _box2d

    lib, ffi = _box2d.lib, _box2d.ffi

    def add_box(world, kind, y, half_width, half_height):
        body, shape = (
            ffi.new("b2BodyDef*", lib.b2DefaultBodyDef()),
            ffi.new("b2ShapeDef*", lib.b2DefaultShapeDef()),
        )
        body.type = kind
        body.position.y = y
        shape.density = 1.0
        polygon = ffi.new("b2Polygon*", lib.b2MakeBox(half_width, half_height))
        return lib.b2CreatePolygonShape(lib.b2CreateBody(world, body), shape, polygon)

    sums = []
    for n, has_warm_start in ((1, True), (4, True), (4, False)):
        definition = ffi.new("b2WorldDef*", lib.b2DefaultWorldDef())
        definition.gravity.y = -10.0
        definition.enableSleep = False
        world = lib.b2CreateWorld(definition)
        lib.b2World_EnableWarmStarting(world, has_warm_start)
        add_box(world, 0, -1.0, 50.0, 1.0)
        shape = add_box(world, 2, 0.5, 0.5, 0.5)
        for _ in range(60):
            lib.b2World_Step(world, 0.01, n)
        contacts = ffi.new("b2ContactData[4]")
        count = lib.b2Shape_GetContactData(shape, contacts, 4)
        manifolds = [contacts[i].manifold for i in range(count)]
        sums.append(sum(m.points[j].normalImpulse for m in manifolds for j in range(m.pointCount)))
        lib.b2DestroyWorld(world)
    return np.allclose(sums, [0.1, 0.025, 0.1], rtol=1e-2)


@fact(
    "Siconos",
    "siconos.numerics",
    "4.4.0",
    "`fc3d_compute_error`",
    "The error is divided by the larger of |q| and |reaction|, which have different units. An impulse that is 10 % too "
    "large has the error 1.1e-3, 0.09 and 9e-5 for masses of 1 g, 1 kg and 1 t.",
    "The relative residual does not change with the unit of mass.",
)
def siconos_error_changes_with_the_unit_of_mass():
    import siconos.numerics as numerics

    errors = []
    for mass in (1e-3, 1.0, 1e3):
        matrix = np.eye(3) / mass
        q = np.array([-1.0, 0.0, 0.0])
        problem = numerics.FrictionContactProblem(3, matrix, q, np.array([0.5]))
        reaction = np.array([1.1 * mass, 0.0, 0.0])
        options = numerics.SolverOptions(numerics.SICONOS_FRICTION_3D_NSGS)
        velocity = matrix @ reaction + q
        errors.append(
            numerics.fc3d_compute_error(
                problem, reaction, velocity, 1e-8, options, np.linalg.norm(q)
            )[1]
        )
    return np.allclose(errors, [1.1e-3, 0.1 / 1.1, 0.1 / 1100.0], rtol=1e-6)
