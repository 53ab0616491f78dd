#!/usr/bin/env bash
# culverin 0.15.0 (Jolt), `impulse` of PhysicsWorld.get_contact_events_ex
# Behaviour: three boxes of 1 kg rest on each other. The impulse of the contact with the floor is the weight of one box
# times the time step instead of three, and the impulses between the boxes are near 0 instead of two and one.
# Output: in weights of one box: 1.000, 0.000, 0.000
# It needs Python 3.12 or later; set PYTHON to its command.

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check culverin==0.15.0
cd "$folder"
venv/bin/python - << 'END'
import sys

import culverin

world = culverin.PhysicsWorld(settings={"gravity": (0.0, -10.0, 0.0), "num_threads": 1})
ground = {"shape": culverin.SHAPE_BOX, "motion": culverin.MOTION_STATIC}
boxes = [world.create_body(pos=(0.0, -1.0, 0.0), size=(50.0, 1.0, 50.0), **ground)]
for k in range(3):
    box = {"shape": culverin.SHAPE_BOX, "motion": culverin.MOTION_DYNAMIC, "mass": 1.0}
    boxes.append(world.create_body(pos=(0.0, 0.1 + 0.2 * k, 0.0), size=(0.1, 0.1, 0.1), **box))
for _ in range(60):
    world.step(0.005)
events = {frozenset(event["bodies"]): event["impulse"] for event in world.get_contact_events_ex()}
weights = [events[frozenset(pair)] / (1.0 * 10.0 * 0.005) for pair in zip(boxes, boxes[1:])]
print("in weights of one box: " + ", ".join(f"{w:.3f}" for w in weights))
is_at_rest = all(abs(world.get_velocity(box)[1]) < 1e-3 for box in boxes[1:])
is_same = is_at_rest and abs(weights[0] - 1.0) < 0.01 and max(weights[1:]) < 0.01
sys.exit(0 if is_same else "the behaviour has changed")
END
