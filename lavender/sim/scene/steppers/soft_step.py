"""Contacts and joints as damped springs, then a relaxation that takes away the velocity that pushed (Catto, 2024).

    omega = 2 pi f,  a1 = 2 zeta + h omega,  a2 = h omega a1
    J v + (omega / a1) C + (A_ii / a2) lambda = 0      while C < 0,      v_n >= -C/h while the gap C is open      (1)
    after positions have moved: sweeps without the spring; restitution last

(1) is the implicit damped spring of frequency f and damping ratio zeta on the effective mass 1/A_ii; its derivation
stands in `lavender_ext/engine/soft_step.pxd`. Contacts with what never moves, and joints, are twice as stiff; no spring
swings faster than four substeps can follow. One sweep in each of many substeps goes furthest.
"""

from lavender.sim.scene.steppers.spec import Option, StepperSpec

SPEC = StepperSpec(
    name="soft_step",
    number=1,
    summary="soft contacts and joints by sweeps with bias, then relaxing sweeps without",
    reference="Catto, Solver2D, 2024",
    boxes=True,
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    spin=True,
    options={
        "hertz": Option("hertz", 60.0, 1e-3, 1e6, "frequency of contacts [1/s]; at most a quarter of 1/h"),
        "damping_ratio": Option("ratio", 2.0, 0.0, 1e6, "of contacts [-]"),
        "push_speed": Option("push", 3.0, 0.0, 1e6, "largest speed at which overlaps are pushed apart [m/s]"),
        "relaxing_sweeps": Option("relaxing", 1, 0, 64, "sweeps without bias after the others"),
    },
)
