"""Exercise 2: Jacobi, coloured Gauss-Seidel and Gauss-Seidel: what parallel updates cost in convergence.

Row i of a Gauss-Seidel sweep uses the newest values of the rows before it, so the rows of a sweep are updated one
after the other. A Jacobi sweep reads only the values of the sweep before, so all of its rows can be updated at once.
A coloured sweep lies between: rows of one colour share no movable body, so none of them reads what another one
writes. They can be updated in any order or at once, with the same bits. A stack of boxes needs two colours.

The price is in sweeps. For a stack (A tridiagonal) the error of a Gauss-Seidel sweep shrinks by the square of that of
an undamped Jacobi sweep: Jacobi needs twice as many sweeps. The number of updates that must follow each other is the
number of sweeps times the colours of a sweep. For two colours and for Jacobi this is the same number here. If rows of
one contact repeat each other, undamped Jacobi does not converge (k equal rows: its step is k - 1 times too long); the
damping that is safe for every problem costs more sweeps.

A solver checks its residual more and more seldom, so the sweeps that it reports can be an eighth more than needed.
The table shows the first sweep that meets the tolerance.

    python examples/jacobi.py [FIGURE.png]

The chapter shows it as stages.png.
"""

import sys
from bisect import bisect_left

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv
from lavender.problem.ordering import compute_block_colors

N = 32  # contacts of the stack
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
TOL = 1e-3  # relative residual
MAX_SWEEPS = 100_000
METHODS = {
    "Gauss-Seidel": ("pgs", {"order": "given"}),
    "Gauss-Seidel, coloured": ("pgs", {"order": "colored"}),
    "Jacobi, undamped": ("jacobi", {"omega": 1.0}),
    "Jacobi, safe damping": ("jacobi", {}),
}
STAGES = {
    "Gauss-Seidel": N,
    "Gauss-Seidel, coloured": 2,
    "Jacobi, undamped": 1,
    "Jacobi, safe damping": 1,
}
SHUFFLES = 20
BUDGET = 50  # sweeps of the comparison of orders


def make_stack():
    """Return the LCP of N boxes that fall by one step of gravity: A (N, N) tridiagonal [1/kg], b (N,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    return lv.Problem.lcp(jacobian @ jacobian.T, jacobian @ np.full(N, GRAVITY_STEP), name="stack")


def make_repeated(k=3):
    """Return one contact counted k times: A (k, k) of ones."""
    return lv.Problem.lcp(np.ones((k, k)), np.ones(k), name=f"{k} equal rows")


def compare_orders():
    """Return how many different impulses (in bits) shuffled orders give: within the colours, and of all rows."""
    stack = make_stack()
    rng = np.random.default_rng(0)
    color = compute_block_colors(stack)

    def sweep(order):
        return lv.solve(stack, "pgs", order=order, tol=0.0, max_iter=BUDGET).impulse.tobytes()

    within = {sweep("colored")}
    within |= {sweep(np.lexsort((rng.random(N), color)).astype(np.int32)) for _ in range(SHUFFLES)}
    every = {sweep(rng.permutation(N).astype(np.int32)) for _ in range(SHUFFLES)}
    return {"colours": int(color.max()) + 1, "within": len(within), "every": len(every)}


def solve_by(name, problem, max_iter, **more):
    """Return the solution of a problem by one of METHODS."""
    solver, options = METHODS[name]
    return lv.solve(problem, solver, tol=TOL, max_iter=max_iter, **options, **more)


def find_first_sweep(name, problem, converged):
    """Return the smallest number of sweeps that meets TOL, of at most `converged`."""
    solver, options = METHODS[name]
    return 1 + bisect_left(
        range(1, converged + 1),
        True,
        key=lambda n: (
            lv.solve(problem, solver, tol=0.0, max_iter=n, **options).residual.relative <= TOL
        ),
    )


def numbers():
    """Return the solutions of the stack and of the repeated contact, and the comparison of orders."""
    return Numbers(
        stack=lambda: {
            name: solve_by(name, make_stack(), MAX_SWEEPS, history=True) for name in METHODS
        },
        repeated=lambda: {name: solve_by(name, make_repeated(), 1000) for name in METHODS},
        orders=compare_orders,
    )


def draw_stages(axes, found):
    """Draw the residual against the number of updates that follow each other."""
    for i, (name, solution) in enumerate(found["stack"].items()):
        h = solution.history
        axes.loglog(
            h.iterations[1:] * STAGES[name],
            h.relative[1:],
            ["-", "-", "--", ":"][i],
            color=f"C{i}",
            label=name,
        )
    axes.axhline(TOL, color="0.7", linewidth=0.8)
    axes.set(
        title=f"a stack of {N}, to {TOL:g}",
        xlabel="updates one after the other",
        ylabel="relative residual [-]",
    )
    put_legend_right(axes)


PANELS = {"stages": draw_stages}


def print_numbers(found):
    """Print the tables."""
    print(f"{'':<24}{'sweeps':>8}{'stages of one':>15}{'stages':>9}   three equal rows")
    for name, solution in found["stack"].items():
        sweeps = find_first_sweep(name, make_stack(), solution.work["sweeps"])
        status = found["repeated"][name].status.name.lower().replace("_", " ")
        print(f"{name:<24}{sweeps:>8}{STAGES[name]:>15}{sweeps * STAGES[name]:>9}   {status}")
    orders = found["orders"]
    print(
        f"{orders['colours']} colours: {SHUFFLES} shuffled orders within the colours and order='colored' give "
        f"{orders['within']} result in bits after {BUDGET} sweeps; {SHUFFLES} orders of all rows give {orders['every']}"
    )
    for name in ("Gauss-Seidel", "Jacobi, safe damping"):
        impulse = found["repeated"][name].impulse
        print(
            f"three equal rows, {name}: impulses {' '.join(f'{x + 0.0:.3f}' for x in impulse)}, sum {impulse.sum():.3f}"
        )


def main(path="jacobi.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
