"""Experiment 4: what a sweep budget of 4 to 64 buys inside an engine.

The scene is `stack` with its defaults: six boxes, friction 0.5. Every step leaves a residual max |e_n| [N s],
an approach velocity that should not be [m/s], and, summed over the steps, penetration [m].

First solve, from rest and from zero: the error by budget and order, with the judge's residual of all rows beside it.
The two disagree across orders. e_n = w_n/d_n, and at the ground only one body moves: d_n is half of what it is between
two boxes, so that the same approach velocity w_n publishes twice the residual there. From the bottom up the largest
velocity is left at the ground, from the top down the ground is swept last and the velocities are left above it:
max |e_n| is half as large, yet boxes approach faster and sink deeper. The judge, which adds up the energy of all
rows and takes the largest velocity, says so.

Cold run, before anything tips: the residual is larger than in the first solve where sweeps are few. Each solve
must carry the whole weight from zero, so the boxes sink until b is large enough that n sweeps get there. With G
the error matrix of a sweep and l the impulses that hold the stack,

    l = (1 - G^n) x,   e = (A (l - x)) / d                                                    (dense twin)

taken without friction, since the friction disks do not sweep like a matrix. Cold stacks then fall over, so the
run is not averaged over its fall: how long it stands is a number of its own. Warm ones stand on every budget.

Order: with friction a cold run swept always the same way keeps a slow sway that 64 sweeps do not see. Turned round in
every other substep (`alternating`, the default), 64 sweeps leave several times less by the judge; 4 to 16 sweeps, which
leave much of everything, gain nothing. How much depends on when one looks, so that each number has its window: late in
the run the stack on 4 sweeps leans.

    python examples/engine_sweeps.py [FIGURE.png]

A file named after a panel holds it alone: by_budget.png, stand.png.
"""

import functools
import sys

import numpy as np
from panels import beside, save

import lavender as lv

BUDGETS = (4, 8, 16, 32, 64)
ORDERS = ("alternating", "bottom_up", "top_down", "random", "colored", "symmetric")
RUNS = ("alternating", "bottom_up", "top_down")
COMPARED = ("bottom_up", "alternating")
FIRST, LAST = 20, 60  # steps of which medians are taken; no cold stack tips before
MOST = 0.05  # m: a stack of which a box has moved so far no longer stands
LONG = 60.0  # s
TRAIL = 240  # steps
ENDS = (4, 64)  # sweeps between which the tail is told
TAILS = ((20, 60), (180, 240))  # steps of which medians are taken
STARTS = ((20, 90), (90, 120))


def first_solve(sweeps, order):
    """Of the first solve: max |e_n| [N s], and the judge's relative residual of all rows [-]."""
    problem = lv.Simulation(lv.Scene("stack", warm_start=False)).constraint_problem()
    order = (
        "given" if order == "alternating" else order
    )  # the problem of a substep lists its contacts in that order
    impulse = lv.solve(problem, "sequential_impulses", tol=0, max_iter=sweeps, order=order).impulse
    judged = lv.residual(problem, impulse)
    return np.abs(judged.error[problem.cones.ptr[:-1]]).max(), judged.relative


@functools.cache
def run(sweeps, order, warm):
    """Of each of the steps that are looked at six columns."""
    scene = lv.Scene("stack", solver_iterations=sweeps, order=order, warm_start=warm)
    sim = lv.Simulation(scene)
    start = sim.reset()[0]["positions"]
    rows = []
    for step in range(TRAIL if order in COMPARED and not warm else STARTS[-1][-1]):
        sim.report_residual = any(a <= step < b for a, b in TAILS)  # costs as much as ten steps
        observation, *_, info = sim.step()
        values = dict(zip(lv.SOLVER_FIELDS, observation["solver"], strict=True))
        rows.append(
            (
                values["residual_initial"],  # N s, before the first sweep
                values["residual_final"],  # N s
                values["violation_final"],  # m/s
                info["residual"]["relative"] if sim.report_residual else np.nan,  # -, of all rows
                observation["contacts"]["depth"].max(),  # m
                np.abs(observation["positions"] - start).max(),  # m, how far a box has moved
            )
        )
    return np.array(rows)


def summary(sweeps, order, warm):
    """Of the steps FIRST to LAST: medians of residual, violation and judge; of all up to LAST the largest depth."""
    rows = run(sweeps, order, warm)[:LAST]
    return (*np.median(rows[FIRST:, 1:4], axis=0), rows[:, 4].max())


def alternation():
    """By order: tails 4 -> 64 in the windows TAILS, starts cold over warm in STARTS, m moved on 64, judged (2, 5)."""
    out = {}
    for order in COMPARED:
        few, many = (run(n, order, False) for n in ENDS)
        warm = run(ENDS[0], order, True)
        out[order] = {
            "tails": [np.median(few[a:b, 1]) / np.median(many[a:b, 1]) for a, b in TAILS],
            "starts": [np.median(few[a:b, 0]) / np.median(warm[a:b, 0]) for a, b in STARTS],
            "moved": many[-1, 5],
            "judged": np.array(
                [[np.median(run(n, order, False)[a:b, 3]) for n in BUDGETS] for a, b in TAILS]
            ),
        }
    return out


def standing(sweeps, warm):
    """Seconds until a box has moved MOST from where it began, or LONG."""
    sim = lv.Simulation(lv.Scene("stack", solver_iterations=sweeps, warm_start=warm))
    start = sim.reset()[0]["positions"]
    while sim.time < LONG:
        if np.abs(sim.step()[0]["positions"] - start).max() > MOST:
            return sim.time
    return LONG


def twin(sweeps):
    """max |e_n| [N s] that the dense twin predicts for a cold run without friction, swept bottom-up."""
    scene = lv.Scene("stack", friction=0.0)
    problem = lv.Simulation(scene).constraint_problem()
    a, m = problem.dense(), problem.m
    g = np.eye(m) - np.linalg.solve(np.tril(a), a)
    step = scene.parameters.dt / scene.parameters.substeps
    weight = np.repeat(np.arange(6, 0, -1), 4) * 9.81 * step / 4.0
    x = np.linalg.lstsq(np.eye(m) - np.linalg.matrix_power(g, sweeps), weight, rcond=None)[0]
    return np.abs((a @ (weight - x)) / np.diag(a)).max()


def bare(sweeps):
    """max |e_n| [N s] of the run that the twin is of."""
    scene = lv.Scene("stack", friction=0.0, warm_start=False, solver_iterations=sweeps, order="bottom_up")
    sim = lv.Simulation(scene)
    at = lv.SOLVER_FIELDS.index("residual_final")
    return float(np.median([sim.step()[0]["solver"][at] for _ in range(2 * LAST)][LAST:]))


def numbers():
    """First solves and runs by order and budget, how long stacks stand, and the twin beside its run."""
    return {
        "first": {order: np.array([first_solve(n, order) for n in BUDGETS]) for order in ORDERS},  # (5, 2)
        "cold": {order: np.array([summary(n, order, False) for n in BUDGETS]) for order in RUNS},  # (5, 4)
        "warm": np.array([summary(n, "alternating", True) for n in BUDGETS]),  # (5, 4)
        "standing": {warm: np.array([standing(n, warm) for n in BUDGETS]) for warm in (False, True)},
        "alternation": alternation(),
        "twin": np.array([twin(n) for n in BUDGETS]),
        "bare": np.array([bare(n) for n in BUDGETS]),
    }


def against_budget(axes):
    """Ticks at the budgets."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(BUDGETS, [str(n) for n in BUDGETS])
    axes.set_xticks([], minor=True)


def draw_by_budget(axes, found):
    """The run: what the judge says."""
    curves = {f"cold,\n{order.replace('_', ' ')}": by for order, by in found["cold"].items()}
    curves["warm,\nalternating"] = found["warm"]
    for i, (name, by) in enumerate(curves.items()):
        style = "o^vs"[i] + ("-" if name.startswith("warm") else "--")
        axes.plot(BUDGETS, by[:, 2], style, markersize=4, label=name)
    against_budget(axes)
    axes.set(title="the run: all rows, by the judge", xlabel="sweeps", ylabel="relative residual [-]")
    beside(axes)


def draw_stand(axes, found):
    """How long stacks stand."""
    for warm, style in ((False, "o--"), (True, "s-")):
        axes.plot(BUDGETS, found["standing"][warm], style, markersize=4, label="warm" if warm else "cold")
    against_budget(axes)
    axes.set(title=f"how long the stack stands (looked at for {LONG:.0f} s)", xlabel="sweeps", ylabel="[s]")
    axes.set_yticks([2, 5, 10, 20, 60], ["2", "5", "10", "20", "60"])
    axes.set_yticks([], minor=True)
    beside(axes)


PANELS = {"by_budget": draw_by_budget, "stand": draw_stand}


def main(path="engine_sweeps.png"):
    """Print the tables, save the figure."""
    found = numbers()
    print(f"first solve   {'max |e_n| [N s]':>34}{'relative residual of all rows':>40}")
    print(f"{'order':<13}{4:>12}{64:>12}{'ratio':>10}{4:>17}{64:>13}{'ratio':>10}")
    for order, by in found["first"].items():
        e, r = by[:, 0], by[:, 1]
        print(
            f"{order:<13}{e[0]:>12.2e}{e[-1]:>12.2e}{e[0] / e[-1]:>10.1f}"
            f"{r[0]:>17.2e}{r[-1]:>13.2e}{r[0] / r[-1]:>10.1f}"
        )
    print(
        f"\ncold run, steps {FIRST} to {LAST}\n"
        f"{'order':<13}{'sweeps':>7}{'residual':>11}{'violation':>11}{'all rows':>10}{'depth mm':>10}"
    )
    for order, by in [*found["cold"].items(), ("warm", found["warm"])]:
        for n, (e, v, r, depth) in zip(BUDGETS, by, strict=True):
            print(f"{order:<13}{n:>7}{e:>11.2e}{v:>11.2e}{r:>10.1e}{1e3 * depth:>10.2f}")
        print(f"{'':<13}   residual falls {by[0, 0] / by[-1, 0]:.0f} times")
    print(
        f"without friction, bottom up: {found['bare'][0] / found['bare'][-1]:.0f} times, "
        f"the dense twin {found['twin'][0] / found['twin'][-1]:.0f} times"
    )
    print(f"\n{'':<13}tail {ENDS[0]} -> {ENDS[1]}, steps:{'':>9}start cold / warm on {ENDS[0]}, steps:")
    windows = "".join(f"{f'{a}-{b}':>12}" for a, b in (*TAILS, *STARTS))
    print(f"{'order':<13}{windows}   moved by step {TRAIL} on {ENDS[1]}, mm")
    found_in = {order: (*by["tails"], *by["starts"]) for order, by in found["alternation"].items()}
    for order, values in found_in.items():
        moved = 1e3 * found["alternation"][order]["moved"]
        print(f"{order + ':':<13}" + "".join(f"{x:>12.0f}" for x in values) + f"{moved:>10.1f}")
    print(f"{'ratio':<13}" + "".join(f"{b / a:>12.1f}" for a, b in zip(*found_in.values(), strict=True)))
    print(
        f"\njudged, cold: what is left of doing nothing, medians{'':>7}" + "".join(f"{n:>9}" for n in BUDGETS)
    )
    one_way, turned = (found["alternation"][order]["judged"] for order in found_in)
    for (a, b), *both in zip(TAILS, one_way, turned, strict=True):
        for name, values in zip(
            ("bottom_up", "alternating", "gain"), (*both, both[0] / both[1]), strict=True
        ):
            digits = ".1f" if name == "gain" else ".3f"
            print(f"{f'steps {a}-{b}':<14} {name:<46}" + "".join(f"{x:>9{digits}}" for x in values))
    for warm in (False, True):
        times = "  ".join(
            f"{n}: {'all' if t >= LONG else f'{t:.1f}'}"
            for n, t in zip(BUDGETS, found["standing"][warm], strict=True)
        )
        print(f"{'warm' if warm else 'cold'} stacks stand for, of {LONG:.0f} s:  {times}")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
