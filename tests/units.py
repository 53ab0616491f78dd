"""Problems of bodies in other units, and the factor by which a quantity changes with them."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Units:
    """Factors of all lengths, masses and times; powers of two, so that nothing rounds."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def factor(self, unit):
        """Return the factor of a quantity with this unit."""
        length, mass, time = self.length, self.mass, self.time
        return {
            "": 1.0, "m": length, "m/s": length / time, "rad/s": 1.0 / time, "m/s^2": length / time**2,
            "rad/s^2": time**-2, "N": mass * length / time**2, "N m": mass * length**2 / time**2,
            "N s": mass * length / time, "N m s": mass * length**2 / time, "sqrt(J)": mass**0.5 * length / time,
            "J": mass * length**2 / time**2,
        }[unit]  # fmt: skip

    def scale(self, problem):
        """Return a problem of bodies in these units, and the factor of the unit of each impulse (m,)."""
        rows, cones, angular = problem.rows, problem.cones, problem.angular_rows
        jac = rows.jac.reshape(-1, 4, 3).copy()
        jac[:, 1::2] *= np.where(angular[: len(jac)], 1.0, self.length)[:, None, None]
        velocity = rows.v_free / self.time
        velocity[:, :3] *= self.length
        scaled = replace(
            rows, jac=jac.reshape(-1, 12), v_free=velocity, arm_a=self.length * rows.arm_a,
            arm_b=self.length * rows.arm_b, inv_mass=rows.inv_mass / self.mass,
            inv_inertia=rows.inv_inertia / (self.mass * self.length**2),
        )  # fmt: skip
        impulse = np.where(angular, self.factor("N m s"), self.factor("N s"))
        speed = np.where(angular, self.factor("rad/s"), self.factor("m/s"))
        # For boxes and ellipses the radius is a ratio without unit.
        cones = replace(
            cones, lower=impulse * cones.lower, upper=impulse * cones.upper, rolling=self.length * cones.rolling,
            patch_radius=np.where(cones.spin_rows >= 0, self.length, 1.0) * cones.patch_radius,
        )  # fmt: skip
        compliance = problem.compliance * speed / impulse
        return replace(
            problem,
            rows=scaled,
            cones=cones,
            b=speed * problem.b,
            guess=None,
            compliance=compliance,
        ), impulse


#: Masses have even powers, so that roots do not round.
UNITS = {
    "lengths": Units(length=8.0),
    "light and fast": Units(mass=2.0**-30, time=2.0**-7),
    "all": Units(length=0.25, mass=2.0**30, time=2.0),
}
