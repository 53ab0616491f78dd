"""A Newton step of 6 x 6 for body after body on an augmented Lagrangian, whose multipliers are warm-started (2025).

    (M/h + sum kappa J^T J) dz = -M (z - y)/h + sum J^T p,   p = lambda - kappa C(z), clipped to its bounds or disk
    then lambda <- p, and kappa grows with the error that is left

`solver_iterations` counts passes over the bodies. `lavender_ext/engine/avbd.pxd`.
"""

from lavender.sim.scene.steppers.spec import Option, StepperSpec

SPEC = StepperSpec(
    name="avbd",
    number=3,
    summary="block descent over bodies, augmented Lagrangian with warm-started multipliers and stiffness",
    reference="Giles, Diaz, Yuksel, Augmented Vertex Block Descent, SIGGRAPH 2025",
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    restitution=False,
    residuals=False,
    options={
        "keep": Option("hertz", 0.99, 0.0, 1.0, "share of an error that a substep leaves [-]"),
        "stiffening": Option(
            "ratio", 0.03, 0.0, 1e3, "growth of stiffness, of its least for an error of the slop [-]"
        ),
    },
)
