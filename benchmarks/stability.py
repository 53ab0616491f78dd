"""Stability of towers in the engine: eigenvalues of one substep, linearised at rest.

With few warm-started sweeps a substep removes only the fraction kappa of the error of a tower's slow sway. The sway
then oscillates like a weakly damped spring, |z| = sqrt(1 - kappa). A contact with a target that closes its whole gap
within one substep feeds the gap back with gain 1; gains above about kappa excite the sway. In the engine a loaded
contact within the slop has gain 0.

The state of a tower of n boxes consists of positions, rotations and velocities of the boxes and the cached
impulses, 24 n numbers. Near rest (all faces at one gap, the weight distributed evenly over the four corners, no
friction, all contacts loaded and sticking) the substep is a smooth map; its derivative is computed by central
differences of the compiled substep itself.

Let the sweeps of a substep leave the fraction rho of the error of a mode, and let s be its approach speed [m/s], f the
change of s by gravity and the cached impulses in a substep [m/s], G = gap/h [m/s], and g the fraction of the gap that
the target closes in a substep. Then

    w = s + f + g G,   s' = rho w - g G,   f' = f - (1 - rho) w,   G' = G + s'                              (1)
    (z - 1)^3 + kappa ((2 + g) (z - 1)^2 + (1 + 2 g) (z - 1) + g) = 0,   kappa = 1 - rho                    (2)

Without feedback (g = 0) the mode oscillates with |z| = sqrt(rho) = sqrt(1 - kappa), and z = 1: the gap is constant.
With g > 0 it leaves the unit circle if g is larger than about kappa.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike

import click
import numpy as np

from benchmarks.output import markdown
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.sim.engine import Simulation
from lavender.sim.engine.layout import HEAD, SETTING
from lavender.sim.engine.state import State
from lavender.sim.scene import Scene

TOWERS = ((2, 4), (4, 4), (6, 4))  # boxes, sweeps
TALL = ((6, 4), (10, 8), (14, 8))  # taller towers: gravity acts faster than the sweeps
ORDERS = ("given", "symmetric", "alternating")
PLAY = 2e-5  # m, gap of a face with feedback, larger than its change in the differences
STEP = 1e-7  # m, rad, m/s, N s, step of the differences
NEUTRAL = 1e-6  # |z| within this of 1 counts as 1, the accuracy of the differences


@dataclass(frozen=True)
class Modes:
    """Eigenvalues of `substeps` substeps of length h."""

    z: np.ndarray  # (24 n,) complex, largest modulus first
    h: float  # s
    substeps: int

    @property
    def growth(self) -> FloatArray:
        """Growth rate of each mode [1/s]; negative if it decays."""
        rate: FloatArray = np.log(np.maximum(np.abs(self.z), 1e-300)) / (self.h * self.substeps)
        return rate

    @property
    def frequency(self) -> FloatArray:
        """Frequency of each mode [Hz]."""
        hertz: FloatArray = np.abs(np.angle(self.z)) / (2.0 * np.pi * self.h * self.substeps)
        return hertz

    @property
    def stable(self) -> bool:
        """Whether no mode grows."""
        return bool(np.abs(self.z[0]) <= 1.0 + NEUTRAL)


def _read(state: State, n: int) -> FloatArray:
    a = state.a
    q = a["q"][1:]
    turn = 2.0 * q[:, 1:] * np.sign(q[:, :1])
    return np.concatenate(
        [x.ravel() for x in (a["x"][1:], turn, a["v"][1:], a["cache_impulse"][: 4 * n, :3])]
    )


def _write(state: State, n: int, z: FloatArray) -> None:
    a = state.a
    turn = z[3 * n : 6 * n].reshape(n, 3)
    q = np.column_stack([np.ones(n), 0.5 * turn])
    a["x"][1:] = z[: 3 * n].reshape(n, 3)
    a["q"][1:] = q / np.linalg.norm(q, axis=1)[:, None]
    a["v"][1:] = z[6 * n : 12 * n].reshape(n, 6)
    a["cache_impulse"][: 4 * n, 0] = z[12 * n :].reshape(4 * n, 3)[:, 2]
    a["cache_impulse"][: 4 * n, :3] = z[12 * n :].reshape(4 * n, 3)


def _at_rest(
    n: int, sweeps: int, h: float, order: str, friction: float, gap: float, gain: float
) -> State:
    # feedback of a given gain: a loaded contact without slop has the target -beta gap / h
    slop = 0.0 if gain > 0.0 else 1e-3
    scene = Scene(
        "stack",
        n=n,
        dt=h,
        substeps=1,
        order=order,
        friction=friction,
        solver_iterations=sweeps,
        slop=slop,
        position_iterations=0,
    )
    sim = Simulation(scene)
    weight = scene.bodies[1].mass * -scene.parameters.gravity[2] * h
    for last in (False, True):  # the first substep fills the cache
        a = sim.state.a
        a["x"][1:] = [(0.0, 0.0, 0.5 + i + gap * (i + 1)) for i in range(n)]
        a["q"][1:] = (1.0, 0.0, 0.0, 0.0)
        a["v"][:] = 0.0
        if not last:
            sim.step()
    state = sim.state
    found = int(state.head[HEAD["cached"]])
    if found != 4 * n:
        raise InputError(
            f"a tower of {n} boxes at a gap of {gap:g} m has {found} contacts; 4 on each face are needed"
        )
    bodies = (state.a["cache_key"][:found] >> np.uint64(16)).astype(np.int64)
    above = n - np.minimum(bodies >> 24, bodies & 0xFFFFFF)  # number of boxes above each face
    state.a["cache_impulse"][:found] = 0.0
    state.a["cache_impulse"][:found, 0] = 0.25 * weight * above
    state.setting[SETTING["beta"]] = gain
    state.head[HEAD["step"]] = 0
    return state


def modes(
    n: int, sweeps: int, h: float, *, order: str = "given", gain: float = 0.0, friction: float = 0.5
) -> Modes:
    """Compute the eigenvalues of a tower of n unit boxes at rest, without position projection.

    Parameters
    ----------
    n, sweeps : int
    h : float, s
        Substep.
    order : str
        Sweep order of the scene; two substeps are combined if it alternates or is random.
    gain : float
        Fraction g of a loaded contact's gap that is closed in a substep, within the slop; the engine uses 0.
    friction : float
        Has no effect while contacts stick.
    """
    gap = PLAY if gain > 0.0 else -5e-4
    state = _at_rest(n, sweeps, h, order, friction, gap, gain)
    substeps = 2 if order == "alternating" else 1
    rest = _read(state, n)
    work = state.copy()

    def after(z: FloatArray) -> FloatArray:
        work.copy_from(state)
        _write(work, n, z)
        work.kernel.run_substeps(substeps)
        return _read(work, n)

    matrix = np.empty((len(rest), len(rest)))
    for k in range(len(rest)):
        up, down = rest.copy(), rest.copy()
        up[k] += STEP
        down[k] -= STEP
        matrix[:, k] = (after(up) - after(down)) / (2.0 * STEP)
    z = np.linalg.eigvals(matrix)
    return Modes(z[np.argsort(-np.abs(z))], h, substeps)


def slowest(found: Modes) -> tuple[float, float]:
    """Return kappa (fraction of the error that a substep removes) and frequency [Hz] of the slowest decaying mode."""
    inside = np.flatnonzero(np.abs(found.z) < 1.0 - NEUTRAL)
    k = inside[0]
    return float(1.0 - np.abs(found.z[k]) ** (2.0 / found.substeps)), float(found.frequency[k])


def critical_gain(n: int, sweeps: int, h: float, *, order: str = "given", digits: int = 2) -> float:
    """Return the smallest gain with a growing mode: 0 if one grows without feedback, inf if none grows at gain 1."""
    if not modes(n, sweeps, h, order=order).stable:
        return 0.0
    if modes(n, sweeps, h, order=order, gain=1.0).stable:
        return math.inf
    low = math.log(1e-5)
    high = 0.0
    for _ in range(math.ceil(math.log2(-low * 10.0**digits))):
        middle = 0.5 * (low + high)
        if modes(n, sweeps, h, order=order, gain=math.exp(middle)).stable:
            low = middle
        else:
            high = middle
    return math.exp(high)


def model(kappa: float, gain: float) -> np.ndarray:
    """Return the three eigenvalues of equation (2) (3,) complex."""
    roots: np.ndarray = 1.0 + np.roots(
        [1.0, kappa * (2.0 + gain), kappa * (1.0 + 2.0 * gain), kappa * gain]
    )
    return roots


def figure(path: str | PathLike[str]) -> None:
    """Draw growth over gain with equation (2), eigenvalues with and without feedback, and towers that start to lean.

    Raises
    ------
    InputError
        The path cannot be written, or matplotlib does not support its suffix.
    """
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(7.2, 9.0), layout="constrained")
    left, middle, right = canvas.subplots(3, 1)
    h = 1.0 / 60.0
    turn = np.exp(1j * np.linspace(-1.0, 1.0, 200))
    left.plot(turn.real, turn.imag, "k", lw=0.8)
    for gain, mark, label in ((0.0, "o", "in place: g = 0"), (1.0, "x", "whole gap: g = 1")):
        z = modes(6, 4, h, gain=gain).z
        left.plot(z.real, z.imag, mark, ms=5, fillstyle="none", label=label)
    left.set(xlim=(0.7, 1.2), ylim=(-0.8, 0.8), xlabel="Re z", ylabel="Im z")
    left.set_title("6 boxes, 4 sweeps: eigenvalues z of a substep", fontsize=10)
    gains = np.geomspace(1e-3, 1.0, 16)
    for n, sweeps in TOWERS:
        kappa, _ = slowest(modes(n, sweeps, h))
        most = [np.abs(modes(n, sweeps, h, gain=g).z[0]) for g in gains]
        (line,) = middle.semilogx(gains, most, "o", ms=3, label=f"{n} boxes, {sweeps} sweeps")
        middle.semilogx(
            gains,
            [max(1.0, np.abs(model(kappa, g)).max()) for g in gains],
            color=line.get_color(),
            lw=0.8,
        )
        middle.axvline(kappa, color=line.get_color(), lw=0.8, ls=":")
    middle.set(
        xlabel="g, share of the gap closed in a substep", ylabel="largest |z|", ylim=(0.99, 1.21)
    )
    middle.set_title("dots: measured, lines: equation (2), dotted: g = κ", fontsize=10)
    lengths = np.array([1 / 240, 1 / 120, 1 / 60, 1 / 45, 1 / 30])
    for n, sweeps in TALL:
        rate = [max(0.0, modes(n, sweeps, x).growth[0]) for x in lengths]
        right.plot(1e3 * lengths, rate, "o-", ms=4, label=f"{n} boxes, {sweeps} sweeps")
    right.set(xlabel="substep [ms]", ylabel="growth [1/s]")
    right.set_title("g = 0: gravity is quicker than the sweeps", fontsize=10)
    for panel in (left, middle, right):
        panel.legend(fontsize=10, loc="upper left" if panel is not left else "lower right")
    canvas.savefig(path, dpi=150)


def numbers() -> Iterator[tuple[str, ...]]:
    """Yield results for towers in every order: kappa and frequency of the slowest mode, largest |z| at gains 0, 1."""
    for n, sweeps in TOWERS:
        for order in ORDERS:
            still = modes(n, sweeps, 1 / 60, order=order)
            whole = modes(n, sweeps, 1 / 60, order=order, gain=1.0)
            (kappa, hertz) = slowest(still)
            (_, fine) = slowest(modes(n, sweeps, 1 / 240, order=order))
            most, fed = (float(np.abs(m.z[0]) ** (1 / m.substeps)) for m in (still, whole))
            yield (
                str(n),
                str(sweeps),
                order,
                f"{kappa:.2e}",
                f"{hertz:.2f}",
                f"{fine:.2f}",
                f"{most:.6f}",
                f"{fed:.4f}",
            )


@click.command("stability")
@click.option("--figure", "picture", type=click.Path(), help="Eigenvalues and growth, drawn.")
def command(picture: str | None) -> None:
    """Analyse why towers fall with few sweeps: eigenvalues of one substep at rest."""
    head = (
        "boxes",
        "sweeps",
        "order",
        "kappa",
        "Hz, 1/60 s",
        "Hz, 1/240 s",
        "|z|, g = 0",
        "|z|, g = 1",
    )
    click.echo(markdown(head, numbers()))
    for n, sweeps in TOWERS[1:]:
        gain = critical_gain(n, sweeps, 1 / 60, digits=1)
        (kappa, _) = slowest(modes(n, sweeps, 1 / 60))
        click.echo(
            f"{n} boxes, {sweeps} sweeps: the first mode leaves the unit circle at g = {gain:.1e} (kappa {kappa:.1e})"
        )
    if picture is not None:
        figure(picture)
