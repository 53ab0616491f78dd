#!/usr/bin/env bash
# sapien 3.0.3 (PhysX 5 on the CPU), a rotor of 0.01 kg m^2 on a hinge made by PhysxDriveComponent, with a velocity drive
# Behaviour: force_limit of set_drive_property_twist is an impulse per step, not a torque: with the limit 0.1 the rotor has its
# 5 rad/s after 0.05 s, for which 0.1 N m would take 0.5 s; with 0.1 x dt it accelerates by 10 rad/s^2. The drive turns against
# the sign of set_drive_velocity_target: the target 5 rad/s gives -5 rad/s.
# Output: speed after 0.05 s: limit 0.1 -4.99, limit 0.1 dt -0.50 (0.1 N m: 0.50) rad/s

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check sapien==3.0.3 "setuptools<81"
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

warnings.simplefilter("ignore")
import numpy as np
import sapien
import sapien.physx as physx

DT = 1 / 240
physx.set_scene_config(gravity=np.zeros(3, np.float32))


def measure_speed(limit):
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    system.timestep = DT
    rotor, base = physx.PhysxRigidDynamicComponent(), physx.PhysxRigidStaticComponent()
    rotor.attach(physx.PhysxCollisionShapeBox([0.1] * 3, physx.PhysxMaterial(0.5, 0.5, 0)))
    entities = [sapien.Entity(), sapien.Entity()]
    for entity, component in zip(entities, (base, rotor)):
        entity.add_component(component)
        scene.add_entity(entity)
    rotor.set_mass(1.5)
    rotor.set_inertia([0.01] * 3)
    rotor.set_linear_damping(0)
    rotor.set_angular_damping(0)
    drive = physx.PhysxDriveComponent(rotor)
    drive.set_parent(base)
    for set_limit in (drive.set_limit_x, drive.set_limit_y, drive.set_limit_z, drive.set_limit_cone):
        set_limit(0, 0)
    drive.set_drive_property_twist(0, 2.0, limit, "force")
    drive.set_drive_velocity_target([0, 0, 0], [5, 0, 0])
    entities[1].add_component(drive)
    for _ in range(12):
        system.step()
    return float(rotor.angular_velocity[0])


given, scaled = measure_speed(0.1), measure_speed(0.1 * DT)
print(f"speed after 0.05 s: limit 0.1 {given:.2f}, limit 0.1 dt {scaled:.2f} (0.1 N m: 0.50) rad/s")
sys.exit(0 if abs(given + 5) < 0.05 and abs(scaled + 0.5) < 0.05 else "the behaviour has changed")
EOF
