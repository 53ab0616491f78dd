#!/usr/bin/env bash
# Rapier (Python, rapier3d) 0.36.1, impulses of joints
# Behaviour: a ball of 1 kg hangs on a fixed body. `impulses` of the joint is weight times time step with one solver
# iteration, and divided by the number of iterations otherwise; the default is 4. Impulses of contacts are not divided:
# a resting box has weight times time step with each number.
# Output: joint: 0.1000, 0.0250, 0.0125 N s with 1, 4, 8 iterations; contact: 0.1000, 0.1000, 0.1000 N s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 rapier3d==0.36.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import rapier3d as rapier

DT = 0.01  # s


def make_world():
    world = rapier.PhysicsWorld(gravity=(0.0, -10.0, 0.0))
    world.integration_parameters.dt = DT
    return world


def measure_joint(iterations):
    world = make_world()
    world.integration_parameters.num_solver_iterations = iterations
    anchor = world.add_body(rapier.RigidBody.fixed())
    collider = rapier.Collider.ball(0.1, mass=1.0)
    body = world.add_body(rapier.RigidBody.dynamic(translation=(0.0, -0.5, 0.0), can_sleep=False), colliders=[collider])
    joint = rapier.SphericalJointBuilder().local_anchor1((0.0, 0.0, 0.0)).local_anchor2((0.0, 0.5, 0.0)).build()
    handle = world.impulse_joints.insert(anchor, body, joint)
    for _ in range(200):
        world.step()
    return abs(world.impulse_joints.get(handle).impulses[1])


def measure_contact(iterations):
    world = make_world()
    world.integration_parameters.num_solver_iterations = iterations
    world.add_collider(rapier.Collider.cuboid(50.0, 1.0, 50.0, translation=(0.0, -1.0, 0.0)))
    box = rapier.Collider.cuboid(0.1, 0.1, 0.1, mass=1.0)
    world.add_body(rapier.RigidBody.dynamic(translation=(0.0, 0.1, 0.0), can_sleep=False), colliders=[box])
    for _ in range(200):
        world.step()
    return sum(pair.total_impulse().y for pair in world.narrow_phase.contact_pairs())


counts = 1, 4, 8
joints, contacts = [measure_joint(n) for n in counts], [abs(measure_contact(n)) for n in counts]
names = ", ".join(map(str, counts))
print(
    f"joint: {', '.join(f'{x:.4f}' for x in joints)} N s with {names} iterations; "
    f"contact: {', '.join(f'{x:.4f}' for x in contacts)} N s"
)
is_same = all(abs(x * n - 0.1) < 1e-3 for x, n in zip(joints, counts)) and all(abs(x - 0.1) < 1e-3 for x in contacts)
sys.exit(0 if is_same else "the behaviour has changed")
EOF
