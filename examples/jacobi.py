"""Exercise 2: what Jacobi buys in place of Gauss-Seidel, and what it costs.

A Gauss-Seidel sweep uses what it has just found; row i waits for row i - 1. A Jacobi sweep reads only what
the sweep before has left, so all rows can go at once, and one thread each is not too many. Coloured
Gauss-Seidel stands between: rows of one colour share no body, and a stack of boxes needs two colours.

The price is in sweeps. On a stack (A tridiagonal) the error of a Gauss-Seidel sweep shrinks by the square of
what undamped Jacobi's does: twice the sweeps. So two colours with half as many threads wait as long as Jacobi with a
thread for each row, and with as many threads as rows no longer than that: Jacobi wins nothing here. Where rows of
one contact repeat each other, undamped Jacobi
does not end at all (k equal rows: it is k - 1 times too strong); the damping that makes it safe for every
problem costs more sweeps again.

This counts; it measures no time, for `jacobi` itself runs on one thread: sweep by sweep, and by how many rows wait.

Rows done one after the other, with T threads: sweeps x the sum over the colours of ceil(rows of it / T).

    python examples/jacobi.py [FIGURE.png]

The chapter shows it as threads.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

N = 32  # contacts of the stack
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
TOL = 1e-3  # relative residual
MOST = 100_000  # sweeps
THREADS = (1, 2, 4, 8, 16, 32)
WAYS = {
    "Gauss-Seidel": ("pgs", {"order": "given"}),
    "Gauss-Seidel, coloured": ("pgs", {"order": "colored"}),
    "Jacobi, undamped": ("jacobi", {"omega": 1.0}),
    "Jacobi, safe damping": ("jacobi", {}),
}
COLOURS = {"Gauss-Seidel": N, "Gauss-Seidel, coloured": 2, "Jacobi, undamped": 1, "Jacobi, safe damping": 1}


def stack():
    """N boxes that fall by one step of gravity: A (N, N) tridiagonal [1/kg], b (N,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    return lv.Problem.lcp(jacobian @ jacobian.T, jacobian @ np.full(N, GRAVITY_STEP), name="stack")


def repeated(k=3):
    """One contact counted k times: A (k, k) of ones."""
    return lv.Problem.lcp(np.ones((k, k)), np.ones(k), name=f"{k} equal rows")


def one_after_the_other(name, sweeps, threads):
    """Rows that wait for each other."""
    rows = N / COLOURS[name]
    return sweeps * COLOURS[name] * int(np.ceil(rows / threads))


def numbers():
    """Solutions of the stack and of the repeated contact, and rows done one after the other by threads."""
    solved = {
        name: lv.solve(stack(), solver, tol=TOL, max_iter=MOST, history=True, **more)
        for name, (solver, more) in WAYS.items()
    }
    return {
        "stack": solved,
        "repeated": {
            name: lv.solve(repeated(), solver, tol=TOL, max_iter=1000, **more)
            for name, (solver, more) in WAYS.items()
        },
        "waiting": {
            name: [one_after_the_other(name, s.work["sweeps"], t) for t in THREADS]
            for name, s in solved.items()
        },
    }


def draw_threads(axes, found):
    """Rows one after the other against threads."""
    for i, (name, waiting) in enumerate(found["waiting"].items()):
        axes.loglog(THREADS, waiting, "o^sx"[i] + "-", color=f"C{i}", label=name)
    title = f"until the relative residual is {TOL:g}"
    axes.set(title=title, xlabel="threads", ylabel="rows one after the other")
    axes.set_xticks(THREADS, [str(t) for t in THREADS])
    axes.minorticks_off()
    beside(axes)


PANELS = {"threads": draw_threads}


def main(path="jacobi.png"):
    """Print the table, save the figure."""
    found = numbers()
    print(f"{'':<24}{'sweeps':>8}  rows one after the other, by threads")
    print(f"{'':<24}{'':>8}" + "".join(f"{t:>9}" for t in THREADS) + "   three equal rows")
    for name, solution in found["stack"].items():
        print(
            f"{name:<24}{solution.work['sweeps']:>8}"
            + "".join(f"{x:>9}" for x in found["waiting"][name])
            + f"   {found['repeated'][name].status.name.lower().replace('_', ' ')}"
        )
    coloured, jacobi = found["waiting"]["Gauss-Seidel, coloured"], found["waiting"]["Jacobi, undamped"]
    print(
        f"coloured Gauss-Seidel on {THREADS[-2]} threads waits for {coloured[-2]} rows, "
        f"Jacobi on {THREADS[-1]} for {jacobi[-1]}"
    )
    for name in ("Gauss-Seidel", "Jacobi, safe damping"):
        impulse = found["repeated"][name].impulse
        print(
            f"three equal rows, {name}: impulses {' '.join(f'{x + 0.0:.3f}' for x in impulse)}, sum {impulse.sum():.3f}"
        )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
