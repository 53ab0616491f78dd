"""The update of a contact between two bodies, for one contact or for two of one kind at once (core/numbers.pxd).

The rows of a contact are coupled by A_tn, A_sn and A_st only. An update reads the relative velocity (core/rows.pxd (1), (2))
once, corrects it by these couplings, and changes the velocities of both bodies once:

    w_t after the normal's change = t.u + A_tn (change of lam_n) + c lam_t - b_t, and so on                     (1)

The angular velocity changes by the stored I^-1 (arm x axis) of each row (`inv_inertia_arm`): one product instead of two between
successive contacts, 1.3 times as fast.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport (blocks_t, friction_components_t, get_friction_components, is_box_friction_contact,
                                            is_disk_friction_contact, count_angular_rows, count_tangent_rows)
from lavender_ext.core.numbers cimport (apply_contact_impulse_changes_to_body, clip_below_zero, clip_to_bound,
                                        convert_to_type_of, dot_numbers, number_t, project_disk, compute_relative_angular_velocity)
from lavender_ext.core.rows cimport cross
from lavender_ext.core.view cimport rows_t


cdef struct contact_t:              # arrays of `number_t` that the update of a contact with n rows reads
    const double* normal            # (3)
    const double* tangent1          # (3)
    const double* tangent2          # (3)
    const double* arm_a             # (3) m
    const double* arm_b             # (3) m
    const double* inv_mass_a        # 1/kg
    const double* inv_mass_b        # 1/kg
    const double* compliance        # (n) 1/kg
    const double* b                 # (n) m/s
    const double* step              # (n) kg
    const double* inv_inertia_arm   # (n, 6) as in rows_t
    const double* coupling          # (5) as in rows_t
    const double* mu                # - of the tangents; of a box, of its first tangent
    const double* second_mu         # m of the spin row; of a box, - of its second tangent
    const double* rolling_mu        # m
    int32_t n_tangents
    bint box                        # two tangents, each with a bound of its own
    bint spins                      # one spin row follows the tangents,
    bint rolls                      # then two rolling rows
    int32_t body_a                  # negative: static; bodies of a pair count as moving
    int32_t body_b


# Kinds of contacts. The update is compiled with constant numbers of rows for normal_t, a normal alone, and disk_t, with two
# tangents in a disk. For other_contact_t it reads them from contact_t.
cdef struct normal_t:
    contact_t contact
cdef struct disk_t:
    contact_t contact
cdef struct other_contact_t:
    contact_t contact

ctypedef fused contact_kind_t:
    normal_t
    disk_t
    other_contact_t


cdef inline void relax_contact(const contact_kind_t* kind, number_t* lam, number_t* va, number_t* vb) noexcept nogil:
    """Update a contact: its normal, its tangents (together, or for a box one by one), its spin row, then its rolling rows.

    lam (n) [N s] are the impulses of the contact; va and vb (6) are the velocities of its bodies, not read for a static body.
    """
    # arrays and numbers of rows
    cdef const contact_t* c = &kind.contact
    cdef const number_t* normal = <const number_t*>c.normal
    cdef const number_t* tangent1 = <const number_t*>c.tangent1
    cdef const number_t* tangent2 = <const number_t*>c.tangent2
    cdef const number_t* arm_a = <const number_t*>c.arm_a
    cdef const number_t* arm_b = <const number_t*>c.arm_b
    cdef const number_t* compliance = <const number_t*>c.compliance
    cdef const number_t* b = <const number_t*>c.b
    cdef const number_t* step = <const number_t*>c.step
    cdef const number_t* inv_inertia_arm = <const number_t*>c.inv_inertia_arm
    cdef const number_t* coupling = <const number_t*>c.coupling
    cdef int32_t nt = c.n_tangents if contact_kind_t is other_contact_t else 0 if contact_kind_t is normal_t else 2
    cdef bint box = c.box if contact_kind_t is other_contact_t else False
    cdef bint spins = c.spins if contact_kind_t is other_contact_t else False
    cdef bint rolls = c.rolls if contact_kind_t is other_contact_t else False
    cdef int32_t body_a = c.body_a if number_t is double else 0, body_b = c.body_b if number_t is double else 0
    cdef number_t u[3]
    cdef number_t omega[3]
    cdef number_t impulse[3]
    cdef number_t change[4]
    cdef number_t slack, normal_impulse, old, tangent_impulse1, tangent_impulse2, friction_bound
    cdef int32_t k, spin_row = 1 + nt, rolling_row = 1 + nt + spins
    # relative velocity
    for k in range(3):
        u[k] = convert_to_type_of(lam, 0.0)
    if body_b >= 0:
        u[0] = vb[0] + (vb[4] * arm_b[2] - vb[5] * arm_b[1])
        u[1] = vb[1] + (vb[5] * arm_b[0] - vb[3] * arm_b[2])
        u[2] = vb[2] + (vb[3] * arm_b[1] - vb[4] * arm_b[0])
    if body_a >= 0:
        u[0] = u[0] - (va[0] + (va[4] * arm_a[2] - va[5] * arm_a[1]))
        u[1] = u[1] - (va[1] + (va[5] * arm_a[0] - va[3] * arm_a[2]))
        u[2] = u[2] - (va[2] + (va[3] * arm_a[1] - va[4] * arm_a[0]))
    if spins:
        compute_relative_angular_velocity(va, vb, body_a, body_b, omega)
    # normal
    slack = dot_numbers(normal, u) + (compliance[0] * lam[0] - b[0])
    normal_impulse = clip_below_zero(lam[0] - slack * step[0])
    change[0] = normal_impulse - lam[0]
    change[1] = change[2] = change[3] = convert_to_type_of(lam, 0.0)
    lam[0] = normal_impulse
    for k in range(3):
        impulse[k] = change[0] * normal[k]
    # tangents: slacks after the normal's change (1)
    if nt > 0:
        friction_bound = (<const number_t*>c.mu)[0] * normal_impulse
        slack = (dot_numbers(tangent1, u) + (compliance[1] * lam[1] - b[1])) + coupling[0] * change[0]
        tangent_impulse1 = lam[1] - slack * step[1]
        if nt == 1:
            tangent_impulse1 = clip_to_bound(tangent_impulse1, friction_bound)
        else:
            slack = (dot_numbers(tangent2, u) + (compliance[2] * lam[2] - b[2])) + coupling[1] * change[0]
            if box:
                tangent_impulse1 = clip_to_bound(tangent_impulse1, friction_bound)
                # The change of the first tangent enters last, so that the other operations do not wait for it.
                tangent_impulse2 = lam[2] - slack * step[2]
                tangent_impulse2 = tangent_impulse2 - (tangent_impulse1 - lam[1]) * (coupling[2] * step[2])
                tangent_impulse2 = clip_to_bound(tangent_impulse2, (<const number_t*>c.second_mu)[0] * normal_impulse)
            else:
                tangent_impulse2 = lam[2] - slack * step[1]     # Both rows of a disk have the same step.
                project_disk(&tangent_impulse1, &tangent_impulse2, friction_bound)
            change[2] = tangent_impulse2 - lam[2]
            lam[2] = tangent_impulse2
        change[1] = tangent_impulse1 - lam[1]
        lam[1] = tangent_impulse1
        for k in range(3):
            impulse[k] = impulse[k] + change[1] * tangent1[k]
            if nt == 2:
                impulse[k] = impulse[k] + change[2] * tangent2[k]
    # spin row
    if spins:
        old = lam[spin_row]
        slack = (dot_numbers(normal, omega) + (compliance[spin_row] * old - b[spin_row])
                 + coupling[2] * change[0] + coupling[3] * change[1] + coupling[4] * change[2])
        friction_bound = (<const number_t*>c.second_mu)[0] * normal_impulse
        lam[spin_row] = clip_to_bound(old - slack * step[spin_row], friction_bound)
        change[3] = lam[spin_row] - old
    # velocities of both bodies
    if body_a >= 0:
        apply_contact_impulse_changes_to_body(va, <const number_t*>c.inv_mass_a, inv_inertia_arm, impulse, change, nt, spins, -1)
    if body_b >= 0:
        apply_contact_impulse_changes_to_body(vb, <const number_t*>c.inv_mass_b, inv_inertia_arm + 3, impulse, change, nt, spins, 1)
    # rolling rows
    if rolls:
        compute_relative_angular_velocity(va, vb, body_a, body_b, omega)
        friction_bound = (<const number_t*>c.rolling_mu)[0] * normal_impulse
        compliance += rolling_row
        b += rolling_row
        step += rolling_row
        lam += rolling_row
        inv_inertia_arm += 6 * rolling_row
        tangent_impulse1 = lam[0] - (dot_numbers(tangent1, omega) + (compliance[0] * lam[0] - b[0])) * step[0]
        tangent_impulse2 = lam[1] - (dot_numbers(tangent2, omega) + (compliance[1] * lam[1] - b[1])) * step[0]
        project_disk(&tangent_impulse1, &tangent_impulse2, friction_bound)
        change[0] = tangent_impulse1 - lam[0]
        change[1] = tangent_impulse2 - lam[1]
        lam[0] = tangent_impulse1
        lam[1] = tangent_impulse2
        for k in range(3):
            if body_a >= 0:
                va[3 + k] = va[3 + k] - (change[0] * inv_inertia_arm[k] + change[1] * inv_inertia_arm[6 + k])
            if body_b >= 0:
                vb[3 + k] = vb[3 + k] + (change[0] * inv_inertia_arm[3 + k] + change[1] * inv_inertia_arm[9 + k])


cdef inline void bind_contact_arrays(const blocks_t* p, const rows_t* r, int32_t i, contact_t* out) noexcept nogil:
    """Point `out` at the arrays of contact block i, without its second tangent and friction coefficients."""
    cdef int32_t c = i - r.n_joints, j = p.ptr[i], a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    out.normal, out.tangent1 = r.normal + 3 * c, r.tangent + 3 * c
    out.arm_a, out.arm_b = r.arm_a + 3 * c, r.arm_b + 3 * c
    out.body_a, out.body_b = a, b
    out.inv_mass_a, out.inv_mass_b = r.inv_mass + a, r.inv_mass + b
    out.compliance, out.b, out.step = r.compliance + j, p.b + j, p.step + j
    out.inv_inertia_arm, out.coupling = r.inv_inertia_arm + 6 * (j - p.ptr[r.n_joints]), r.coupling + 5 * c


cdef inline void bind_contact_friction(const blocks_t* p, int32_t i, friction_components_t* components, double* tangent2,
                                       contact_t* out) noexcept nogil:
    """Add the friction of contact block i to `out`, and compute its `components` and second tangent (3)."""
    cdef int32_t n_angular = count_angular_rows(p, i)
    get_friction_components(p, i, components)
    out.n_tangents, out.box = count_tangent_rows(p, i), is_box_friction_contact(p, i)
    out.spins, out.rolls = n_angular & 1, n_angular >> 1
    out.mu = components.friction_coefficient
    out.second_mu = components.friction_coefficient + (1 if out.n_tangents else 0)
    out.rolling_mu = components.friction_coefficient + components.n - 1
    if out.n_tangents == 2:
        cross(out.normal, out.tangent1, tangent2)
    out.tangent2 = tangent2


cdef inline void relax_contact_block(const blocks_t* p, const rows_t* r, int32_t i, double* lam, double* v) noexcept nogil:
    """Update contact block i; lam (m), v (n_bodies, 6). Common kinds are compiled with constant sizes."""
    cdef int32_t c = i - r.n_joints, j = p.ptr[i]
    cdef double* va = v + 6 * <ssize_t>r.contact_body[2 * c]
    cdef double* vb = v + 6 * <ssize_t>r.contact_body[2 * c + 1]
    cdef double tangent2[3]
    cdef friction_components_t components
    cdef contact_t contact
    # Each branch binds only the arrays that its kind reads.
    if is_disk_friction_contact(p, i):
        bind_contact_arrays(p, r, i, &contact)
        cross(contact.normal, contact.tangent1, tangent2)
        contact.tangent2, contact.mu = tangent2, p.mu + i
        relax_contact(<const disk_t*>&contact, lam + j, va, vb)
    elif p.ptr[i + 1] - j == 1:
        bind_contact_arrays(p, r, i, &contact)
        relax_contact(<const normal_t*>&contact, lam + j, va, vb)
    else:
        bind_contact_arrays(p, r, i, &contact)
        bind_contact_friction(p, i, &components, tangent2, &contact)
        relax_contact(<const other_contact_t*>&contact, lam + j, va, vb)
