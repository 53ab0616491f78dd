#!/usr/bin/env bash
# ortools 9.15.6755, export_to_lp_string of its ModelBuilder, read by HiGHS 1.16.0, GLPK (swiglpk 5.0.13), SCIP (PySCIPOpt 6.3.0) and
# Gurobi 13.0.3
# Behaviour: min y with -inf <= y <= 5 and y >= -3 as a row has the minimum -3. The text has the bound "y <= 5", without -inf, so
# that each reader takes the format's lower bound 0: minimum 0. With an upper bound of -1, each reader finds the program infeasible.
# The MPS text of the same model is right, and ModelBuilder itself cannot read the LP text.
# Output: upper bound 5: LP HiGHS 0, GLPK 0, SCIP 0, Gurobi 0; MPS HiGHS -3, GLPK -3, SCIP -3, Gurobi -3; -1: LP none four times;
# read again by OR-Tools: LP False, MPS True

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 ortools==9.15.6755 highspy==1.16.0 swiglpk==5.0.13 PySCIPOpt==6.3.0 gurobipy==13.0.3
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null | grep -v '^Running\|^Includes'
import math
import sys

import gurobipy
import highspy
import pyscipopt
import swiglpk
from ortools.linear_solver.python import model_builder

swiglpk.glp_term_out(swiglpk.GLP_OFF)
quiet = gurobipy.Env(params={"OutputFlag": 0})


def solve_highs(path):
    model = highspy.Highs()
    model.silent()
    model.readModel(path)
    model.run()
    return model.getObjectiveValue() if model.getModelStatus() == highspy.HighsModelStatus.kOptimal else math.nan


def solve_glpk(path):
    model = swiglpk.glp_create_prob()
    if path.endswith("lp"):
        swiglpk.glp_read_lp(model, None, path)
    else:
        swiglpk.glp_read_mps(model, swiglpk.GLP_MPS_FILE, None, path)
    refused = swiglpk.glp_simplex(model, None)
    solved = not refused and swiglpk.glp_get_status(model) == swiglpk.GLP_OPT
    return swiglpk.glp_get_obj_val(model) if solved else math.nan


def solve_scip(path):
    model = pyscipopt.Model()
    model.hideOutput()
    model.readProblem(path)
    model.optimize()
    return model.getObjVal() if model.getStatus() == "optimal" else math.nan


def solve_gurobi(path):
    model = gurobipy.read(path, quiet)
    model.optimize()
    return model.ObjVal if model.Status == gurobipy.GRB.OPTIMAL else math.nan


readers = {"HiGHS": solve_highs, "GLPK": solve_glpk, "SCIP": solve_scip, "Gurobi": solve_gurobi}
found = {}
for upper in (5, -1):
    model = model_builder.Model()
    y = model.new_num_var(-math.inf, upper, "y")
    model.minimize(y)
    model.add(y >= -3)
    texts = {"lp": model.export_to_lp_string(), "mps": model.export_to_mps_string()}
    for kind, text in texts.items():
        with open(f"model.{kind}", "w") as file:
            file.write(text)
        found[upper, kind] = [read(f"model.{kind}") for read in readers.values()]
        told = ", ".join(f"{name} {value:.3g}" for name, value in zip(readers, found[upper, kind]))
        print(f"upper bound {upper}, {kind.upper()}: {told}".replace("nan", "none"))
again = model_builder.Model()
is_read = again.import_from_lp_string(texts["lp"]), model_builder.Model().import_from_mps_string(texts["mps"])
print(f"read again by OR-Tools: LP {is_read[0]}, MPS {is_read[1]}")
same = all(abs(value) < 1e-9 for value in found[5, "lp"]) and all(map(math.isnan, found[-1, "lp"])) and is_read == (False, True)
same = same and all(abs(value + 3) < 1e-9 for upper in (5, -1) for value in found[upper, "mps"])
sys.exit(0 if same else "the behaviour has changed")
END
