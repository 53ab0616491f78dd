"""Contacts in lanes: every number of lanes has the bits of sweeps over single contacts."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD


def build_scene(name: str, **options) -> lv.Scene:
    """Return a tower, a wall, tumbling boxes of several sizes, or spheres, on a plane."""
    scene = lv.Scene(dt=1 / 60, **{"substeps": 4, "solver_iterations": 4, **options})
    scene.add_plane()
    rng = np.random.default_rng(7)
    kind, n = name.split()
    bounces = options.get("restitution", 0.0) * np.array([0.0, 0.5, 1.0])
    for i in range(int(n)):
        if kind == "tower":
            scene.add_box((1, 1, 1), position=(0, 0, i + 0.5), restitution=bounces[i % 3])
        elif kind == "boxes":
            scene.add_box(
                tuple(rng.uniform(0.3, 1.0, 3)),
                position=(*rng.uniform(-1, 1, 2), 0.5 + 0.7 * i),
                velocity=tuple(rng.normal(0, 3, 3)),
                angular_velocity=tuple(rng.normal(0, 3, 3)),
                restitution=bounces[i % 3],
            )
        elif kind == "spheres":
            at = (*rng.uniform(-1, 1, 2), 0.5 + 0.3 * i)
            scene.add_sphere(0.3, position=at, restitution=bounces[i % 3])
        else:
            for j in range(i, int(n)):
                scene.add_box((1, 1, 1), position=(0.5 * i + j - i, 0, i + 0.5))
    return scene


def run_in_lanes(scene: lv.Scene, lanes: int, calls: tuple[int, ...]) -> list[bytes]:
    """Return positions, velocities and the last substep's problem after runs of these numbers of steps."""
    simulation = lv.Simulation(scene)
    seen = []
    for steps in calls:
        for _ in range(steps):
            simulation.state.kernel.lanes = lanes  # Larger buffers have a new kernel.
            simulation.step()
        observation = simulation.run(3)[0]
        seen += [observation[name].tobytes() for name in ("positions", "velocities")]
        state = simulation.state
        contacts, rows = state.head[HEAD["contacts"]], state.head[HEAD["contact_rows"]]
        for name in ("gap", "coupling", "normal", "key"):
            seen.append(state.a[name][:contacts].tobytes())
        for name in ("impulse", "b", "d", "step", "inv_inertia_arm"):
            seen.append(state.a[name][:rows].tobytes())
        seen.append(
            state.a["setting"].tobytes()
        )  # The statistics, such as the deepest penetration.
    return seen


@pytest.mark.parametrize("lanes", (1, 2, 4))
@pytest.mark.parametrize(
    ("name", "options"),
    (
        ("tower 2", {}),
        ("tower 9", {}),
        ("tower 12", {"solver_iterations": 7}),
        ("tower 12", {"solver_iterations": 12, "substeps": 1}),
        ("wall 6", {}),
        ("wall 5", {"order": "reverse"}),
        ("wall 5", {"order": "given", "substeps": 3}),
        ("wall 5", {"order": "top_down"}),
        ("wall 5", {"order": "colored", "solver_iterations": 5}),
        ("boxes 40", {}),
        ("boxes 40", {"warm_start": False}),
        ("boxes 20", {"restitution": 0.5}),
        ("spheres 40", {}),
        ("boxes 20", {"gravity": (0, 0, 0)}),
        ("boxes 20", {"restitution": 0.7, "restitution_threshold": 0.0, "substeps": 2}),
        ("tower 9", {"order": "colored_pairs"}),
        ("wall 6", {"order": "colored_pairs", "recycle": 1e-3, "substeps": 3}),
        ("boxes 40", {"order": "colored_pairs"}),
        ("wall 5", {"slop": 0.0}),
        ("boxes 40", {"slop": 0.0}),
        ("boxes 40", {"slop": 1e-5, "order": "reverse"}),
        ("wall 5", {"slop": 1e-5, "order": "reverse", "substeps": 3}),
        ("tower 9", {"recycle": 1e-3}),
        ("wall 6", {"recycle": 1e-3}),
        ("boxes 40", {"recycle": 1e-3}),
        ("boxes 20", {"recycle": 5e-3, "order": "given", "substeps": 3}),
        ("tower 9", {"slop": 0.05, "restitution": 0.7, "restitution_threshold": 0.0}),
        ("boxes 20", {"slop": 0.05, "restitution": 0.7, "restitution_threshold": 0.0}),
        ("boxes 30", {"friction": 0.0}),
        ("boxes 30", {"friction_shape": "box"}),
    ),
)
def test_lanes_have_the_bits_of_single_contacts(name, options, lanes):
    scene = build_scene(name, **options)
    if lv.Simulation(scene).state.kernel.lanes < lanes:
        pytest.skip("this processor has no AVX2")
    assert run_in_lanes(scene, lanes, (9, 20)) == run_in_lanes(scene, 0, (9, 20))


def test_towers_and_walls_enter_lanes():
    """Without this, the test above could compare the sweeps of pairs with themselves."""
    for name in ("tower 9", "wall 6", "boxes 40"):
        simulation = lv.Simulation(build_scene(name))
        simulation.run(40)
        assert simulation.state.kernel.groups > 0, name
