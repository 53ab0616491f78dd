#!/usr/bin/env bash
# newton 1.8.0 (mujoco 3.17.0), an MJCF hinge with damping, a spring, friction or a body without weight, by solver
# Behaviour: a pendulum of 1 kg is released from the horizontal for 0.2 s. add_mjcf reads all four without a message. SolverMuJoCo
# applies all. SolverFeatherstone applies damping and stiffness, and drops frictionloss and gravcomp. SolverXPBD applies none.
# Output: angle without and with damping, stiffness, frictionloss, gravcomp: SolverMuJoCo 0.533, 0.160, 0.193, 0.172, 0.000 rad;
# SolverFeatherstone 0.533, 0.161, 0.193, 0.533, 0.533 rad; SolverXPBD 0.469 rad each

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 newton==1.8.0 mujoco==3.17.0 mujoco-warp==3.17.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import contextlib
import io
import sys

import newton
import warp

warp.config.quiet = True
MODEL = (
    '<mujoco><compiler angle="radian"/><worldbody><body name="b" {body}><joint name="j" type="hinge" axis="0 1 0" {joint}/>'
    '<inertial pos=".3 0 0" mass="1" diaginertia=".01 .02 .02"/></body></worldbody></mujoco>'
)
CASES = {
    "none": ("", ""),
    "damping": ("", 'damping="3"'),
    "stiffness": ("", 'stiffness="30"'),
    "frictionloss": ("", 'frictionloss="2"'),
    "gravcomp": ('gravcomp="1"', ""),
}
ACTS = {
    "SolverMuJoCo": {"damping", "stiffness", "frictionloss", "gravcomp"},
    "SolverFeatherstone": {"damping", "stiffness"},
    "SolverXPBD": set(),
}


def swing(name, body, joint):
    """Return the angle [rad] after 0.2 s."""
    builder = newton.ModelBuilder()
    if name == "SolverMuJoCo":
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(MODEL.format(body=body, joint=joint))
    model = builder.finalize(device="cpu")
    solver = getattr(newton.solvers, name)(model)
    before, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, before)
    for _ in range(200):
        solver.step(before, after, control, None, 1e-3)
        before, after = after, before
    newton.eval_ik(model, before, before.joint_q, before.joint_qd)
    return float(before.joint_q.numpy()[0])


same = True
for name, acts in ACTS.items():
    with contextlib.redirect_stdout(io.StringIO()):
        angles = {case: swing(name, *attributes) for case, attributes in CASES.items()}
    print(f"{name}: " + ", ".join(f"{case} {angle:.3f}" for case, angle in angles.items()))
    same = same and {case for case, angle in angles.items() if abs(angle - angles["none"]) > 1e-3} == acts
sys.exit(0 if same else "the behaviour has changed")
END
