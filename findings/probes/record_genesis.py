"""Record the arrays that `lavender.io.from_genesis` reads, from steps of the rigid solver of Genesis.

    pip install genesis-world==1.4.5 torch
    python findings/probes/record_genesis.py tests/io/genesis_1.4.5.npz

Three environments of an arm above four boxes and of a stack of three boxes, with different velocities, are stepped with
each contact resolution. The file holds the arrays under their attribute names, the velocities after the step, and the
versions. `tests/io` converts them without the engine.
"""

import sys
from importlib.metadata import version

import numpy as np

DT, STEPS, ENVIRONMENTS = 0.01, 30, 3
SOLVER = "sim.rigid_solver"
STATE = f"{SOLVER}.constraint_solver.constraint_state"
ROWS = ("jac", "efc_D", "aref", "efc_force", "efc_frictionloss")
PATHS = (
    *(f"{STATE}.{name}" for name in ROWS),
    *(f"{STATE}.n_constraints{kind}" for kind in ("", "_equality", "_frictionloss", "_cone")),
    f"{STATE}.qacc",
    f"{STATE}.improved",
    f"{SOLVER}.collider.collider_state.n_contacts",
    *(f"{SOLVER}.dyn_state.dofs.{name}" for name in ("vel", "acc", "acc_smooth", "qf_smooth")),
    f"{SOLVER}.rigid_info.mass_mat",
)
CONFIG = (
    "rows_per_contact",
    "enable_elliptic_friction",
    "enable_signorini_contact",
    "enable_torsional_friction",
    "enable_rolling_friction",
    "use_hibernation",
)


def read(root, path):
    """Return the attribute at a dotted path."""
    for name in path.split("."):
        root = getattr(root, name)
    return root


def step_scene(with_arm, **options):
    """Build and step a scene; return it."""
    import genesis as gs

    if not getattr(gs, "_initialized", False):
        gs.init(backend=gs.cpu, precision="32", logging_level="error")
    names = {"friction_cone": gs.friction_cone, "contact_resolution": gs.contact_resolution}
    options = {
        key: getattr(names[key], value) if key in names else value for key, value in options.items()
    }
    scene = gs.Scene(
        show_viewer=False,
        sim_options=gs.options.SimOptions(dt=DT),
        rigid_options=gs.options.RigidOptions(**options),
    )
    scene.add_entity(gs.morphs.Plane())
    if with_arm:
        scene.add_entity(gs.morphs.MJCF(file="xml/franka_emika_panda/panda.xml"))
    for k in range(4 if with_arm else 3):
        scene.add_entity(
            gs.morphs.Box(size=(0.1, 0.1, 0.1), pos=(0.45 + 0.02 * k, 0.0, 0.05 + 0.1 * k))
        )
    scene.build(n_envs=ENVIRONMENTS)
    solver = scene.sim.rigid_solver
    velocity = np.zeros((ENVIRONMENTS, solver.n_dofs), np.float32)
    velocity[1] = 0.3 * np.sin(np.arange(solver.n_dofs))
    velocity[2] = np.cos(np.arange(solver.n_dofs))
    solver.set_dofs_velocity(velocity)
    for _ in range(STEPS):
        scene.step()
    return scene


def main(out):
    from genesis.utils.misc import qd_to_numpy

    arrays = {
        "versions": np.array([f"{name} {version(name)}" for name in ("genesis-world", "torch")])
    }
    convex = {"contact_resolution": "convex", "enable_torsional_friction": True}
    for name, with_arm, options in (
        ("arm", True, {"friction_cone": "elliptic"}),
        ("convex", False, {"friction_cone": "elliptic"} | convex),
        ("pyramids", False, {"friction_cone": "pyramidal"}),
    ):
        scene = step_scene(with_arm, **options)
        rows = int(qd_to_numpy(read(scene, f"{STATE}.n_constraints")).max())
        for path in PATHS:
            values = np.array(qd_to_numpy(read(scene, path)))
            arrays[f"{name}/{path}"] = (
                values[: rows + 2] if path.rsplit(".", 1)[1] in ROWS else values
            )
        for key in CONFIG:
            arrays[f"{name}/{SOLVER}.rigid_config.{key}"] = np.array(
                getattr(scene.sim.rigid_solver.rigid_config, key)
            )
        arrays[f"{name}/{SOLVER}.substep_dt"] = np.array(scene.sim.rigid_solver.substep_dt)
    np.savez_compressed(out, **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
