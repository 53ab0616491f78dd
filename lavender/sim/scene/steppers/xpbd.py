"""Positions corrected constraint by constraint, velocities from positions (Müller et al., 2020).

    dlambda = (-C - alpha' lambda)/(w + alpha'),  alpha' = alpha/h^2,  w = sum of 1/m + (r x n).I^-1 (r x n)
    v = (x - x0)/h;  what slides is braked by at most mu lambda_n, what parts or closes goes to -e v_n(before)

Nothing is warm-started, so that one sweep in each of many substeps goes further than many in one; a stack creeps where
sweeps of friction do not reach its ends. `lavender_ext/engine/xpbd.pxd`.
"""

from lavender.sim.scene.steppers.spec import StepperSpec

SPEC = StepperSpec(
    name="xpbd",
    number=2,
    summary="position corrections with compliance, velocities from positions, friction and restitution after",
    reference="Müller, Macklin, Chentanez, Jeschke, Kim, Detailed Rigid Body Simulation with XPBD, 2020",
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    residuals=False,
)
