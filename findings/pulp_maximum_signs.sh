#!/usr/bin/env bash
# PuLP 3.3.2 with CBC and with HiGHS (highspy 1.16.0), one linear program to be maximised
# Behaviour: max 3 x + 2 y with x + y <= 4 and 0 <= x <= 3 has the multiplier 2 of the row and the reduced cost 1 of x. pi and dj have
# one sign with CBC and the other with HiGHS. So has the slack of the row x - y >= -9: -11 and 11. To be minimised, pi agrees.
# Output: maximum: CBC pi 2, dj 1, slack -11; HiGHS pi -2, dj -1, slack 11; minimum: CBC pi -2, dj -1; HiGHS pi -2, dj -1

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check pulp==3.3.2 highspy==1.16.0 numpy==2.4.6
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import pulp


def solve(sense, solver):
    problem = pulp.LpProblem("p", sense)
    x, y = pulp.LpVariable("x", 0, 3), pulp.LpVariable("y", 0, 10)
    factor = 1 if sense == pulp.LpMaximize else -1
    problem += factor * (3 * x + 2 * y)
    problem += x + y <= 4, "c"
    problem += x - y >= -9, "d"
    problem.solve(solver)
    return problem.constraints["c"].pi, x.dj, problem.constraints["d"].slack


found = {}
for sense, word in ((pulp.LpMaximize, "maximum"), (pulp.LpMinimize, "minimum")):
    for name, solver in (("CBC", pulp.PULP_CBC_CMD(msg=False)), ("HiGHS", pulp.HiGHS(msg=False))):
        found[word, name] = tuple(round(value, 6) for value in solve(sense, solver))
        pi, dj, slack = found[word, name]
        print(f"{word}: {name} pi {pi:g}, dj {dj:g}, slack {slack:g}")
same = found["maximum", "CBC"] == (2, 1, -11) and found["maximum", "HiGHS"] == (-2, -1, 11)
same = same and found["minimum", "CBC"] == (-2, -1, -11) and found["minimum", "HiGHS"] == (-2, -1, 11)
sys.exit(0 if same else "the behaviour has changed")
END
