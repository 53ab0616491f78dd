"""Newton on the CPU: native shapes, joints of a tree, solvers by name."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import Stepping
from lavender.lab.phenomena.engines.tree import (
    compute_relative_pose,
    get_collision_shape,
    map_bodies_to_parent_joints,
    reorder_to_xyzw,
)
from lavender.sim.scene import Plane, Scene, Sphere

SUBSTEPS = 4


class Engine(Stepping):
    """Engine that calls Newton's `collide` and `step` SUBSTEPS times in 1/60 s."""

    def __init__(self, scene: Scene, solver: str, **options: float) -> None:
        self.scene, self.up, self.dt = scene, map_bodies_to_parent_joints(scene, "newton"), 1.0 / 60.0
        wp.config.quiet = True
        wp.set_device("cpu")
        p = scene.parameters
        builder = newton.ModelBuilder(gravity=tuple(map(float, p.gravity)))
        material = newton.ModelBuilder.ShapeConfig(
            density=0.0, mu=p.friction, mu_rolling=0.0, mu_torsional=p.patch_radius * p.friction,
            has_shape_collision=not self.up,
        )  # fmt: skip
        self.bodies = [self._add_body(builder, i, material) for i in range(scene.n_bodies)]
        if self.up:
            builder.add_articulation([self._add_joint(builder, i) for i in sorted(self.up)])
        builder.color()
        model = builder.finalize()
        self.solver = getattr(newton.solvers, f"Solver{solver}")(model, **options)
        option_text = "".join(f", {k} {v:g}" for k, v in options.items())
        self.setting = f"16.7 ms in {SUBSTEPS}, {solver}{option_text}"
        self.now, self.next, self.control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.now)
        self.pipeline = newton.CollisionPipeline(model)
        self.contacts = self.pipeline.contacts()

    def _add_body(
        self, builder: newton.ModelBuilder, i: int, material: newton.ModelBuilder.ShapeConfig
    ) -> int:
        """Add body i to the model and return its index; a plane belongs to the world: return -1."""
        body = self.scene.bodies[i]
        shape = get_collision_shape(body, "newton", static=False)
        if isinstance(shape, Plane):
            builder.add_shape_plane(
                (*map(float, shape.normal), -float(shape.offset)), width=0.0, length=0.0, cfg=material
            )
            return -1
        add = builder.add_link if i in self.up else builder.add_body
        created = add(
            xform=_make_transform(body.position, body.quaternion),
            mass=body.mass,
            inertia=wp.mat33(body.inertia),
        )
        if isinstance(shape, Sphere):
            builder.add_shape_sphere(created, radius=shape.radius, cfg=material)
        else:
            hx, hy, hz = (0.5 * s for s in shape.size)
            builder.add_shape_box(created, hx=hx, hy=hy, hz=hz, cfg=material)
        if i not in self.up:
            builder.joint_qd[-6:] = [*body.velocity, *body.angular_velocity]
        return int(created)

    def _add_joint(self, builder: newton.ModelBuilder, i: int) -> int:
        """Add the joint of body i to its parent and return its index."""
        joint = self.up[i]
        parent = -1 if joint.a < 0 else self.bodies[joint.a]
        _, quaternion = compute_relative_pose(
            None if joint.a < 0 else self.scene.bodies[joint.a], self.scene.bodies[i]
        )
        transforms = {
            "parent_xform": _make_transform(joint.anchor_a, quaternion),
            "child_xform": _make_transform(joint.anchor_b, np.array([1.0, 0, 0, 0])),
        }
        if joint.kind == "hinge":
            return int(
                builder.add_joint_revolute(parent, self.bodies[i], axis=wp.vec3(*joint.axis_b), **transforms)
            )
        return int(builder.add_joint_ball(parent, self.bodies[i], **transforms))

    def step(self) -> None:
        """See `Stepping.step`."""
        for _ in range(SUBSTEPS):
            self.now.clear_forces()
            self.pipeline.collide(self.now, self.contacts)
            self.solver.step(self.now, self.next, self.control, self.contacts, self.dt / SUBSTEPS)
            self.now, self.next = self.next, self.now

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`; the engine computes in float32."""
        poses, velocities = self.now.body_q.numpy().astype(float), self.now.body_qd.numpy().astype(float)
        x, q, v = self.make_initial_state()
        for i, k in enumerate(self.bodies):
            if k >= 0:
                x[i], q[i], v[i] = poses[k, :3], np.roll(poses[k, 3:], 1), velocities[k]
        return x, q, v


def _make_transform(x: FloatArray, q: FloatArray) -> wp.transform:
    """Build a transform of a position (3,) [m] and a quaternion (4,)."""
    return wp.transform(tuple(map(float, x)), tuple(reorder_to_xyzw(q)))
