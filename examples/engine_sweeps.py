"""Experiment 4: what a budget of 4 to 64 sweeps gives inside an engine.

The scene is `stack` with its defaults: six boxes of 1 kg with edges of 1 m, friction 0.5, steps of 1/120 s in two
substeps. Every step publishes the residual max |e_n| [N s], the approach velocity that is left [m/s], and the
penetration [m], which adds up over the steps.

First solve, at rest and from zero impulses: the error by budget and order, by the published residual and by the judge
over all rows. They disagree across orders. e_n = w_n/d_n, and at the ground only one body moves: d_n is half of that
between two boxes, so the same approach velocity w_n publishes twice the residual there. Swept from the bottom up, the
largest velocity is left at the ground. Swept from the top down, the ground is swept last and the velocities are left
above: max |e_n| is half as large, yet the boxes approach faster and sink deeper. The judge adds the energy of all
rows and takes the largest velocity, and says so.

Cold run, steps 21 to 60: with few sweeps the residual is larger than in the first solve. Each solve must build up the
whole weight from zero, so the boxes sink until b is large enough that n sweeps reach it. With G the error matrix of a
sweep and l the impulses that hold the stack,

    l = (1 - G^n) x,   e = (A (l - x)) / d                                                    (dense model)

without friction, since the friction disks do not sweep like a matrix. Cold stacks move sideways, lean, and fall in
the end. A stack has fallen once a box is half an edge lower than it began, which is much later than
the time at which a box has moved by 5 cm. Warm stacks stand on every budget.

Order: with friction, a cold run that is always swept in the same direction keeps a slow sway that 64 sweeps do not
remove. If the order of the contacts is reversed in every other substep (`alternating`, the default), 64 sweeps leave
several times less by the judge; 4 to 16 sweeps, which leave much of every error, gain nothing. The ratio depends on
the steps at which it is taken, so every number has its window.

    python examples/engine_sweeps.py [FIGURE.png]

A file named after a panel shows it alone: published.png, by_budget.png, stand.png.
"""

import functools
import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

BUDGETS = (4, 8, 16, 32, 64)
ORDERS = ("alternating", "bottom_up", "top_down", "random", "colored", "symmetric")
RUNS = ("alternating", "bottom_up", "top_down")
COMPARED = ("bottom_up", "alternating")
WINDOW = (21, 60)  # first and last step of which medians are taken
TAILS = ((21, 60), (181, 240))  # steps of which the ratio of 4 to 64 sweeps is taken
STARTS = ((21, 90), (91, 120))  # steps of which the ratio of cold to warm starts is taken
STEPS = 240
ENDS = (BUDGETS[0], BUDGETS[-1])
MOVED = 0.05  # m
LIMIT = 180.0  # s, simulated to see whether a stack falls


def solve_first(sweeps, order):
    """Return of the first solve max |e_n| [N s], and the judge's relative residual of all rows [-]."""
    problem = lv.Simulation(lv.Scene("stack", warm_start=False)).constraint_problem()
    # the problem of a substep lists its contacts in the order in which `alternating` sweeps them
    order = "given" if order == "alternating" else order
    impulse = lv.solve(problem, "sequential_impulses", tol=0, max_iter=sweeps, order=order).impulse
    judged = lv.residual(problem, impulse)
    return np.abs(judged.error[problem.cones.ptr[:-1]]).max(), judged.relative


def make_simulation(sweeps, order, warm):
    """Return a simulation of the stack and the positions (7, 3) [m] at its start."""
    sim = lv.Simulation(lv.Scene("stack", solver_iterations=sweeps, order=order, warm_start=warm))
    return sim, sim.reset()[0]["positions"]


@functools.cache
def run(sweeps, order, warm):
    """Return five columns for each of STEPS steps, in the order of the comments below."""
    sim, start = make_simulation(sweeps, order, warm)
    rows = []
    for _ in range(STEPS):
        observation = sim.step()[0]
        values = dict(zip(lv.SOLVER_FIELDS, observation["solver"], strict=True))
        rows.append(
            (
                values["residual_initial"],  # N s, before the first sweep
                values["residual_final"],  # N s, after the last sweep
                values["violation_final"],  # m/s
                observation["contacts"]["depth"].max(),  # m
                np.abs(observation["positions"] - start).max(),  # m, how far a box has moved
            )
        )
    return np.array(rows)


@functools.cache
def judge(sweeps, order, warm, window=WINDOW):
    """Return the median relative residual of all rows [-] over the steps of a window."""
    sim, _ = make_simulation(sweeps, order, warm)
    relative = []
    for step in range(1, window[1] + 1):
        sim.report_residual = step >= window[0]  # costs as much as ten steps
        info = sim.step()[-1]
        if sim.report_residual:
            relative.append(info["residual"]["relative"])
    return np.median(relative)


def summarize(order, warm):
    """Return by budget (5, 3): medians of residual and violation in WINDOW, and the largest depth up to its end."""
    rows = [run(n, order, warm)[: WINDOW[1]] for n in BUDGETS]
    return np.array([(*np.median(x[WINDOW[0] - 1 :, 1:3], axis=0), x[:, 3].max()) for x in rows])


def compare_orders():
    """Return by order: ratios 4 to 64 in TAILS and cold to warm in STARTS, m moved on 64 sweeps, judged (2, 5)."""
    out = {}
    for order in COMPARED:
        few, many = (run(n, order, False) for n in ENDS)
        warm = run(ENDS[0], order, True)
        out[order] = {
            "tails": [
                np.median(few[a - 1 : b, 1]) / np.median(many[a - 1 : b, 1]) for a, b in TAILS
            ],
            "starts": [
                np.median(few[a - 1 : b, 0]) / np.median(warm[a - 1 : b, 0]) for a, b in STARTS
            ],
            "moved": many[-1, 4],
            "judged": np.array(
                [[judge(n, order, False, window) for n in BUDGETS] for window in TAILS]
            ),
        }
    return out


def time_fall(sweeps, warm):
    """Return times [s]: a box has moved by MOVED, a contact is lost, the stack has fallen; nan if not in LIMIT."""
    sim, start = make_simulation(sweeps, "alternating", warm)
    moved = lost = np.nan
    while sim.time < LIMIT:
        observation = sim.step()[0]
        positions = observation["positions"]
        if np.isnan(moved) and np.abs(positions - start).max() > MOVED:
            moved = sim.time
        if np.isnan(lost) and len(observation["contacts"]["depth"]) < 24:
            lost = sim.time
        if (start[:, 2] - positions[:, 2]).max() > 0.5:
            return moved, lost, sim.time
    return moved, lost, np.nan


def predict_residual(sweeps):
    """Return max |e_n| [N s] that the dense model predicts for a cold run without friction, swept bottom-up."""
    scene = lv.Scene("stack", friction=0.0)
    problem = lv.Simulation(scene).constraint_problem()
    a = problem.dense()
    m = problem.m
    g = np.eye(m) - np.linalg.solve(np.tril(a), a)
    step = scene.parameters.dt / scene.parameters.substeps
    weight = np.repeat(np.arange(6, 0, -1), 4) * 9.81 * step / 4.0
    x = np.linalg.lstsq(np.eye(m) - np.linalg.matrix_power(g, sweeps), weight, rcond=None)[0]
    return np.abs((a @ (weight - x)) / np.diag(a)).max()


def run_without_friction(sweeps):
    """Return max |e_n| [N s] of the run that the dense model describes."""
    scene = lv.Scene(
        "stack", friction=0.0, warm_start=False, solver_iterations=sweeps, order="bottom_up"
    )
    sim = lv.Simulation(scene)
    at = lv.SOLVER_FIELDS.index("residual_final")
    return float(
        np.median([sim.step()[0]["solver"][at] for _ in range(2 * WINDOW[1])][WINDOW[1] :])
    )


def numbers():
    """Return first solves and runs by order and budget, the times at which stacks fall, and the dense model."""
    return Numbers(
        first=lambda: {
            order: np.array([solve_first(n, order) for n in BUDGETS]) for order in ORDERS
        },  # (5, 2)
        cold=lambda: {order: summarize(order, False) for order in RUNS},  # (5, 3) each
        warm=lambda: summarize("alternating", True),
        judged=lambda: {
            order: np.array([judge(n, order, False) for n in BUDGETS]) for order in RUNS
        },
        judged_warm=lambda: np.array([judge(n, "alternating", True) for n in BUDGETS]),
        falls=lambda: {
            warm: np.array([time_fall(n, warm) for n in BUDGETS]) for warm in (False, True)
        },  # (5, 3) s
        compared=compare_orders,
        predicted=lambda: np.array([predict_residual(n) for n in BUDGETS]),
        without_friction=lambda: np.array([run_without_friction(n) for n in BUDGETS]),
    )


def set_budget_axis(axes):
    """Show the budgets on a logarithmic axis."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(BUDGETS, [str(n) for n in BUDGETS])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("sweeps")


def draw_published(axes, found):
    """Draw residual, violation and penetration of the cold run, each divided by its value with the fewest sweeps."""
    for order, style in (("alternating", "-"), ("bottom_up", "--")):
        for i, (name, marker) in enumerate(
            (("approach velocity", "s"), ("penetration", "^"), ("residual", "o"))
        ):
            values = found["cold"][order][:, (1, 2, 0)[i]]
            axes.plot(
                BUDGETS,
                values / values[0],
                marker + style,
                color=f"C{i}",
                markersize=4,
                label=f"{name},\n{order.replace('_', ' ')}",
            )
    set_budget_axis(axes)
    axes.set(
        title=f"cold, steps {WINDOW[0]} to {WINDOW[1]}",
        ylabel=f"value / value with {BUDGETS[0]} sweeps [-]",
    )
    put_legend_right(axes)


def draw_by_budget(axes, found):
    """Draw the judge's residual of all rows against the budget."""
    curves = {f"cold,\n{order.replace('_', ' ')}": by for order, by in found["judged"].items()}
    curves["warm,\nalternating"] = found["judged_warm"]
    for i, (name, by) in enumerate(curves.items()):
        style = "o^vs"[i] + ("-" if name.startswith("warm") else "--")
        axes.plot(BUDGETS, by, style, markersize=4, label=name)
    set_budget_axis(axes)
    axes.set(
        title=f"all rows, by the judge, steps {WINDOW[0]} to {WINDOW[1]}",
        ylabel="relative residual [-]",
    )
    put_legend_right(axes)


def draw_stand(axes, found):
    """Draw when cold stacks lose a contact and fall, and how long warm ones were watched."""
    moved, lost, fallen = found["falls"][False].T
    axes.plot(BUDGETS, fallen, "o-", color="C3", markersize=4, label="cold: has fallen")
    axes.plot(BUDGETS, lost, "v--", color="C1", markersize=4, label="cold: first\ncontact lost")
    axes.plot(BUDGETS, moved, ".:", color="0.5", label=f"cold: moved\nby {100 * MOVED:g} cm")
    standing = np.isnan(found["falls"][True][:, 2])
    axes.plot(
        np.array(BUDGETS)[standing],
        np.full(standing.sum(), LIMIT),
        "C0^",
        label="warm: still\nstanding",
    )
    set_budget_axis(axes)
    axes.set(title=f"six boxes, watched for {LIMIT:.0f} s", ylabel="time [s]")
    axes.set_yticks([2, 5, 10, 20, 50, 100, 180], ["2", "5", "10", "20", "50", "100", "180"])
    axes.set_yticks([], minor=True)
    put_legend_right(axes)


PANELS = {"published": draw_published, "by_budget": draw_by_budget, "stand": draw_stand}


def print_numbers(found):
    """Print the tables."""
    print(f"first solve   {'max |e_n| [N s]':>34}{'relative residual of all rows':>40}")
    print(f"{'order':<13}{4:>12}{64:>12}{'ratio':>10}{4:>17}{64:>13}{'ratio':>10}")
    for order, by in found["first"].items():
        e, r = by[:, 0], by[:, 1]
        print(
            f"{order:<13}{e[0]:>12.2e}{e[-1]:>12.2e}{e[0] / e[-1]:>10.1f}"
            f"{r[0]:>17.2e}{r[-1]:>13.2e}{r[0] / r[-1]:>10.1f}"
        )
    print(
        f"\nrun, steps {WINDOW[0]} to {WINDOW[1]}\n"
        f"{'start, order':<19}{'sweeps':>7}{'residual':>11}{'violation':>11}{'all rows':>10}{'depth mm':>10}"
    )
    runs = [(f"cold {order}", by, found["judged"][order]) for order, by in found["cold"].items()]
    for name, by, judged in [*runs, ("warm alternating", found["warm"], found["judged_warm"])]:
        for n, (e, v, depth), r in zip(BUDGETS, by, judged, strict=True):
            print(f"{name:<19}{n:>7}{e:>11.2e}{v:>11.2e}{r:>10.1e}{1e3 * depth:>10.2f}")
        print(f"{'':<19}   the residual falls {by[0, 0] / by[-1, 0]:.0f} times")
    engine, model = found["without_friction"], found["predicted"]
    print(
        f"without friction, bottom up: {engine[0] / engine[-1]:.0f} times, "
        f"the dense model {model[0] / model[-1]:.0f} times"
    )
    print(f"\n{'':<13}4 -> 64 sweeps, steps:{'':>9}start cold / warm on 4 sweeps, steps:")
    windows = "".join(f"{f'{a}-{b}':>12}" for a, b in (*TAILS, *STARTS))
    print(f"{'order':<13}{windows}   moved by step {STEPS} on {ENDS[1]}, mm")
    ratios = {order: (*by["tails"], *by["starts"]) for order, by in found["compared"].items()}
    for order, values in ratios.items():
        moved = 1e3 * found["compared"][order]["moved"]
        print(f"{order + ':':<13}" + "".join(f"{x:>12.0f}" for x in values) + f"{moved:>10.1f}")
    print(
        f"{'ratio':<13}" + "".join(f"{b / a:>12.1f}" for a, b in zip(*ratios.values(), strict=True))
    )
    print(
        f"\nrelative residual of all rows, cold, medians{'':>15}"
        + "".join(f"{n:>9}" for n in BUDGETS)
    )
    one_way, alternating = (found["compared"][order]["judged"] for order in COMPARED)
    for (a, b), *both in zip(TAILS, one_way, alternating, strict=True):
        for name, values in zip((*COMPARED, "gain"), (*both, both[0] / both[1]), strict=True):
            digits = ".1f" if name == "gain" else ".3f"
            print(f"{f'steps {a}-{b}':<14} {name:<46}" + "".join(f"{x:>9{digits}}" for x in values))
    print(f"\ntimes in s, of {LIMIT:.0f} s{'':<32}" + "".join(f"{n:>9}" for n in BUDGETS))
    for warm in (False, True):
        names = (
            f"a box has moved by {100 * MOVED:g} cm",
            "the first contact is lost",
            "the stack has fallen",
        )
        for name, times in zip(names, found["falls"][warm].T, strict=True):
            shown = "".join(f"{'never' if np.isnan(t) else f'{t:.1f}':>9}" for t in times)
            print(f"{'warm' if warm else 'cold'}, {name:<44}{shown}")


def main(path="engine_sweeps.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
