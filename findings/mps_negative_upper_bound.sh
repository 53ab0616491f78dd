#!/usr/bin/env bash
# A linear program with a negative upper bound and no lower bound, as an MPS and as an .lp file, read by HiGHS 1.16.0, GLPK (swiglpk
# 5.0.13), Clp (cylp 0.94.1), SCIP (PySCIPOpt 6.3.0) and Gurobi 13.0.3
# Behaviour: from the MPS file with the bound "UP X -2", Gurobi and Clp take minus infinity as the lower bound of x; HiGHS, GLPK and
# SCIP keep 0, so that the program is infeasible. From the .lp file with "x <= -2", all keep 0, Gurobi, too. A second file has the
# right-hand side 5 of the objective row, the constant -5 by the format: GLPK adds 5.
# Output: lower bound: MPS HiGHS 0, GLPK 0, Clp -inf, SCIP 0, Gurobi -inf; LP HiGHS 0, GLPK 0, SCIP 0, Gurobi 0; minimum with the
# constant: HiGHS -3, GLPK 7, Clp -3, SCIP -3, Gurobi -3

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 highspy==1.16.0 swiglpk==5.0.13 cylp==0.94.1 PySCIPOpt==6.3.0 gurobipy==13.0.3
cd "$folder"
cat > bounded.mps << 'END'
NAME          T
ROWS
 N  OBJ
 L  R1
COLUMNS
    X         OBJ              1.0   R1               1.0
    Y         OBJ              1.0   R1               1.0
RHS
    RHS       R1              10.0   OBJ              5.0
BOUNDS
 LO BND       X                1.0
 LO BND       Y                1.0
ENDATA
END
sed 's/ LO BND       X                1.0/ UP BND       X               -2.0/' bounded.mps > upper.mps
printf 'min\n obj: X + Y\nst\n R1: X + Y <= 10\nbounds\n X <= -2\n Y >= 1\nend\n' > upper.lp
venv/bin/python - << 'END' 2> /dev/null | grep -v '^Coin\|^Clp\|^Running\|^Includes'
import math
import sys

import gurobipy
import highspy
import pyscipopt
import swiglpk
from cylp.cy import CyClpSimplex

swiglpk.glp_term_out(swiglpk.GLP_OFF)
quiet = gurobipy.Env(params={"OutputFlag": 0})


def read_highs(path):
    model = highspy.Highs()
    model.silent()
    model.readModel(path)
    model.run()
    return model.getObjectiveValue(), model.getLp().col_lower_[0]


def read_glpk(path):
    model = swiglpk.glp_create_prob()
    if path.endswith("lp"):
        swiglpk.glp_read_lp(model, None, path)
    else:
        swiglpk.glp_read_mps(model, swiglpk.GLP_MPS_FILE, None, path)
    swiglpk.glp_simplex(model, None)
    return swiglpk.glp_get_obj_val(model), swiglpk.glp_get_col_lb(model, 1)


def read_clp(path):
    model = CyClpSimplex()
    model.logLevel = 0
    model.readMps(path)
    model.primal()
    return model.objectiveValue, float(model.variablesLower[0])


def read_scip(path):
    model = pyscipopt.Model()
    model.hideOutput()
    model.readProblem(path)
    lower = model.getVars()[0].getLbOriginal()
    model.optimize()
    return (model.getObjVal() if model.getStatus() == "optimal" else math.nan), lower


def read_gurobi(path):
    model = gurobipy.read(path, quiet)
    model.optimize()
    return (model.ObjVal if model.Status == 2 else math.nan), model.getVars()[0].LB


readers = {"HiGHS": read_highs, "GLPK": read_glpk, "Clp": read_clp, "SCIP": read_scip, "Gurobi": read_gurobi}
minima = {name: read("bounded.mps")[0] for name, read in readers.items()}
lower = {}
for path in ("upper.mps", "upper.lp"):
    names = [name for name in readers if name != "Clp" or path.endswith("mps")]
    values = {name: readers[name](path)[1] for name in names}
    lower[path] = {name: -math.inf if value < -1e30 else value for name, value in values.items()}
for label, values in (("lower bound, MPS", lower["upper.mps"]), ("lower bound, LP", lower["upper.lp"]), ("minimum", minima)):
    print(f"{label}: " + ", ".join(f"{name} {value:.3g}" for name, value in values.items()))
same = [round(value) for value in minima.values()] == [-3, 7, -3, -3, -3]
same = same and [name for name, value in lower["upper.mps"].items() if value < 0] == ["Clp", "Gurobi"]
sys.exit(0 if same and not any(lower["upper.lp"].values()) else "the behaviour has changed")
END
