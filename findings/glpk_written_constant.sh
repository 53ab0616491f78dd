#!/usr/bin/env bash
# GLPK 5.0 (swiglpk 5.0.13), a model with a constant in its objective, written to files and read by GLPK and by HiGHS 1.16.0
# Behaviour: min x + 7 with x >= 1 has the minimum 8. glp_write_lp writes the constant as a comment, so that GLPK itself reads 1, as
# does HiGHS. glp_write_mps writes it with GLPK's own sign: GLPK reads 8, HiGHS -6.
# Output: LP: GLPK 1, HiGHS 1; MPS: GLPK 8, HiGHS -6

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 swiglpk==5.0.13 highspy==1.16.0
cd "$folder"
venv/bin/python - << 'END' | grep '^LP\|^MPS'
import sys

import highspy
import swiglpk

swiglpk.glp_term_out(swiglpk.GLP_OFF)
model = swiglpk.glp_create_prob()
swiglpk.glp_add_cols(model, 1)
swiglpk.glp_set_col_bnds(model, 1, swiglpk.GLP_LO, 1.0, 0.0)
swiglpk.glp_set_col_name(model, 1, "x")
swiglpk.glp_set_obj_coef(model, 1, 1.0)
swiglpk.glp_set_obj_coef(model, 0, 7.0)
swiglpk.glp_add_rows(model, 1)
swiglpk.glp_set_row_name(model, 1, "c")
swiglpk.glp_set_row_bnds(model, 1, swiglpk.GLP_UP, 0.0, 9.0)
index, value = swiglpk.intArray(2), swiglpk.doubleArray(2)
index[1], value[1] = 1, 1.0
swiglpk.glp_set_mat_row(model, 1, 1, index, value)
swiglpk.glp_write_lp(model, None, "model.lp")
swiglpk.glp_write_mps(model, swiglpk.GLP_MPS_DECK, None, "model.mps")
found = {}
for kind in ("lp", "mps"):
    again = swiglpk.glp_create_prob()
    if kind == "lp":
        swiglpk.glp_read_lp(again, None, "model.lp")
    else:
        swiglpk.glp_read_mps(again, swiglpk.GLP_MPS_DECK, None, "model.mps")
    swiglpk.glp_simplex(again, None)
    highs = highspy.Highs()
    highs.silent()
    highs.readModel(f"model.{kind}")
    highs.run()
    found[kind] = swiglpk.glp_get_obj_val(again), highs.getObjectiveValue()
    print("{}: GLPK {:g}, HiGHS {:g}".format(kind.upper(), *found[kind]))
sys.exit(0 if found == {"lp": (1, 1), "mps": (8, -6)} else "the behaviour has changed")
END
