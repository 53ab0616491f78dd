"""The impedance and the contact settings of two geoms, by laws that hold for all of their numbers."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from lavender.io.impedance import compute_impedance
from lavender.io.step_record import GeomSettings, Softness


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 5.0])
@pytest.mark.parametrize("middle", [0.1, 0.3, 0.5, 0.8])
def test_impedance_is_symmetric_about_its_midpoint_and_grows(power, middle):
    """From d0 to d1 the curve turned by half a turn is the one of the midpoint 1 - middle."""
    d0, d1, width = 0.2, 0.9, 0.01

    def share(x, middle):
        solimp = np.array([d0, d1, width, middle, power])
        return (compute_impedance(solimp, x * width) - d0) / (d1 - d0)

    places = np.linspace(0.0, 1.0, 41)
    found = np.array([share(x, middle) for x in places])
    turned = np.array([1.0 - share(1.0 - x, 1.0 - middle) for x in places])
    np.testing.assert_allclose(found, turned, atol=1e-12)
    assert (found[0], found[-1]) == pytest.approx((0.0, 1.0), abs=1e-12)
    assert (np.diff(found) > 0.0).all() and share(middle, middle) == pytest.approx(middle)


def test_settings_of_a_contact_do_not_depend_on_the_order_of_its_geoms():
    rng = np.random.default_rng(0)
    geoms = [
        GeomSettings(
            int(rng.choice([1, 3, 6])), int(rng.integers(2)), float(mix), rng.uniform(0.1, 1.0, 5),
            replace(Softness(), solref=np.array(solref), solimp=np.array([0.8, 0.9, 0.001, 0.5, 2.0])),
        )
        for mix in (0.0, 0.5, 1.0)
        for solref in ((0.02, 1.0), (0.1, 0.5), (-100.0, -5.0), (-900.0, -2.0))
    ]  # fmt: skip
    for a, b in itertools.combinations(geoms, 2):
        (condim, friction, soft), (other, rubs, softer) = a.combine(b), b.combine(a)
        assert condim == other and friction.tolist() == rubs.tolist()
        np.testing.assert_allclose(soft.solref, softer.solref, rtol=1e-12)
        np.testing.assert_allclose(soft.solimp, softer.solimp, rtol=1e-12)
