"""Record natively what WebAssembly is to repeat: scenes step by step.

    python tests/sim/web/record.py FOLDER

writes FOLDER/recording.json (what there is) and FOLDER/recording.bin (the numbers, little-endian).
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from newton_steps import NewtonSteps

import lavender as lv
from lavender.sim.web.scenes import describe_layout, describe_snapshot

STEPS = 300
BLOW = [
    1.5,
    0.2,
    -1.0,
    0.0,
    3.0,
    0.1,
]  # m/s, rad/s: set before the snapshot that the replay makes at step 149, too
BODY_ARRAYS = ("x", "q", "v")

#: Gallery scene, parameters, and what is changed before which step.
SCENES = [
    ("stack", {}, {100: {"warm_start": 0}, 200: {"warm_start": 1}}),
    ("stack", {"substeps": 1}, {}),
    ("stack", {"n": 4}, {40: {"velocity": [4, BLOW]}, 149: {"velocity": [2, BLOW[::-1]]}}),
    ("pyramid", {"base": 8}, {150: {"iterations": 4}}),
    ("chain", {"tip_mass": 5.0}, {}),
    ("spinner", {}, {}),
    ("pile", {"n": 60, "kind": "mixed", "substeps": 2}, {}),
    ("stack", {"n": 5, "order": "random", "seed": 3, "solver_iterations": 64}, {}),
    ("pyramid", {"base": 4, "order": "symmetric"}, {}),
    ("pyramid", {"base": 4, "order": "top_down", "solver_iterations": 4}, {}),
    ("card_house", {"order": "bottom_up"}, {}),
    ("bridge", {"order": "colored"}, {}),
    ("four_bar", {"order": "reverse", "motor": 2.0}, {}),
    ("newtons_cradle", {}, {}),
    ("pyramid", {"base": 4, "order": "colored_pairs", "restitution": 0.3}, {}),
    ("pile", {"n": 30, "kind": "mixed", "friction_shape": "box"}, {}),
]


#: The same for Newton's method on both sides of the border: joints and contacts alone and together, spin, cold starts.
NEWTON_STEPS = 80
NEWTON_SCENES = [
    ("stack", {}, {20: {"warm_start": 0}, 60: {"warm_start": 1}}),
    ("pyramid", {"base": 5, "friction": 0.15}, {}),
    ("pile", {"n": 12, "kind": "mixed"}, {}),
    ("pyramid", {"base": 4, "friction_shape": "box"}, {}),
    ("bridge", {"n": 5}, {}),
    ("chain", {}, {60: {"warm_start": 0}}),
    ("four_bar", {}, {}),
    ("spinner", {}, {60: {"warm_start": 0}}),
]


class Writer:
    """Arrays one after the other, and where each one is."""

    def __init__(self):
        self.parts = []
        self.at = 0

    def put(self, values, dtype):
        data = np.ascontiguousarray(values).astype(dtype).tobytes()
        data += bytes(-len(data) % 8)
        place = [self.at, int(np.size(values)), np.dtype(dtype).str[1:]]
        self.parts.append(data)
        self.at += len(data)
        return place


def record_scene(writer, name, parameters, changes, steps=STEPS):
    """One scene over `steps` steps: poses, velocities, eight values and the hash of everything, after each."""
    scene = lv.Scene(name, **parameters)
    # The second one sweeps over single contacts, as WebAssembly does; contacts in lanes leave other numbers
    # in the arrays that no substep reads.
    simulation, single = lv.Simulation(scene), lv.Simulation(scene)
    start = simulation.snapshot()
    states, values, hashes = [], [], []
    for step in range(steps):
        change = changes.get(step, {})
        for s in (simulation, single):
            if "iterations" in change:
                s.set_solver_iterations(change["iterations"])
            if "warm_start" in change:
                s.set_warm_start(bool(change["warm_start"]))
            if "velocity" in change:
                body, v = change["velocity"]
                s.set_velocity(body, v[:3], v[3:])
        observation = simulation.step()[0]
        single.state.kernel.lanes = 0  # Larger buffers have a new kernel.
        single.step()
        shot = single.snapshot()
        states.append(
            np.concatenate(
                [observation[key].ravel() for key in ("positions", "quaternions", "velocities")]
            )
        )
        values.append(observation["solver"])
        hashes.append(
            hashlib.sha256(
                shot.real.tobytes() + shot.index.tobytes() + shot.keys.tobytes()
            ).digest()
        )
    given = ", ".join(f"{key}={value}" for key, value in parameters.items())
    return {
        "name": f"{name}({given})",
        "substeps": scene.parameters.substeps,
        "steps": steps,
        "changes": {str(step): change for step, change in changes.items()},
        **describe_snapshot(start),
        "states": writer.put(states, "<f8"),
        "values": writer.put(values, "<f8"),
        "hashes": writer.put(np.frombuffer(b"".join(hashes), np.uint8), "|u1"),
        "last": writer.put(shot.real, "<f8"),
    }


def record_newton(writer, name, parameters, changes):
    """A scene solved by Newton's method: poses, the eight values, what each last solve said, the hash of everything."""
    run = NewtonSteps(name, **parameters)
    start = run.simulation.snapshot()
    states, values, said, hashes = [], [], [], []
    for step in range(NEWTON_STEPS):
        if step in changes:
            run.set_warm_start(changes[step]["warm_start"])
        values.append(run.step())
        states.append(run.bodies())
        said.append([*run.told[1:], len(run.trace)])
        hashes.append(hashlib.sha256(run.everything()).digest())
    given = ", ".join(f"{key}={value}" for key, value in parameters.items())
    return {
        "name": f"{name}({given}), newton",
        "dt": run.simulation.scene.parameters.dt,
        "substeps": run.substeps,
        "newton_substeps": run.substeps,
        "steps": NEWTON_STEPS,
        "changes": {str(step): change for step, change in changes.items()},
        **describe_snapshot(start),
        "met": sum(how > 0 for how in run.ended),
        "solved": len(run.ended),
        "states": writer.put(states, "<f8"),
        "values": writer.put(values, "<f8"),
        "said": writer.put(said, "<f8"),
        "trace": writer.put(run.trace, "<f8"),
        "hashes": writer.put(np.frombuffer(b"".join(hashes), np.uint8), "|u1"),
    }


def record(folder, steps=STEPS):
    """Both files; returns the path of the JSON."""
    writer = Writer()
    scenes = [record_scene(writer, *scene, steps=steps) for scene in SCENES]
    newton = [record_newton(writer, *scene) for scene in NEWTON_SCENES]
    contents = {
        "layout": describe_layout(),
        "body_arrays": BODY_ARRAYS,
        "scenes": scenes,
        "newton": newton,
    }
    path = Path(folder) / "recording.json"
    path.write_text(json.dumps(contents, allow_nan=False), encoding="utf-8")
    path.with_suffix(".bin").write_bytes(b"".join(writer.parts))
    return path


if __name__ == "__main__":
    print(record(sys.argv[1]))
