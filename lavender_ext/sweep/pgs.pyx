"""One sweep of projected Gauss-Seidel over the blocks of an order, in each form of A.

    w_q   = sum_j A_qj lam_j - b_q                                   with the current lam                    (1)
    lam_q <- clip(lam_q - w_q / d_q, lower_q, upper_q)               a row; a normal has the bounds 0, inf   (2)
    lam_g <- projection of lam_g - w_g / step on |.| <= a_g lam_n    each friction component g of a contact  (3)

The slack w of a row is read from A, from J and M, or from an array (core/row_forms.pxd); blocks between bodies have an update of
their own (core/contact.pxd). This module contains nothing else, because gcc then inlines the update of a block into its loop.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip, project_normal_update, project_row_update, project_tangent_update
from lavender_ext.core.block_types cimport blocks_t, friction_components_t, get_friction_components, has_independent_rows
from lavender_ext.core.contact cimport relax_contact_block
from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.joint cimport relax_joint_block
from lavender_ext.core.row_forms cimport (damped_csr_t, find_panel, row_form_t, compute_row_slack, get_row_step,
                                          set_row_impulse, stored_slack_t)
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t


cdef struct single_rows_t:      # A in compressed rows, if every block is one row with bounds
    csr_t a


ctypedef fused form_t:
    csr_t
    single_rows_t
    damped_csr_t
    stored_slack_t
    generalized_t
    rows_t


cdef inline void relax_rows_block(const blocks_t* p, const row_form_t* form, int32_t i, double* lam, double* v) noexcept nogil:
    """Update block i row by row, the rows of a friction component together."""
    cdef int32_t first = p.ptr[i], panel = find_panel(form, i), component, row, k
    cdef double friction_bound
    cdef double slack[2]
    cdef double impulse[2]
    cdef friction_components_t components
    # Update bounded rows by (2).
    if has_independent_rows(p, i):
        for row in range(first, p.ptr[i + 1]):
            impulse[0] = lam[row] - compute_row_slack(form, p, panel, row, lam, v) * get_row_step(form, p, row)
            impulse[0] = clip(impulse[0], p.lower[row], p.upper[row])
            set_row_impulse(form, panel, row, impulse[0], lam, v)
        return
    # Update the normal.
    impulse[0] = project_normal_update(lam[first], compute_row_slack(form, p, panel, first, lam, v), get_row_step(form, p, first))
    set_row_impulse(form, panel, first, impulse[0], lam, v)
    # Update the friction components by (3).
    get_friction_components(p, i, &components)
    for component in range(components.n):
        row = first + components.first[component]
        friction_bound = components.friction_coefficient[component] * lam[first]
        for k in range(components.size[component]):
            slack[k] = compute_row_slack(form, p, panel, row + k, lam, v)
        if row_form_t is generalized_t:
            for k in range(components.size[component]):
                impulse[k] = lam[row + k]
            project_tangent_update(impulse, slack, get_row_step(form, p, row), friction_bound, components.size[component])
            for k in range(components.size[component]):
                set_row_impulse(form, panel, row + k, impulse[k], lam, v)
        else:
            project_tangent_update(lam + row, slack, get_row_step(form, p, row), friction_bound, components.size[component])


cdef inline void sweep_blocks(const blocks_t* p, const form_t* form, const int32_t* order, int32_t n, double* lam,
                              double* v) noexcept nogil:
    """Update the blocks order (n), or the first n blocks if single rows or stored slacks; v: velocities of the form, or NULL."""
    cdef int32_t k, i
    for k in range(n):
        i = k if form_t is single_rows_t or form_t is stored_slack_t else order[k]
        if form_t is rows_t:
            if i < form.n_joints:
                relax_joint_block(p, form, i, lam, v)
            else:
                relax_contact_block(p, form, i, lam, v)
        elif form_t is single_rows_t:
            lam[i] = project_row_update(lam[i], csr_row_dot(&form.a, i, lam) - p.b[i], p.step[i], p.lower[i], p.upper[i])
        else:
            relax_rows_block(p, form, i, lam, v)


cdef void sweep_csr_once(const blocks_t* p, const csr_t* a, const int32_t* order, double* lam) noexcept nogil:
    """Sweep over A in compressed rows."""
    sweep_blocks(p, a, order, p.n_blocks, lam, NULL)


cdef void sweep_bounded_rows(const blocks_t* p, const csr_t* a, double* lam) noexcept nogil:
    """Sweep over A if every block is one row with bounds."""
    sweep_blocks(p, <const single_rows_t*>a, NULL, p.n_blocks, lam, NULL)


cdef void sweep_matrix_sor(const blocks_t* p, const csr_t* a, double omega, const int32_t* order, double* lam) noexcept nogil:
    """Sweep over A with steps multiplied by omega (successive over-relaxation, projected on the bounds and cones)."""
    cdef damped_csr_t form = damped_csr_t(a, omega)
    sweep_blocks(p, &form, order, p.n_blocks, lam, NULL)


cdef void sweep_jacobi(const blocks_t* p, const double* w, double omega, double* lam) noexcept nogil:
    """Update all blocks with the slacks w (m) computed before the sweep, and steps multiplied by omega (Jacobi)."""
    cdef stored_slack_t form = stored_slack_t(w, omega)
    sweep_blocks(p, &form, NULL, p.n_blocks, lam, NULL)


cdef void sweep_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t n, double* lam,
                       double* v) noexcept nogil:
    """Sweep over the blocks order (n) of bodies with the velocities v (n_bodies, 6) = M^-1 J^T lam."""
    sweep_blocks(p, r, order, n, lam, v)


cdef void sweep_bodies_in_sequence(const blocks_t* p, const rows_t* r, double* lam, double* v) noexcept nogil:
    """Sweep over all blocks of bodies in the order of the problem."""
    cdef int32_t order[64]
    cdef int32_t first, k, n
    for first in range(0, p.n_blocks, 64):
        n = min(64, p.n_blocks - first)
        for k in range(n):
            order[k] = first + k
        sweep_bodies(p, r, order, n, lam, v)


cdef void sweep_generalized(const blocks_t* p, const generalized_t* g, const int32_t* order, double* lam,
                            double* v) noexcept nogil:
    """Sweep over J and M with the whitened velocities v (nv) = Y^T lam."""
    sweep_blocks(p, g, order, p.n_blocks, lam, v)
