#!/usr/bin/env bash
# HiGHS 1.16.0, GLPK (swiglpk 5.0.13), SCIP (PySCIPOpt 6.3.0) and Gurobi 13.0.3, a variable of an .lp file that is bounded twice
# Behaviour: (1) x <= 5 in the bounds and x in the section "binary" after them: HiGHS and GLPK have an integer in [0, 5], SCIP and Gurobi
# a binary variable. (2) "x <= 4" and then "x free" in the bounds: HiGHS and GLPK forget the 4, SCIP and Gurobi keep it. No reader
# says anything.
# Output: binary: HiGHS [0, 5], GLPK [0, 5], SCIP [0, 1], Gurobi [0, 1]; free: HiGHS [-inf, inf], GLPK [-inf, inf], SCIP [-inf, 4],
# Gurobi [-inf, 4]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 highspy==1.16.0 swiglpk==5.0.13 PySCIPOpt==6.3.0 gurobipy==13.0.3
cd "$folder"
printf 'max\n obj: x + y\nst\n c: x + y <= 9\nbounds\n x <= 5\nbinary\n x\nend\n' > binary.lp
printf 'max\n obj: x + y\nst\n c: x + y <= 9\nbounds\n x <= 4\n x free\nend\n' > free.lp
venv/bin/python - << 'END' 2> /dev/null | grep -v '^Running\|^Includes'
import sys

import gurobipy
import highspy
import pyscipopt
import swiglpk

swiglpk.glp_term_out(swiglpk.GLP_OFF)
quiet = gurobipy.Env(params={"OutputFlag": 0})


def read_highs(path):
    model = highspy.Highs()
    model.silent()
    model.readModel(path)
    program = model.getLp()
    return program.col_lower_[0], program.col_upper_[0]


def read_glpk(path):
    model = swiglpk.glp_create_prob()
    swiglpk.glp_read_lp(model, None, path)
    return swiglpk.glp_get_col_lb(model, 1), swiglpk.glp_get_col_ub(model, 1)


def read_scip(path):
    model = pyscipopt.Model()
    model.hideOutput()
    model.readProblem(path)
    x = model.getVars()[0]
    return x.getLbOriginal(), x.getUbOriginal()


def read_gurobi(path):
    model = gurobipy.read(path, quiet)
    x = model.getVars()[0]
    return x.LB, x.UB


readers = {"HiGHS": read_highs, "GLPK": read_glpk, "SCIP": read_scip, "Gurobi": read_gurobi}
found = {}
for name in ("binary", "free"):
    bounds = {reader: read(f"{name}.lp") for reader, read in readers.items()}
    found[name] = [tuple(float("inf") * (1 if v > 0 else -1) if abs(v) > 1e19 else v for v in pair) for pair in bounds.values()]
    print(f"{name}: " + ", ".join(f"{reader} [{low:g}, {high:g}]" for reader, (low, high) in zip(readers, found[name])))
endless = float("inf")
same = found["binary"] == [(0, 5), (0, 5), (0, 1), (0, 1)]
same = same and found["free"] == [(-endless, endless), (-endless, endless), (-endless, 4), (-endless, 4)]
sys.exit(0 if same else "the behaviour has changed")
END
