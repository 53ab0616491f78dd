"""The engine's velocity problem as the structs of the shared kernels."""
from lavender_ext.core.block_types cimport COULOMB, blocks_t
from lavender_ext.core.view cimport rows_t
from lavender_ext.engine.arrays cimport H_CONTACTS, H_CONTACT_ROWS, N_DYNAMIC, N_JOINT, N_JOINT_ROW, engine_t


cdef inline void bind_substep_problem(const engine_t* e, blocks_t* p, rows_t* r) noexcept nogil:
    """Fill p and r with pointers to the arrays of the prepared substep.

    nu = d is correct for contacts without spin and for linear joint rows; a caller that judges other rows must set nu.
    """
    p.n_blocks = e.size[N_JOINT] + e.head[H_CONTACTS]
    p.n_rows = e.size[N_JOINT_ROW] + e.head[H_CONTACT_ROWS]
    p.law = COULOMB
    p.ptr = e.ptr
    p.kind = e.kind
    p.lower = e.lower
    p.upper = e.upper
    p.mu = e.mu
    p.patch_radius = e.patch_radius
    p.rolling = e.rolling
    p.b = e.b
    p.d = e.d
    p.nu = e.d
    p.step = e.step
    p.islands = NULL                                    # The engine measures all bodies as one island.
    r.n_bodies = e.size[N_DYNAMIC]
    r.n_joints = e.size[N_JOINT]
    r.n_contacts = e.head[H_CONTACTS]
    r.jac = e.jac
    r.minv_jac = e.minv_jac
    r.joint_body = e.joint_body
    r.normal = e.normal
    r.tangent = e.tangent
    r.arm_a = e.arm_a
    r.arm_b = e.arm_b
    r.contact_body = e.contact_body
    r.coupling = e.coupling
    r.inv_inertia_arm = e.inv_inertia_arm
    r.inv_mass = e.inv_mass
    r.inv_inertia = e.inv_inertia
    r.compliance = e.compliance
