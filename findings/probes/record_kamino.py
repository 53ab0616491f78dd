"""Record the arrays that `lavender.io.from_kamino` reads, from steps of newton's SolverKamino.

    pip install newton==1.8.0 warp-lang==1.19.0
    python findings/probes/record_kamino.py tests/io/kamino_1.8.0.npz

Three models are stepped: worlds of different sizes (a stack, a cart and pole, a nunchaku, a four-bar linkage with an
implicit spring), by PADMM over a dense Jacobian and by DVI over a sparse one; and eight stacks, of which one has a NaN
velocity. The file holds the arrays under their attribute names, the velocities of the bodies after the step, and the
versions. `tests/io` converts them without the engine.
"""

import sys
from importlib.metadata import version

import numpy as np

DT, STEPS = 0.01, 40
INFO = (
    "num_bodies",
    "bodies_offset",
    "num_joint_dynamic_cts",
    "joint_dynamic_cts_offset",
    "joint_dynamic_cts_group_offset",
    "num_joint_effort_cts",
    "joint_effort_cts_offset",
    "joint_effort_cts_group_offset",
    "joint_kinematic_cts_group_offset",
)
PROBLEM = (
    "njc",
    "nbc",
    "nl",
    "nc",
    "dim",
    "maxdim",
    "bcio",
    "cio",
    "vio",
    "mio",
    "D",
    "P",
    "u_f",
    "v_f",
    "bound_lower",
    "bound_upper",
    "mu",
)
JOINTS = ("wid", "num_dynamic_cts", "num_kinematic_cts", "num_friction_cts", "num_effort_cts")
CONTACTS = ("model_active_contacts", "wid", "cid", "bid_AB")
PATHS = (
    *(f"_solver_kamino._model.info.{name}" for name in INFO),
    *(f"_solver_kamino.problem_fd.data.{name}" for name in PROBLEM),
    *(f"_solver_kamino._model.joints.{name}" for name in JOINTS),
    "_solver_kamino._model.bodies.inv_m_i",
    "_solver_kamino.data.bodies.inv_I_i",
    "_solver_kamino.data.joints.inv_m_j",
    "_solver_kamino.data.joints.inv_m_a",
    "_solver_kamino.solver_fd.data.solution.lambdas",
    "_solver_kamino.solver_fd.data.state.sigma",
    *(f"_contacts_kamino.data.{name}" for name in CONTACTS),
    "status",
)
DENSE_JACOBIAN = (
    "_solver_kamino._jacobians.data.J_cts_data",
    "_solver_kamino._jacobians.data.J_cts_offsets",
)
SPARSE_JACOBIAN = tuple(
    f"_solver_kamino._jacobians._J_cts.bsm.{name}"
    for name in ("num_nzb", "nzb_start", "nzb_coords", "nzb_values")
)
LABELS = ("_solver_kamino._model.joints.label", "_solver_kamino._model.bodies.label")


def read(root, path):
    """Return the attribute at a dotted path."""
    for name in path.split("."):
        root = getattr(root, name)
    return root


def step_worlds(parts, is_diverged, **config):
    """Step worlds made of `parts`; return the solver and the velocities of all bodies after the last step."""
    import newton
    from newton.solvers import SolverKamino

    builder = newton.ModelBuilder()
    SolverKamino.register_custom_attributes(builder)
    for part in parts:
        builder.add_world(part)
    model = builder.finalize(device="cpu")
    solver = SolverKamino(model, config=SolverKamino.Config(**config))
    before, after, control = model.state(), model.state(), model.control()
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    for i in range(STEPS):
        if is_diverged and i == STEPS - 2:
            velocity = before.body_qd.numpy().copy()
            velocity[-1] = np.nan
            before.body_qd.assign(velocity)
        pipeline.collide(before, contacts)
        solver.step(before, after, control, contacts, DT)
        before, after = after, before
    return solver, before.body_qd.numpy()


def main(out):
    from newton.tests.utils import basics

    mixed = [
        basics.build_boxes_stacked_on_plane(),
        basics.build_cartpole(),
        basics.build_boxes_nunchaku(),
        basics.build_boxes_fourbar(dynamic_joints=True, implicit_pd=True),
    ]
    arrays = {"versions": np.array([f"{name} {version(name)}" for name in ("newton", "warp-lang")])}
    stacks = [basics.build_boxes_stacked_on_plane()] * 8
    for model, parts, config in (
        ("mixed", mixed, {}),
        ("stacks", stacks, {}),
        ("dvi", mixed, {"dynamics_solver": "dvi", "sparse_jacobian": True}),
    ):
        solver, velocity = step_worlds(parts, model == "stacks", **config)
        for path in (*PATHS, *(SPARSE_JACOBIAN if model == "dvi" else DENSE_JACOBIAN)):
            arrays[f"{model}/{path}"] = read(solver, path).numpy()
        for path in LABELS:
            arrays[f"{model}/{path}"] = np.array(list(read(solver, path)))
        arrays[f"{model}/velocity"] = velocity
        rows = arrays[f"{model}/_solver_kamino.problem_fd.data.dim"]
        for i, m in enumerate(rows):  # The rest of a world's part of D is of earlier steps.
            start = arrays[f"{model}/_solver_kamino.problem_fd.data.mio"][i]
            arrays[f"{model}/_solver_kamino.problem_fd.data.D"][start + int(m) ** 2 :][
                : int(arrays[f"{model}/_solver_kamino.problem_fd.data.maxdim"][i]) ** 2
                - int(m) ** 2
            ] = 0.0
    np.savez_compressed(out, **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
