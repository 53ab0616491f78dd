#!/usr/bin/env bash
# newton 1.8.0, two joints coupled by the equality of an MJCF and by the mimic of a URDF, by solver
# Behaviour: the second of two pendulums is to follow 0.5 times the first. As <mimic> of a URDF, SolverFeatherstone and SolverXPBD keep
# the coupling. As <equality><joint> of an MJCF, both drop it, without a message; each pendulum falls on its own.
# Output: error after 0.2 s: Featherstone 0.382 rad with MJCF and 0.000 rad with URDF; XPBD 0.201 rad and 0.000 rad

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 newton==1.8.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import contextlib
import io
import sys

import newton
import warp

warp.config.quiet = True
BODY = (
    '<body name="{0}" pos="0 {1} 0"><joint name="{0}" type="hinge" axis="0 1 0"/>'
    '<inertial pos="{2} 0 0" mass="1" diaginertia=".01 .02 .02"/></body>'
)
MJCF = (
    f"<mujoco><worldbody>{BODY.format('a', 0, 0.3)}{BODY.format('b', 1, 0.1)}</worldbody>"
    '<equality><joint joint1="b" joint2="a" polycoef="0 .5 0 0 0"/></equality></mujoco>'
)
LINK = (
    '<link name="{0}"><inertial><origin xyz="{2} 0 0"/><mass value="1"/>'
    '<inertia ixx=".01" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{0}" type="revolute">'
    '<parent link="base"/><child link="{0}"/><origin xyz="0 {1} 0"/><axis xyz="0 1 0"/>'
    '<limit lower="-9" upper="9" effort="99" velocity="99"/>{3}</joint>'
)
MIMIC = '<mimic joint="ja" multiplier="0.5"/>'
URDF = f'<robot name="r"><link name="base"/>{LINK.format("a", 0, 0.3, "")}{LINK.format("b", 1, 0.1, MIMIC)}</robot>'


def fall(name, is_mjcf):
    """Return the angles [rad] after 0.2 s."""
    builder = newton.ModelBuilder()
    if is_mjcf:
        builder.add_mjcf(MJCF)
    else:
        builder.add_urdf(URDF, floating=False)
    model = builder.finalize(device="cpu")
    solver = getattr(newton.solvers, name)(model)
    before, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, before)
    for _ in range(200):
        solver.step(before, after, control, None, 1e-3)
        before, after = after, before
    newton.eval_ik(model, before, before.joint_q, before.joint_qd)
    return before.joint_q.numpy()


same = True
for name in ("SolverFeatherstone", "SolverXPBD"):
    for is_mjcf in (True, False):
        with contextlib.redirect_stdout(io.StringIO()):
            first, second = fall(name, is_mjcf)
        error = abs(second - 0.5 * first)
        print(f"{name}, {'equality of MJCF' if is_mjcf else 'mimic of URDF'}: {first:.3f}, {second:.3f} rad, error {error:.3f} rad")
        same = same and (error > 0.05) == is_mjcf
sys.exit(0 if same else "the behaviour has changed")
END
