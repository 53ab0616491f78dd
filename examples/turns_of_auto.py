"""One solve of auto: who has the turns, and what each brings.

A pile under Coulomb's law, 14,046 rows. The way through the tree is printed first, with the costs that it compares.
Then it is solved; the figure shows the least residual after each turn.

    python examples/turns_of_auto.py [FIGURE.png]
"""

import sys

import lavender as lv

TOL = 1e-6  # relative residual


def problem():
    """A pile of spheres in a box, in Coulomb friction."""
    return lv.suite.granular(n=10, friction="coulomb").problem


def main(path="turns_of_auto.png"):
    """Print the way and the turns, and draw them."""
    import matplotlib.pyplot as plt

    pile = problem()
    print(lv.explain(pile, TOL))
    solution = lv.solve(pile, tol=TOL)
    print()
    sweeps, names = [0], []
    residuals = [solution.turns[0].before]
    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
    for turn in solution.turns:
        work = ", ".join(f"{count} {kind}" for kind, count in turn.work.items() if count)
        print(f"{turn.solver:<24} {turn.before:.1e} -> {turn.after:.1e}   {work}")
        sweeps.append(sweeps[-1] + turn.work.get("sweeps", 0))
        residuals.append(turn.after)
        first = turn.solver not in names
        names += [turn.solver] * first
        colour = f"C{names.index(turn.solver)}"
        axes.semilogy(sweeps[-2:], residuals[-2:], "o-", color=colour, label=turn.solver if first else None)
    axes.axhline(TOL, color="0.6", linestyle=":")
    axes.set(xlabel="sweeps of all turns", ylabel="least relative residual [-]")
    axes.legend(frameon=False)
    figure.savefig(path)
    plt.close(figure)
    print(path)
    return solution


if __name__ == "__main__":
    main(*sys.argv[1:])
