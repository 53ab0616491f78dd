"""Probes of arrays and settings of newton's solvers; see `engine_facts`."""

import contextlib
import io
import warnings

import numpy as np
from engine_facts import fact

NEWTON = "newton", "newton", "1.8.0"
NEWTON_MUJOCO = "newton", "newton mujoco_warp", "1.8.0"
DT = 0.005  # s


def run_newton(
    name, n=60, gravity=(0.0, 0.0, -9.81), friction=(0.5, 0.5), height=0.1, margin=0.0, **options
):
    """Step a box of 1 kg on a plane.

    Returns
    -------
    tuple
        The solver, the velocities (n + 1, 6) of the box, its observables, and the contacts.
    """
    import newton
    import warp

    warp.config.quiet = True
    solver_class = getattr(newton.solvers, name)
    config = newton.ModelBuilder.ShapeConfig
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # newton 1.8 warns of newer versions of MuJoCo.
        builder, world = newton.ModelBuilder(), newton.ModelBuilder()
        for item in (builder, world):
            if hasattr(solver_class, "register_custom_attributes"):
                solver_class.register_custom_attributes(item)
        builder.add_ground_plane(cfg=config(mu=friction[0], margin=margin))
        box = world.add_body(xform=warp.transform((0.0, 0.0, height), warp.quat_identity()))
        shape = config(mu=friction[1], density=125.0, margin=margin)
        world.add_shape_box(box, hx=0.1, hy=0.1, hz=0.1, cfg=shape)
        builder.add_world(world)
        builder.color()
        model = builder.finalize(device="cpu")
        model.gravity.assign(
            np.tile(np.array(gravity, np.float32), (len(model.gravity.numpy()), 1))
        )
        solver = solver_class(model, **options)
        before, after, control = model.state(), model.state(), model.control()
        pipeline = newton.CollisionPipeline(model)
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        kinds = solver_class.SUPPORTED_OBSERVABLES & {"contact_f", "body_qdd"}
        observables = solver.observables(kinds, contacts=contacts) if kinds else None
        velocities = [before.body_qd.numpy()[0].copy()]
        for _ in range(n):
            pipeline.collide(before, contacts)
            before.clear_forces()
            solver.step(before, after, control, contacts, DT, observables=observables)
            before, after = after, before
            velocities.append(before.body_qd.numpy()[0].copy())
    return solver, np.array(velocities), observables, contacts


@fact(
    *NEWTON_MUJOCO,
    "friction of two shapes",
    "SolverXPBD and SolverKamino use the mean of both coefficients, and SolverMuJoCo the larger one.",
    "The rows have the coefficients of the solver that was run.",
)
def newton_solvers_combine_friction_differently():
    found = []
    for name in ("SolverXPBD", "SolverKamino", "SolverMuJoCo"):
        velocity = run_newton(name, 40, gravity=(6.0, 0.0, -10.0), friction=(0.2, 0.8))[1][:, 0]
        found.append((velocity[-1] - velocity[20]) / (20 * DT))
    # A coefficient of 0.5 leaves an acceleration of 1 m/s^2; one of 0.8 holds the box up to the creep of soft contacts.
    return np.allclose(found[:2], 1.0, atol=0.02) and abs(found[2]) < 0.1


@fact(
    *NEWTON,
    "SolverKamino: `reaction`, `lambdas`",
    "`reaction` of its contacts is in N, and `lambdas` of its solution in N s.",
    "`from_kamino` reads `lambdas`.",
)
def kamino_has_reactions_in_newtons():
    solver = run_newton("SolverKamino")[0]
    n = int(solver._contacts_kamino.data.model_active_contacts.numpy()[0])
    force = solver._contacts_kamino.data.reaction.numpy()[:n].sum(axis=0)
    impulse = (
        solver._solver_kamino.solver_fd.data.solution.lambdas.numpy()[: 3 * n]
        .reshape(n, 3)
        .sum(axis=0)
    )
    return np.allclose(force[2], 9.81, rtol=1e-3) and np.allclose(impulse[2], 9.81 * DT, rtol=1e-3)


@fact(
    *NEWTON_MUJOCO,
    "`contact_f`",
    "The observable is the force in N on the body of `rigid_contact_shape0`, with friction, for SolverXPBD, "
    "SolverKamino, SolverMuJoCo and SolverVBD.",
)
def newton_contact_forces_act_on_the_first_shape():
    sums = []
    for name in ("SolverXPBD", "SolverKamino", "SolverMuJoCo", "SolverVBD"):
        _, _, observables, contacts = run_newton(name, gravity=(2.0, 0.0, -9.81))
        if contacts.rigid_contact_shape0.numpy()[0] != 0:  # Shape 0 is the plane.
            return False
        sums.append(observables.contact_f.numpy()[:, :3].sum(axis=0))
    return np.allclose(sums, [2.0, 0.0, -9.81], atol=0.02)


@fact(
    *NEWTON_MUJOCO,
    "`body_qdd`",
    "The observable of SolverKamino and SolverMuJoCo is the change of the velocity divided by the time step. It "
    "contains the impulses of contacts.",
)
def newton_accelerations_contain_contacts():
    found = []
    for name in ("SolverKamino", "SolverMuJoCo"):
        _, velocity, observables, _ = run_newton(name, 3)
        found.append(observables.body_qdd.numpy()[0] - (velocity[-1] - velocity[-2]) / DT)
    return np.allclose(found, 0.0, atol=1e-3)


@fact(
    *NEWTON_MUJOCO,
    "SolverMuJoCo: `margin`",
    "Margins of shapes act only with `use_mujoco_contacts=False`. By default, the geoms of MuJoCo have the margin 0.",
    "Only contacts with rows are read.",
)
def newton_drops_margins_in_mujoco():
    rows = []
    for is_mujoco in (True, False):
        solver = run_newton(
            "SolverMuJoCo", 1, height=0.105, margin=0.01, use_mujoco_contacts=is_mujoco
        )[0]
        rows.append(int(solver.mjw_data.nefc.numpy()[0]))
    return rows == [0, 16]


def make_newton_boxes(name, heights, masses, has_plane):
    """Return newton's model of one world with boxes of 0.2 m at the heights [m], with masses [kg], and a solver."""
    import newton
    import warp

    warp.config.quiet = True
    with contextlib.redirect_stdout(io.StringIO()):
        builder, world = newton.ModelBuilder(), newton.ModelBuilder()
        if has_plane:
            builder.add_ground_plane()
        for height, mass in zip(heights, masses, strict=True):
            body = world.add_body(xform=warp.transform((0.0, 0.0, height), warp.quat_identity()))
            shape = newton.ModelBuilder.ShapeConfig(density=mass / 0.2**3)
            world.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, cfg=shape)
        builder.add_world(world)
        model = builder.finalize(device="cpu")
        return model, getattr(newton.solvers, name)(model)


@fact(
    *NEWTON,
    "SolverXPBD: mass ratios",
    "Contacts of a light body yield to a heavy one: a box of 100 kg pushes a box of 1 kg, both 0.2 m high, 92 mm into "
    "the plane within one second. With equal masses the depth is 2 mm.",
    "Its steps are not solutions of a constraint problem, so no importer reads them.",
)
def xpbd_sinks_under_mass_ratios():
    import newton

    depths = []
    for ratio in (1.0, 100.0):
        model, solver = make_newton_boxes("SolverXPBD", (0.1, 0.3), (1.0, ratio), has_plane=True)
        before, after, control = model.state(), model.state(), model.control()
        pipeline = newton.CollisionPipeline(model)
        contacts = pipeline.contacts()
        for _ in range(200):
            pipeline.collide(before, contacts)
            before.clear_forces()
            solver.step(before, after, control, contacts, DT)
            before, after = after, before
        depths.append(0.1 - before.body_q.numpy()[0, 2])
    return depths[0] < 0.005 and depths[1] > 0.05


@fact(
    *NEWTON,
    "`body_mass` changed after `finalize`",
    "SolverXPBD does not read it: with 10 times the mass, a force accelerates the body as before. Change "
    "`body_inv_mass`, too.",
)
def newton_reads_inverse_masses():
    speeds = []
    for factor in (1.0, 10.0):
        model, solver = make_newton_boxes("SolverXPBD", (5.0,), (1.0,), has_plane=False)
        model.body_mass.assign(factor * model.body_mass.numpy())
        before, after = model.state(), model.state()
        before.body_f.assign(np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]], np.float32))
        solver.step(before, after, model.control(), None, DT)
        speeds.append(after.body_qd.numpy()[0, 0])
    return speeds[0] == speeds[1] > 0.0


@fact(
    *NEWTON,
    "MJCF: gravity",
    "`add_mjcf` ignores gravity and time step of the file: gravity is -9.81 m/s² unless `ModelBuilder(gravity=...)` is "
    "given.",
    "The problem has the gravity that the solver used.",
)
def newton_ignores_gravity_of_mjcf():
    import newton

    builder = newton.ModelBuilder()
    with contextlib.redirect_stdout(io.StringIO()):
        body = '<body><joint type="slide"/><geom size=".1"/></body>'
        builder.add_mjcf(
            f'<mujoco><option gravity="0 0 -3"/><worldbody>{body}</worldbody></mujoco>'
        )
    return np.allclose(builder.finalize(device="cpu").gravity.numpy()[0], [0.0, 0.0, -9.81])
