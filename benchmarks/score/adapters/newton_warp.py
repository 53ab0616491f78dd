"""newton (Warp on the CPU, float32) with any of its solvers.

A further hinge of a body is a joint outside the articulation. A belt is a kinematic body. Contacts come from newton's
collision pipeline, except in SolverMuJoCo, which has its own.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.score import adapters as tools

wp.config.quiet = True
wp.set_device("cpu")
COORDINATES = (
    "SolverFeatherstone",
    "SolverMuJoCo",
)  # They simulate joint coordinates; the others simulate bodies.


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `step` of the class `options["solver"]`; options are its arguments, and two for the stiffness of contacts.

    `frequency` [1/dt] is that of the heaviest body, critically damped; `hard` is a solref of 2 dt in SolverMuJoCo.
    """
    kind = options["solver"]
    solver_class = getattr(newton.solvers, kind)
    moving, tree = tools.get_moving(scene), tools.make_tree(scene)
    links = {link.body: link for link in tree}
    check(scene, kind, tree)
    builder = newton.ModelBuilder(gravity=tuple(scene["gravity"]))
    if hasattr(solver_class, "register_custom_attributes"):
        solver_class.register_custom_attributes(builder)
    config = builder.ShapeConfig(
        density=0.0,
        mu=scene["friction"],
        restitution=scene["restitution"],
        **make_stiffness(scene, options),
    )
    if tools.has_ground(scene):
        builder.add_ground_plane(cfg=config)
    velocities: list[list[float]] = []
    bodies: list[int] = []
    joints: list[int] = []
    for i, b in enumerate(moving):
        w, *xyz = b["quaternion"]
        pose = wp.transform(wp.vec3(*b["position"]), wp.quat(*xyz, w))
        inertia = wp.mat33(*np.diag(b["inertia"]).ravel().tolist())
        make = builder.add_link if i in links and not b["kinematic"] else builder.add_body
        body = make(
            xform=pose,
            mass=b["mass"],
            inertia=inertia,
            lock_inertia=True,
            is_kinematic=b["kinematic"],
        )
        half = tools.get_half(b)
        if half:
            builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2], cfg=config)
        else:
            builder.add_shape_sphere(body, radius=tools.get_radius(b), cfg=config)
        bodies.append(body)
        velocities.append([*b["velocity"], *b["spin"]])
    for link in tree:
        if not link.slides:
            add_hinge(builder, bodies, moving, link, joints)
    if joints:
        builder.add_articulation(joints)
    for link in tree:
        for point in link.loops:
            add_hinge(
                builder,
                bodies,
                moving,
                tools.Link(link.body, -1, point, link.axis, False, None, []),
                [],
            )
    if kind == "SolverVBD":
        builder.color()
    model = builder.finalize()
    own = ("dt", "solver", "frequency", "hard")
    settings = {k: v for k, v in options.items() if k not in own}
    if kind == "SolverXPBD" and scene["restitution"]:
        settings["enable_restitution"] = True
    if kind == "SolverMuJoCo":  # Memory: more rows and contacts than any scene has, stored densely.
        settings |= {"njmax": 500, "nconmax": 120, "jacobian": "dense"}
    solvers = [solver_class(model, **settings)]
    states, control = [model.state(), model.state()], model.control()
    contacts = None if kind == "SolverMuJoCo" else model.contacts()
    pushes = np.zeros((len(bodies), 6), np.float32)
    pushes[:, :3] = [b["force"] for b in moving]
    start = np.array(velocities, np.float32)
    places = np.array([b["position"] for b in moving])
    belts = np.array([b["kinematic"] for b in moving])
    time = [0.0]
    if not tree or all(link.slides for link in tree):
        states[0].joint_qd.assign(start.ravel())
    newton.eval_fk(model, states[0].joint_q, states[0].joint_qd, states[0])
    if not joints:
        states[0].body_qd.assign(start)

    def step() -> None:
        now, then = states
        now.clear_forces()
        if pushes.any():
            now.body_f.assign(pushes)
        if (
            kind == "SolverVBD" and belts.any()
        ):  # It takes the velocity of a kinematic body from its places.
            poses = now.body_q.numpy()
            poses[belts, :3] = (places + (time[0] + options["dt"]) * start[:, :3])[belts]
            now.body_q.assign(poses)
        if contacts is not None:
            model.collide(now, contacts)
        solvers[0].step(now, then, control, contacts, options["dt"])
        time[0] += options["dt"]
        states[:] = then, now

    def state() -> list[Any]:
        pose, v = states[0].body_q.numpy(), states[0].body_qd.numpy()
        return [[*q[:3], q[6], *q[3:6], *u] for q, u in zip(pose, v, strict=True)]

    def properties() -> list[Any]:
        mass, inertia = model.body_mass.numpy(), model.body_inertia.numpy()
        friction, e = model.shape_material_mu.numpy(), model.shape_material_restitution.numpy()
        return [[m, *np.diag(i), friction[-1], e[-1]] for m, i in zip(mass, inertia, strict=True)]

    def read_step() -> Any:
        solver = solvers[0]
        if kind == "SolverKamino":
            step()
            return read_kamino(solver)
        from lavender.io import step_from_newton_mujoco

        before = [x.numpy().copy() for x in (solver.mjw_data.qpos, solver.mjw_data.qvel)]
        is_first = time[0] == 0.0
        step()
        return None if is_first else step_from_newton_mujoco(solver, *before)

    saved = [[array.numpy().copy() for array in get_arrays(s)] for s in states]
    step()  # compiles
    for s, arrays in zip(states, saved[::-1], strict=True):
        for array, values in zip(get_arrays(s), arrays, strict=True):
            array.assign(values)
    states.reverse()
    solvers[0] = solver_class(model, **settings)  # forgets that step
    time[0] = 0.0
    readable = kind in ("SolverMuJoCo", "SolverKamino")
    return tools.Running(step, state, properties, read_step=read_step if readable else None)


def read_kamino(solver: Any) -> Any:
    """Return the record of the last step of SolverKamino."""
    from dataclasses import replace

    from lavender.causes.problems import record_of_problem
    from lavender.io import from_kamino

    read = from_kamino(solver)
    record = record_of_problem(read.batch[0], np.asarray(read.impulse, float)[: read.batch[0].m])
    angular = np.tile([False] * 3 + [True] * 3, len(record.velocity) // 6)
    return replace(record, angular=angular, precision="float32")


def get_arrays(state: Any) -> list[Any]:
    """Return the arrays of a state that a step changes."""
    return [state.body_q, state.body_qd, state.joint_q, state.joint_qd]


def check(scene: tools.Scene, kind: str, tree: list[tools.Link]) -> None:
    """Raise CannotExpress if a solver has no means for a scene."""
    if scene["restitution"] and kind not in ("SolverXPBD", "SolverKamino"):
        only = ", only the damping ratio of a soft contact" if kind == "SolverMuJoCo" else ""
        raise tools.CannotExpress(f"no restitution coefficient{only}")
    if kind == "SolverFeatherstone" and any(link.loops for link in tree):
        raise tools.CannotExpress("no loops")


def make_stiffness(scene: tools.Scene, options: tools.Options) -> dict[str, float]:
    """Return the stiffness and damping of contacts [N/m, N s/m], those of ShapeConfig if no option asks for them."""
    if "hard" in options:  # SolverMuJoCo: time constant 2 / kd, damping ratio kd / (2 sqrt(ke))
        return {"ke": 0.25 / options["dt"] ** 2, "kd": 1.0 / options["dt"]}
    if "frequency" in options:
        mass = max(b["mass"] for b in tools.get_moving(scene))
        speed = 2.0 * np.pi * options["frequency"] / options["dt"]
        return {"ke": mass * speed**2, "kd": 2.0 * mass * speed}
    return {}


def add_hinge(
    builder: Any, bodies: list[int], moving: Any, link: tools.Link, joints: list[int]
) -> None:
    """Add the hinge of a link."""
    above = moving[link.parent]["position"] if link.parent >= 0 else [0.0] * 3
    more = {}
    if link.drive:  # The torque falls below its limit within 1 % of the speed.
        speed, torque = link.drive
        more = {
            "target_qd": speed,
            "target_kd": 100 * torque / speed,
            "target_ke": 0.0,
            "effort_limit": torque,
        }
        more["actuator_mode"] = newton.JointTargetMode.VELOCITY
    joints.append(
        builder.add_joint_revolute(
            bodies[link.parent] if link.parent >= 0 else -1,
            bodies[link.body],
            parent_xform=wp.transform(
                wp.vec3(*tools.subtract(link.anchor, above)), wp.quat_identity()
            ),
            child_xform=wp.transform(
                wp.vec3(*tools.subtract(link.anchor, moving[link.body]["position"])),
                wp.quat_identity(),
            ),
            axis=wp.vec3(*link.axis),
            **more,
        )
    )
