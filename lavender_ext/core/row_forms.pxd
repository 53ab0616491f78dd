"""Slack w = A lam - b of one row [m/s] in forms of A in which rows are updated one by one, and the change of its impulse.

    csr_t            A in compressed rows                                    w = A lam - b
    damped_csr_t     A in compressed rows, steps multiplied by omega         w = A lam - b
    stored_slack_t   slacks that do not change during a sweep, and omega     w as stored
    generalized_t    J and M, with velocities v = Y^T lam (nv)               w = Y v + compliance lam - b
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.generalized cimport add_scaled_whitened_row, whitened_row_dot
from lavender_ext.core.view cimport csr_t, generalized_t


cdef struct damped_csr_t:
    const csr_t* a
    double omega


cdef struct stored_slack_t:
    const double* w             # (m)
    double omega


ctypedef fused row_form_t:
    csr_t
    damped_csr_t
    stored_slack_t
    generalized_t


cdef inline int32_t find_panel(const row_form_t* form, int32_t i) noexcept nogil:
    """Return the panel of block i if the form is J and M, otherwise 0."""
    if row_form_t is generalized_t:
        return form.home[i]
    else:
        return 0


cdef inline double compute_row_slack(const row_form_t* form, const blocks_t* p, int32_t panel, int32_t row, const double* lam,
                                     const double* v) noexcept nogil:
    """Return the slack w [m/s] of a row. `panel` is `find_panel` of its block; v (nv) is read only if the form is J and M."""
    if row_form_t is csr_t:
        return csr_row_dot(form, row, lam) - p.b[row]
    elif row_form_t is damped_csr_t:
        return csr_row_dot(form.a, row, lam) - p.b[row]
    elif row_form_t is stored_slack_t:
        return form.w[row]
    else:
        return whitened_row_dot(form, panel, row, v) + (form.compliance[row] * lam[row] - p.b[row])


cdef inline double get_row_step(const row_form_t* form, const blocks_t* p, int32_t row) noexcept nogil:
    """Return the step of a row [kg]."""
    if row_form_t is damped_csr_t or row_form_t is stored_slack_t:
        return form.omega * p.step[row]
    else:
        return p.step[row]


cdef inline void set_row_impulse(const row_form_t* form, int32_t panel, int32_t row, double impulse, double* lam,
                                 double* v) noexcept nogil:
    """Set the impulse [N s] of a row in lam (m), and update v (nv) if the form is J and M."""
    if row_form_t is generalized_t:
        add_scaled_whitened_row(form, panel, row, impulse - lam[row], v)
    lam[row] = impulse
