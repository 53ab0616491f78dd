"""The judge for Python: thin entries of judge.pxd, and the same pass exported by name."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.block cimport blocks_t
from lavender_ext.csr cimport csr_t
from lavender_ext.judge cimport csr_slack, judge_into, rows_slack, rows_velocity, score_rows, score_t
from lavender_ext.problem cimport Data
from lavender_ext.rows cimport rows_t


cdef public void lav_judge_csr(const blocks_t* p, const csr_t* a, const double* lam, double* w, double* e,
                               int32_t floor, score_t* out) noexcept nogil:
    """Slack w (m), error e (m) and the sums of lam (m) for a problem given by A."""
    judge_into(p, a, NULL, 0, lam, w, e, NULL, floor, out)


cdef public void lav_judge_rows(const blocks_t* p, const rows_t* r, const double* lam, double* w, double* e, double* v,
                                int32_t floor, score_t* out) noexcept nogil:
    """The same for a factored problem; v (n_bodies, 6) is scratch."""
    judge_into(p, NULL, r, 1, lam, w, e, v, floor, out)


def slack(Data p, const double[::1] lam, double[::1] w):
    """w = A lam - b [m/s] into w (m,)."""
    cdef double[::1] v
    if p.blocks.n_rows == 0:
        return
    if p.factored:
        v = np.empty(6 * p.rows.n_bodies + 1)
        with nogil:
            rows_velocity(&p.blocks, &p.rows, &lam[0], &v[0])
            rows_slack(&p.blocks, &p.rows, &lam[0], &v[0], &w[0])
    else:
        with nogil:
            csr_slack(&p.blocks, &p.csr, &lam[0], &w[0])


def judge(Data p, const double[::1] lam, double[::1] w, double[::1] e, bint floor=True):
    """Slack into w, error into e, and (energy, velocity, worst row, floor energy, floor velocity, finite)."""
    cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    cdef double[::1] bodies
    cdef double* v = NULL
    if p.blocks.n_rows == 0:
        return 0.0, 0.0, -1, 0.0, 0.0, True
    if p.factored:
        bodies = np.empty(6 * p.rows.n_bodies + 1)
        v = &bodies[0]
    with nogil:
        judge_into(&p.blocks, &p.csr, &p.rows, p.factored, &lam[0], &w[0], &e[0], v, floor, &s)
    return s.energy, s.velocity, s.worst, s.floor_energy, s.floor_velocity, bool(s.finite)


def score(Data p, const double[::1] lam, const double[::1] w, double[::1] e):
    """Error of (lam, w) as they are, w given: (energy, velocity, worst row, finite)."""
    cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    if p.blocks.n_rows == 0:
        return 0.0, 0.0, -1, True
    with nogil:
        score_rows(&p.blocks, &lam[0], &w[0], &e[0], &s)
    return s.energy, s.velocity, s.worst, bool(s.finite)


def velocity_change(Data p, const double[::1] lam, double[:, ::1] v):
    """M^-1 J^T lam (n, 6) of a factored problem, into v."""
    if not p.factored or p.rows.n_bodies == 0:
        return
    if p.blocks.n_rows == 0:
        v[:, :] = 0.0
        return
    with nogil:
        rows_velocity(&p.blocks, &p.rows, &lam[0], &v[0, 0])
