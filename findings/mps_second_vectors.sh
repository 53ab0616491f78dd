#!/usr/bin/env bash
# ortools 9.15.6755 (ModelBuilder), HiGHS 1.16.0, SCIP (PySCIPOpt 6.3.0), Gurobi 13.0.3 and GLPK (swiglpk 5.0.13), an MPS file with two
# vectors of right-hand sides and two of bounds
# Behaviour: the format allows several vectors in a section, of which one is chosen. HiGHS, SCIP and Gurobi take the first one. OR-Tools
# reads all of them in turn, so that the last one remains. GLPK, whose writer and reader know one vector, refuses the file.
# Output: right-hand side and lower bound: HiGHS 4 and 5, SCIP 4 and 5, Gurobi 4 and 5, OR-Tools 6 and 6, GLPK refuses

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 ortools==9.15.6755 highspy==1.16.0 swiglpk==5.0.13 PySCIPOpt==6.3.0 gurobipy==13.0.3
cd "$folder"
cat > vectors.mps << 'END'
NAME T
ROWS
 N OBJ
 G R1
COLUMNS
 X OBJ 1 R1 1
 Y OBJ 2 R1 1
RHS
 A R1 4
 B R1 6
BOUNDS
 LO B1 X 5
 LO B2 X 6
ENDATA
END
venv/bin/python - << 'END' 2> /dev/null | grep -v '^Running\|^Includes'
import sys

import gurobipy
import highspy
import pyscipopt
import swiglpk
from ortools.linear_solver.python import model_builder

PATH = "vectors.mps"
found = {}
model = highspy.Highs()
model.silent()
model.readModel(PATH)
found["HiGHS"] = model.getLp().row_lower_[0], model.getLp().col_lower_[0]
model = pyscipopt.Model()
model.hideOutput()
model.readProblem(PATH)
found["SCIP"] = model.getLhs(model.getConss()[0]), model.getVars()[0].getLbOriginal()
model = gurobipy.read(PATH, gurobipy.Env(params={"OutputFlag": 0}))
found["Gurobi"] = model.getConstrs()[0].RHS, model.getVars()[0].LB
model = model_builder.Model()
model.import_from_mps_file(PATH)
found["OR-Tools"] = model.get_linear_constraints()[0].lower_bound, model.get_variables()[0].lower_bound
swiglpk.glp_term_out(swiglpk.GLP_OFF)
is_refused = swiglpk.glp_read_mps(swiglpk.glp_create_prob(), swiglpk.GLP_MPS_FILE, None, PATH) != 0
told = ", ".join(f"{name} {side:g} and {bound:g}" for name, (side, bound) in found.items())
print(f"right-hand side and lower bound: {told}, GLPK {'refuses' if is_refused else 'reads'}")
same = all(found[name] == (4, 5) for name in ("HiGHS", "SCIP", "Gurobi")) and found["OR-Tools"] == (6, 6) and is_refused
sys.exit(0 if same else "the behaviour has changed")
END
