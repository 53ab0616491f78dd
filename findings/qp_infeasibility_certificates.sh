#!/usr/bin/env bash
# Clarabel 0.11.1, SCS 3.3.1, OSQP 1.1.3, PIQP 0.7.0 and HiGHS 1.16.0, a quadratic program without a feasible point
# Behaviour: min |x|^2/2 - x1 - 2 x2 with x1 + x2 >= 4 and x1 + x2 <= 1. All find it infeasible, and all return equal multipliers y of
# both rows as the proof (h'y < 0), each with another length. SCS divides it so that h'y = -1, OSQP so that the largest entry is 1,
# and HiGHS has the opposite sign. Clarabel's h'y is -2, not -1, and changes with the cost, which does not matter for the proof: it is
# -1 with the Hessian 7 I or 0. x is 0 in Clarabel, PIQP and HiGHS, nan in SCS, 2143289344 in OSQP.
# Output: Clarabel 0.667 0.667 (Hessian 7 I: 0.333 0.333), SCS 0.333 0.333, OSQP 1.000 1.000, PIQP 1.000 1.000,
# HiGHS -1.000 -1.000

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check \
  numpy==2.4.6 scipy==1.17.1 clarabel==0.11.1 scs==3.3.1 osqp==1.1.3 piqp==0.7.0 highspy==1.16.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null | grep -v '^Running\|^Includes'
import sys

import clarabel
import highspy
import numpy as np
import osqp
import piqp
import scipy.sparse as sp
import scs

q = np.array([-1.0, -2])
G = np.array([[-1.0, -1], [1, 1]])
h = np.array([-4.0, 1])
endless = np.full(2, -np.inf)


def prove_clarabel(scale):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.NonnegativeConeT(2)]
    return clarabel.DefaultSolver(sp.csc_matrix(scale * np.eye(2)), q, sp.csc_matrix(G), h, cones, settings).solve().z


def prove_scs():
    return scs.solve({"P": sp.eye(2, format="csc"), "c": q, "A": sp.csc_matrix(G), "b": h}, {"l": 2}, verbose=False)["y"]


def prove_osqp():
    solver = osqp.OSQP()
    solver.setup(sp.eye(2, format="csc"), q, sp.csc_matrix(G), endless, h, verbose=False)
    return solver.solve().prim_inf_cert


def prove_piqp():
    solver = piqp.DenseSolver()
    solver.setup(np.eye(2), q, None, None, G, endless, h)
    solver.solve()
    return solver.result.z_u


def prove_highs():
    model = highspy.Highs()
    model.silent()
    for cost in q:
        model.addVar(-highspy.kHighsInf, highspy.kHighsInf)
        model.changeColCost(model.getNumCol() - 1, cost)
    for row, side in zip(G, h):
        model.addRow(-highspy.kHighsInf, side, 2, np.array([0, 1], dtype=np.int32), row)
    hessian = highspy.HighsHessian()
    hessian.dim_ = 2
    hessian.format_ = highspy.HessianFormat.kTriangular
    hessian.start_, hessian.index_, hessian.value_ = np.array([0, 1, 2]), np.array([0, 1]), np.array([1.0, 1.0])
    model.passHessian(hessian)
    model.run()
    return model.getDualRay()[2]


wanted = {"Clarabel": 2 / 3, "Clarabel with 7 I": 1 / 3, "SCS": 1 / 3, "OSQP": 1, "PIQP": 1, "HiGHS": -1}
proofs = (prove_clarabel(1.0), prove_clarabel(7.0), prove_scs(), prove_osqp(), prove_piqp(), prove_highs())
same = True
for (name, size), proof in zip(wanted.items(), proofs):
    proof = np.array(proof)
    print(f"{name}: {proof[0]:.3f} {proof[1]:.3f}, h'y = {h @ proof:.3f}")
    same = same and np.allclose(proof, size, rtol=5e-3)
sys.exit(0 if same else "the behaviour has changed")
END
