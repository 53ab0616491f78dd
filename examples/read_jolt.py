"""Record the steps of a stack of four boxes in Jolt for `lavender report`, and judge each.

`examples/jolt_step.mjs` steps the stack and prints a line of JSON for each step:

    npm install jolt-physics@1.1.0
    node examples/jolt_step.mjs 10 > jolt-steps.jsonl

    python examples/read_jolt.py
"""

import json
import sys
from pathlib import Path

import numpy as np

import lavender as lv


def record(folder, path="jolt-steps.jsonl"):
    """Write the problems of the steps to a folder, and return the velocity errors of Jolt [m/s]."""
    dt, gravity = 1 / 60, np.array([0.0, -9.81, 0.0, 0.0, 0.0, 0.0])
    errors = []
    with lv.io.Recorder(folder, every=1, solver="Jolt") as recorder:
        for line in Path(path).read_text().splitlines():
            step = json.loads(line)
            free = np.array(step["velocity"]) + dt * gravity
            inv_inertia = np.tile(6 * np.eye(3), (4, 1, 1))
            builder = lv.RowBuilder(
                np.ones(4), inv_inertia, free, dt, step["position"], baumgarte=0.0
            )
            for contact in step["contacts"]:
                for i, found in enumerate(contact["points"]):
                    a, b, point, gap = (
                        contact["a"],
                        contact["b"],
                        found["point"],
                        max(found["gap"], 0.0),
                    )
                    builder.contact(
                        a, b, point, contact["normal"], gap=gap, mu=contact["mu"], feature=i
                    )
            (verdict,) = recorder.add(builder.problem(), velocity=step["after"])
            errors.append(verdict.velocity_error)
    return errors


def main():
    """Record the steps and print the median of their errors."""
    if not Path("jolt-steps.jsonl").is_file():
        sys.exit("jolt-steps.jsonl is missing: node examples/jolt_step.mjs 10 > jolt-steps.jsonl")
    errors = record("jolt-steps")
    print(f"{len(errors)} steps, median velocity error {np.median(errors):.1e} m/s")


if __name__ == "__main__":
    main()
