"""docs/concepts.md, "The judge", written anew from the page alone: it must give the judge's numbers."""

import numpy as np
import pytest
from random_problems import CONTACTS, FORMS

import lavender as lv
from lavender.problem.cones import CONTACT_BOX, CONTACT_ELLIPSE, ROW


def parts_of(cones, k):
    """(rows, bound over lambda_n) of all that a contact bounds: tangents, spin, rolling; places in the block."""
    size, kind = int(cones.ptr[k + 1] - cones.ptr[k]), cones.kind[k]
    mu, radius, rolling = float(cones.mu[k]), float(cones.patch_radius[k]), float(cones.rolling[k])
    if kind == CONTACT_BOX:
        return [([1], mu), ([2], mu * radius)]
    if kind == CONTACT_ELLIPSE:
        return [([1, 2], mu * max(1.0, radius))]
    if kind == lv.CONTACT_ROLLING:
        spins = [([3], mu * radius)] if size == 6 else []
        return [([1, 2], mu), *spins, ([size - 2, size - 1], rolling)]
    slides = size - 1 - (kind == lv.CONTACT_SPIN)
    found = [(list(range(1, 1 + slides)), mu)] if slides else []
    return found + ([([size - 1], mu * radius)] if kind == lv.CONTACT_SPIN else [])


class Page:
    """A, b and the exceptions of d and nu."""

    def __init__(self, problem):
        c, self.problem = problem.cones, problem
        self.stretch = np.ones(problem.m)
        for k in np.flatnonzero(c.kind == CONTACT_ELLIPSE):
            first, second = 1.0, float(c.patch_radius[k])
            self.stretch[c.ptr[k] + 1 : c.ptr[k] + 3] = np.array([first, second]) / max(first, second)
        self.A = problem.dense() * np.outer(self.stretch, self.stretch)
        self.b = problem.b * self.stretch
        self.d = np.diag(self.A).copy()
        self.nu = self.d.copy()
        for k in np.flatnonzero(c.kind != ROW):
            first = int(c.ptr[k])
            groups = [first + np.array(at) for at, _ in parts_of(c, k)]
            for rows in groups:
                self.d[rows] = self.nu[rows] = self.d[rows].mean()
            turning = groups[1:] if c.kind[k] not in (CONTACT_BOX, CONTACT_ELLIPSE) else []
            if c.kind[k] == lv.CONTACT_SPIN and len(groups) == 1:
                turning = groups  # spin alone
            for rows in turning:
                self.nu[rows] = self.d[first]
        if problem.rows is not None:
            r = problem.rows
            for j in range(r.n_joints):
                for row in range(r.joint_ptr[j], r.joint_ptr[j + 1]):
                    if not r.jac[row][[0, 1, 2, 6, 7, 8]].any():
                        self.nu[row] = sum(r.inv_mass[body] for body in r.joint_body[j] if body >= 0)

    def error(self, lam):
        c, w = self.problem.cones, self.A @ lam - self.b
        y, e = lam - w / self.d, np.zeros(len(lam))
        for k in range(c.n_blocks):
            at = slice(c.ptr[k], c.ptr[k + 1])
            if c.kind[k] == ROW:
                e[at] = lam[at] - np.clip(y[at], c.lower[at], c.upper[at])
                continue
            z, d, parts = y[at], self.d[at], parts_of(c, k)
            if self.problem.law == "cone":
                n, own = self.normal_of(z, d, parts), z.copy()
            else:
                n, own = max(0.0, float(lam[at][0])), z.copy()
            own[0] = n if self.problem.law == "cone" else max(0.0, z[0])
            for rows, reach in parts:
                long = np.linalg.norm(z[rows])
                if long > reach * n:
                    own[rows] = z[rows] * (reach * n / long)
            e[at] = lam[at] - own
        return e

    @staticmethod
    def normal_of(z, d, parts):
        """Normal part of the nearest point of the cone in the metric of d, by bisection on the slope."""

        def slope(n):
            pull = sum(d[at[0]] * a * max(0.0, np.linalg.norm(z[at]) - a * n) for at, a in parts)
            return d[0] * (n - z[0]) - pull

        low, high = 0.0, 10.0 * float(np.abs(z).sum()) + 1.0
        if slope(low) >= 0.0:
            return low
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if slope(middle) < 0.0 else (low, middle)
        return 0.5 * (low + high)

    def measures(self, e):
        """E [sqrt J] and V [m/s]."""
        c = self.problem.cones
        fast = list(np.sqrt(self.nu * self.d) * np.abs(e))
        for k in np.flatnonzero(c.kind != ROW):
            for at, _ in parts_of(c, k):
                rows = c.ptr[k] + np.array(at)
                fast.append(np.sqrt(self.nu[rows[0]] * self.d[rows[0]]) * np.linalg.norm(e[rows]))
        return np.sqrt(np.sum(self.d * e * e)), max(fast)

    def relative(self, impulse):
        energy, velocity = self.measures(self.error(impulse / self.stretch))
        start = np.clip(0.0, self.problem.cones.lower, self.problem.cones.upper)
        energy0, velocity0 = self.measures(self.error(start))
        return energy, velocity, max(energy / energy0, velocity / velocity0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", CONTACTS)
@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_a_residual_written_from_the_page_alone_agrees(kind, law, form):
    for seed in range(6):
        problem = FORMS[form](CONTACTS[kind](seed, law))
        page, rng = Page(problem), np.random.default_rng(seed)
        for size in (0.0, 0.1, 3.0):
            impulse = np.clip(size * rng.normal(size=problem.m), problem.cones.lower, problem.cones.upper)
            found = lv.residual(problem, impulse)
            told = page.relative(impulse)
            np.testing.assert_allclose(told, (found.energy, found.velocity, found.relative), rtol=1e-9)


def moved(mass, v, *, target=0.0, compliance=0.0, lower=-np.inf, upper=np.inf):
    """Velocity after a step of what moves along one row: a row of docs/c.md's table of fields."""
    cones = lv.Cones.bounded(np.array([lower]), np.array([upper]))
    problem = lv.Problem.from_jacobian(
        [[1.0]], [[mass]], [v], target=target, cones=cones, compliance=compliance
    )
    return problem.generalized.velocity_of(problem.velocity(lv.solve(problem, tol=1e-12).impulse)).item()


def test_fields_of_springs_motors_limits_and_gaps_do_what_engines_mean():
    """Each against the equation of motion, solved by hand."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        m, h, v = rng.uniform(0.1, 10.0), 10.0 ** rng.uniform(-4, -1), rng.normal()
        k, c, error, force = (
            10.0 ** rng.uniform(-1, 6),
            10.0 ** rng.uniform(-2, 3),
            rng.normal(),
            rng.uniform(0, 30),
        )
        spring = moved(m, v, compliance=1.0 / (h * (h * k + c)), target=-k * error / (h * k + c))
        # m (v+ - v) = -h (k (C + h v+) + c v+)
        assert spring == pytest.approx((m * v - h * k * error) / (m + h * (h * k + c)), rel=1e-9, abs=1e-9)
        motor = moved(m, v, target=2.0, lower=-h * force, upper=h * force)
        assert motor == pytest.approx(v + np.clip(2.0 - v, -h * force / m, h * force / m), abs=1e-9)
        dry = moved(m, v, lower=-h * force, upper=h * force)
        assert dry == pytest.approx(np.sign(v) * max(0.0, abs(v) - h * force / m), abs=1e-9)
        assert moved(m, v, target=-0.3 * error / h) == pytest.approx(-0.3 * error / h)  # a joint, beta 0.3
        gap = abs(error) * h
        assert gap + h * moved(m, v, target=-gap / h, lower=0.0) == pytest.approx(
            max(0.0, gap + h * v), abs=1e-9
        )


@pytest.mark.parametrize("belt_is_a", [True, False])
def test_what_lies_on_a_belt_is_carried_along(belt_is_a):
    """The belt runs on the world, once as the first body of the contact and once as the second."""
    v = np.array([[0.0, 0.0, -0.1, 0.0, 0.0, 0.0]])
    side = 1.0 if belt_is_a else -1.0
    rows = lv.Rows(
        np.ones(1), np.zeros((1, 3, 3)), v, normal=[[0.0, 0.0, side]], tangent=[[1.0, 0.0, 0.0]],
        contact_body=[[-1, 0] if belt_is_a else [0, -1]], arm_a=np.zeros((1, 3)), arm_b=np.zeros((1, 3)),
    )  # fmt: skip
    problem = lv.Problem.from_rows(rows, mu=5.0, target=[0.0, side * 0.3, 0.0])
    after = problem.velocity(lv.solve(problem, tol=1e-12).impulse)
    np.testing.assert_allclose(after.ravel()[:3], [0.3, 0.0, 0.0], atol=1e-9)
