#!/usr/bin/env bash
# jax2d 1.0.2 (jax 0.9.2), add_circle_to_scene and add_polygon_to_scene, density 1
# Behaviour: a disc gets m r^2 / 4, half of its moment of inertia, so that one that slides with 1 m/s ends up rolling with 0.8 m/s,
# whatever radius and friction, where 2/3 is right. The inertia of a rectangle is right. The centre of mass of a polygon is the
# mean of its corners: right for triangles and rectangles, 0.056 m too high for a trapezium of height 1 m with sides of 1 and 0.5 m.
# Output: inertia / (m r^2) 0.25 of 0.50, rolls with 0.80 of 0.67 m/s; rectangle 1.00 of 1.00; centre of mass of the trapezium 0.500
# of 0.444 m

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check jax2d==1.0.2 jax==0.9.2 jaxlib==0.9.2 flax==0.12.6 \
    chex==0.1.92 numpy==2.4.6
cd "$folder"
JAX_PLATFORMS=cpu venv/bin/python - << 'END'
import sys

import jax
import jax.numpy as jnp
from jax2d.engine import PhysicsEngine, create_empty_sim
from jax2d.scene import add_circle_to_scene, add_polygon_to_scene, add_rectangle_to_scene
from jax2d.sim_state import SimParams, StaticSimParams

SIZES, PARAMETERS = StaticSimParams(), SimParams()
FLOOR = 0.4
STEP = jax.jit(PhysicsEngine(SIZES).step)


def roll(radius, friction):
    """Return inertia / (m r^2) of a disc, its speed and the speed of its rim after 0.5 s, and its height over the floor."""
    state = create_empty_sim(SIZES, add_walls_and_ceiling=False)
    state, (disc, _) = add_circle_to_scene(state, SIZES, jnp.array([1.0, FLOOR + radius]), radius, friction=friction,
                                           velocity=jnp.array([1.0, 0.0]))
    share = float(state.circle.inverse_mass[disc] / state.circle.inverse_inertia[disc]) / radius**2
    for _ in range(30):
        state, _ = STEP(state, PARAMETERS, jnp.zeros(SIZES.num_joints + SIZES.num_thrusters))
    speed, rim = float(state.circle.velocity[disc, 0]), -radius * float(state.circle.angular_velocity[disc])
    return share, speed, rim, float(state.circle.position[disc, 1]) - FLOOR


same = True
for radius, friction in ((0.1, 1.0), (0.3, 1.0), (0.3, 0.3)):
    share, speed, rim, height = roll(radius, friction)
    print(f"disc of {radius} m, friction {friction}: inertia / (m r^2) {share:.2f} of 0.50, speed {speed:.3f}, rim {rim:.3f} of 0.667 "
          f"m/s, height {height:.3f} m")
    same &= abs(share - 0.25) < 1e-4 and abs(speed - 0.8) < 0.02 and abs(rim - 0.8) < 0.02 and abs(height - radius) < 0.02
state = create_empty_sim(SIZES, add_walls_and_ceiling=False)
state, (box, _) = add_rectangle_to_scene(state, SIZES, jnp.array([1.0, 2.0]), jnp.array([0.6, 0.8]))
share = float(state.polygon.inverse_mass[box] / state.polygon.inverse_inertia[box]) * 12 / (0.6**2 + 0.8**2)
print(f"rectangle: inertia / (m (a^2 + b^2) / 12) {share:.3f}")
same &= abs(share - 1) < 1e-4
for name, corners, right in (("triangle", [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]], 1 / 3),
                             ("trapezium", [[0.0, 1.0], [0.5, 1.0], [1.0, 0.0], [0.0, 0.0]], 4 / 9)):
    state = create_empty_sim(SIZES, add_walls_and_ceiling=False)
    state, (shape, _) = add_polygon_to_scene(state, SIZES, jnp.zeros(2), jnp.array(corners), len(corners))
    bottom = float(state.polygon.vertices[shape, :len(corners), 1].min())
    mass = 1 / float(state.polygon.inverse_mass[shape])
    print(f"{name}: mass {mass:.3f} kg, centre of mass {-bottom:.3f} of {right:.3f} m above its base")
    same &= abs(-bottom - sum(corner[1] for corner in corners) / len(corners)) < 1e-5
sys.exit(0 if same else "the behaviour has changed")
END
