"""Run Siconos in a separate interpreter, which does not need lavender: `python siconos_server.py IN.npz FOLDER`.

IN.npz holds A_data, A_indices, A_indptr (compressed rows), b, mu (c,) or empty, solver, tolerances, limit [s].
A problem with contacts is solved as FC3D (three rows each, normal first; a solver named "... dense" gets W as a dense
matrix), others as an LCP with lambda >= 0. For each tolerance, from the loosest on, FOLDER/<i>.npz is written with
impulse (m,), seconds (smallest CPU time of the driver alone) and info. Building the matrix is not timed. The first call
that takes more than the limit is the last, or more than half of it without converging.
"""
# mypy: ignore-errors
# ruff: noqa: UP031 - the interpreter may be of any age

import os
import sys
import time

import numpy as np
import scipy.sparse as sp

#: Solvers that accept compressed columns; the others abort the process.
SPARSE = ("PGS", "CONVEXQP_PG")
#: Maximum iterations of methods with sweeps as iterations, which cannot be stopped by a time limit.
MAX_SWEEPS, MAX_STEPS, PROBE = 1_000_000, 1000, 50


def options(sn, name, tolerance, problem, cap):
    """Return the solver options of FC3D or LCP by name."""
    prefix = "SICONOS_FRICTION_3D_" if problem == "FC3D" else "SICONOS_LCP_"
    base, _, local = name.partition("+")
    made = sn.SolverOptions(getattr(sn, prefix + base))
    made.dparam[sn.SICONOS_DPARAM_TOL] = tolerance
    made.iparam[sn.SICONOS_IPARAM_MAX_ITER] = cap
    if base == "NSGS":
        # Evaluate the full error in every sweep: the default's cheap one does not become small on singular problems.
        full = sn.SICONOS_FRICTION_3D_NSGS_ERROR_EVALUATION_FULL
        made.iparam[sn.SICONOS_FRICTION_3D_IPARAM_ERROR_EVALUATION] = full
    if local == "projection":
        poc = sn.SICONOS_FRICTION_3D_ONECONTACT_ProjectionOnConeWithLocalIteration
        sn.solver_options_update_internal(made, 0, poc)
    return made


def main():
    """Read the problem, solve it at each tolerance, write the results."""
    import siconos.numerics as sn

    given = np.load(sys.argv[1], allow_pickle=False)
    m = len(given["b"])
    mu = given["mu"]
    name = str(given["solver"])
    limit = float(given["limit"])
    tolerances = given["tolerances"]
    q = -given["b"]
    a = sp.csr_matrix(
        (given["A_data"], given["A_indices"], given["A_indptr"]), shape=(m, m)
    ).tocsc()
    columns = sp.csc_matrix(
        (a.data, a.indices.astype(np.int64), a.indptr.astype(np.int64)), shape=(m, m)
    )
    contact = len(mu) > 0
    if contact:
        full = name.endswith(" dense")
        name = name.replace(" dense", "")
        problem = sn.FrictionContactProblem(
            3,
            len(mu),
            a.toarray() if full else columns,
            np.ascontiguousarray(q),
            np.ascontiguousarray(mu),
        )
        drive = sn.fc3d_driver
    else:
        matrix = columns if name in SPARSE else np.asfortranarray(a.toarray())
        problem = sn.LCP(matrix, np.ascontiguousarray(q))
        drive = sn.linearComplementarity_driver
    kind = "FC3D" if contact else "LCP"
    sweeps = name.startswith(("NSGS", "ADMM")) or name in SPARSE

    def once(tolerance, cap):
        made = options(sn, name, tolerance, kind, cap)
        x, y = np.zeros(m), np.zeros(m)
        start = time.process_time()
        info = drive(problem, x, y, made)
        return time.process_time() - start, x, info, int(made.iparam[sn.SICONOS_IPARAM_ITER_DONE])

    for i, tolerance in enumerate(tolerances):
        cap = PROBE
        seconds, x, info, done = once(tolerance, cap)
        if info != 0 and seconds > 0.0:
            # Estimate the iterations within the limit from the time of one iteration.
            each = seconds / max(1, min(done, PROBE))
            cap = int(min(MAX_SWEEPS if sweeps else MAX_STEPS, max(PROBE, limit / each)))
            seconds, x, info, done = once(tolerance, cap)
        spent = seconds
        for _ in range(20):
            if spent > 0.1:
                break
            again = once(tolerance, cap)
            spent += again[0]
            seconds = min(seconds, again[0])
        path = os.path.join(sys.argv[2], "%d.npz" % i)
        np.savez(path + ".part.npz", impulse=x, seconds=seconds, info=-1 if info is None else info)
        os.replace(path + ".part.npz", path)
        if seconds > (limit if info == 0 else 0.5 * limit):
            break


if __name__ == "__main__":
    main()
