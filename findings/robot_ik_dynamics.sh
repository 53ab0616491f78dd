#!/usr/bin/env bash
# robot-ik 0.4.0, DynamicsSolver on six_dof_articulated_dyn(), the robot of the package, and on a pendulum read from a URDF
# Behaviour: the first axis of the robot is vertical, so gravity has no moment about it; gravity_torque returns -33.5 N m there, the
# moment of the second joint (by the potential energy of the solver's own forward kinematics), and 3.8 N m for the second. The mass
# matrix, which forward_dynamics inverts, is not symmetric and its symmetric part has a negative eigenvalue. A pendulum (1 kg at
# 0.5 m on a horizontal axis) gets 4.905 N m at each angle; m g l cos q is 2.650 N m at 1 rad.
# Output: gravity torque -33.45, 3.83, ..., by the energy 0.00, -33.45, ...; asymmetry of the mass matrix 0.62, smallest eigenvalue
# of its symmetric part -0.198; pendulum 4.905, 4.905 at 0 and 1 rad

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check robot-ik==0.4.0 numpy==2.4.6
cd "$folder"
cat > pendulum.urdf << 'END'
<robot name="pendulum"><link name="base"/><link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="9"/></joint></robot>
END
venv/bin/python - << 'END'
import sys

import numpy as np
import robot_ik

model = robot_ik.six_dof_articulated_dyn()
solver = robot_ik.DynamicsSolver(model)


def energy(q):
    frames = solver.forward_kinematics_all(q)[1:]
    return sum(9.81 * link.mass * (frame[:3, :3] @ link.com + frame[:3, 3])[2] for link, frame in zip(model.links, frames))


q = np.zeros(6)
torque = solver.gravity_torque(q)
expected = np.array([(energy(q + 1e-6 * e) - energy(q - 1e-6 * e)) / 2e-6 for e in np.eye(6)])
mass = solver.inertia_matrix(q)
asymmetry = float(np.abs(mass - mass.T).max())
smallest = float(np.linalg.eigvalsh((mass + mass.T) / 2)[0])
pendulum = robot_ik.DynamicsSolver(robot_ik.urdf_to_dynamics_model("pendulum.urdf"))
moments = [float(pendulum.gravity_torque(np.array([x]))[0]) for x in (0.0, 1.0)]
print("gravity torque", np.round(torque, 2), "by the energy", np.round(expected, 2))
print(f"asymmetry of the mass matrix {asymmetry:.2f}, smallest eigenvalue of its symmetric part {smallest:.3f}")
print(f"pendulum {moments[0]:.3f}, {moments[1]:.3f} at 0 and 1 rad")
wrong = abs(torque[0] + 33.45) < 0.01 and abs(expected[0]) < 1e-3 and abs(expected[1] + 33.45) < 0.01
same = wrong and asymmetry > 0.5 and smallest < -0.1 and all(abs(x - 4.905) < 1e-3 for x in moments)
sys.exit(0 if same else "the behaviour has changed")
END
