"""Reading of MuJoCo's arrays of one step: from the memory of its structs, or from the attributes of its Python objects.

Reading thirty attributes takes as long as all conversions of a small problem (mujoco_rows.pyx), so `Step` reads the addresses
and counts in the structs mjData, mjContact and mjModel at given offsets.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arrays cimport DOUBLE, INT, as_double_pointer, as_int_pointer, get_checked_data_pointer, ndarray


cdef enum:
    # [bytes] Lower bounds of the memory that MuJoCo allocates for a row, a contact, and an entry of efc_J with its column.
    ROW_BYTES = 128
    CONTACT_BYTES = 512
    ENTRY_BYTES = 12
    # Positions in MEMBERS. The first N_FIXED arrays belong to an MjData for life. The arrays before EFC_TYPE hold float64, the
    # others int32.
    N_FIXED = 8
    EFC_TYPE = 16
    ROW_COUNTS = 18                                     # This array and the arrays after it are needed only if J is sparse.
    N_ARRAYS = 21
    N_DATA_INTS = 5
    JACOBIAN = N_ARRAYS + N_DATA_INTS
    TIMESTEP = JACOBIAN + 3
    FIRST_CONTACT = TIMESTEP + 1
    DIM = FIRST_CONTACT + 1
    CONTACT_SIZE = DIM + 4

ARRAYS = tuple((
    "qvel qacc qacc_smooth qfrc_smooth qfrc_constraint M cdof cvel efc_J efc_D efc_R efc_aref efc_force efc_vel efc_b "
    "efc_frictionloss efc_type efc_id efc_J_rownnz efc_J_rowadr efc_J_colind").split())
#: Structs and members that `Step` reads, in the order of its `offsets`. "" is the size of the struct.
MEMBERS = tuple((struct, name) for struct, names in (
    ("mjData", (*ARRAYS, "nefc", "ncon", "nJ", "parena", "efm_active")),
    ("mjModel", ("opt.jacobian", "opt.noslip_iterations", "flg_surfacevel", "opt.timestep")),
    ("mjData", ("contact",)),
    ("mjContact", ("dim", "geom", "friction", "efc_address", "")),
) for name in names)


cdef int64_t read_int(bytes_ struct, int64_t offset, int64_t size) noexcept:
    """Return an integer of 1, 4 or 8 bytes at an offset; 0 if the offset is negative."""
    cdef bytes_ at = struct + offset
    if offset < 0:
        return 0
    return at[0] if size == 1 else (<int32_t*>at)[0] if size == 4 else (<int64_t*>at)[0]


cdef class Step:
    """The arrays of an MjData and its model, at the addresses of the last `read`.

    Parameters
    ----------
    model, data : mujoco.MjModel, mujoco.MjData
        The model is kept alive. The caller keeps the MjData alive.
    offsets : (35, 2) int64 or None
        Offset and size of each of MEMBERS [bytes]; an offset of -1 means that there is no such member. The size of mjContact is
        the last offset. None: members are read from attributes.
    find_sparse : callable
        mujoco.mj_isSparse.
    cache : object
        Kept for the caller.

    Raises
    ------
    ValueError
        An array of the MjData has another size than the model's.
    """

    def __init__(self, model, data, offsets, find_sparse, cache):
        cdef int32_t i, n = model.nv, entries = <int32_t>len(model.M_colind), bodies = model.nbody
        self.model, self.find_sparse, self.cache, self.offsets = model, find_sparse, cache, offsets
        self.known_jacobian = -1
        if offsets is not None:
            self.data_address, self.model_address = <bytes_><size_t>data._address, <bytes_><size_t>model._address
        self.at.n, self.at.mass_entries, self.at.bodies = n, entries, bodies
        for i, size in enumerate((n, n, n, n, n, entries, 6 * n, 6 * bodies)):
            (<double**>&self.at)[i] = as_double_pointer(getattr(data, ARRAYS[i]), size)
        for i, (name, size) in enumerate((("M_rowadr", n), ("M_rownnz", n), ("M_colind", entries), ("dof_bodyid", n),
                                          ("body_parentid", bodies))):
            (<int32_t**>&self.at.M_rowadr)[i] = as_int_pointer(getattr(model, name), size)
        for i, size in enumerate((model.neq, n, model.ntendon, model.njnt, model.ntendon)):
            self.object_counts[i] = size

    def read(self, data):
        """Read counts, options and addresses of arrays again; return whether the arrays fit into the memory of the MjData."""
        if self.offsets is not None:
            self.read_memory()
        else:
            self.read_attributes(data)
        if self.at.jacobian != self.known_jacobian:
            self.is_sparse, self.known_jacobian = self.find_sparse(self.model), self.at.jacobian
        return self.has_valid_counts() and self.has_rows()

    cdef bint has_rows(self) noexcept:
        """Return whether the arrays of rows and contacts exist, unless their counts are 0."""
        cdef const step_t* p = &self.at
        cdef int32_t i
        if p.contacts and p.dim == NULL or p.jac_entries and p.efc_J == NULL:
            return False
        for i in range(N_FIXED + 1, ROW_COUNTS):
            if p.m and (<void**>p)[i] == NULL:
                return False
        return True

    cdef bint has_valid_counts(self) noexcept:
        """Return whether the counts are not negative, and the arrays fit into the part of the arena that is in use."""
        cdef const step_t* p = &self.at
        return min(p.m, p.contacts, p.jac_entries) >= 0 and (
            p.m * ROW_BYTES + p.contacts * CONTACT_BYTES + p.jac_entries * ENTRY_BYTES <= p.arena)

    cdef void read_memory(self) noexcept:
        """Read all members from the structs of MuJoCo."""
        cdef step_t* p = &self.at
        cdef int32_t i
        cdef const int64_t* offset = <const int64_t*>(<ndarray>self.offsets).data
        cdef bytes_ contact = (<bytes_*>(self.data_address + offset[2 * FIRST_CONTACT]))[0]
        for i in range(N_ARRAYS):
            (<void**>p)[i] = (<void**>(self.data_address + offset[2 * i]))[0]
        for i in range(8):
            (&p.m)[i] = read_int(self.data_address if i < N_DATA_INTS else self.model_address,
                                 offset[2 * (N_ARRAYS + i)], offset[2 * (N_ARRAYS + i) + 1])
        p.dt = (<const double*>(self.model_address + offset[2 * TIMESTEP]))[0]
        for i in range(4):
            (&p.dim)[i] = contact
            if contact != NULL:
                (&p.dim)[i] += offset[2 * (DIM + i)]
        p.stride = offset[2 * CONTACT_SIZE]

    cdef void read_attributes(self, data) except *:
        """Read all members from attributes; no addresses if the counts are not valid."""
        cdef step_t* p = &self.at
        cdef int32_t i, kind
        cdef ndarray x
        opt, self.arrays = self.model.opt, []
        p.m, p.contacts, p.jac_entries, p.arena = data.nefc, data.ncon, data.nJ, data.parena
        p.is_discrete, p.has_moving_surfaces = getattr(data, "efm_active", 0), getattr(self.model, "flg_surfacevel", 0)
        p.dt, p.jacobian, p.noslip_iterations = opt.timestep, opt.jacobian, opt.noslip_iterations
        if not self.has_valid_counts():
            return
        for i in range(N_FIXED, N_ARRAYS):
            x = getattr(data, ARRAYS[i])
            kind = DOUBLE if i < EFC_TYPE else INT
            (<void**>p)[i] = get_checked_data_pointer(x, x.size, 1, kind, NULL) if x.size else NULL
            self.arrays.append(x)
        contact = data.contact if p.contacts else None
        for i, (name, width) in enumerate((("dim", 1), ("geom", 2), ("friction", 5), ("efc_address", 1)) if p.contacts else ()):
            x = getattr(contact, name)
            (&p.dim)[i] = get_checked_data_pointer(x, p.contacts, width, DOUBLE if width == 5 else INT, &p.stride)
            self.arrays.append(x)

    def has_equal_members(self, Step other):
        """Return whether both read the same from their MjData, with rows in compressed form and at least two contacts."""
        cdef int32_t i
        for i in range(N_ARRAYS + 5):                   # with the contacts' addresses and their distance
            if (<void**>&self.at)[i] != (<void**>&other.at)[i]:
                return False
        for i in range(N_DATA_INTS + 3):
            if (&self.at.m)[i] != (&other.at.m)[i]:
                return False
        return self.at.dt == other.at.dt

    @property
    def counts(self):
        """nefc, ncon, nJ and parena of the MjData."""
        return self.at.m, self.at.contacts, self.at.jac_entries, self.at.arena

    @property
    def m(self):
        """Number of rows."""
        return self.at.m

    @property
    def n(self):
        """Number of velocities, nv."""
        return self.at.n

    @property
    def dt(self):
        """Time step [s]."""
        return self.at.dt

    @property
    def has_noslip(self):
        """Whether MuJoCo changes its answer by noslip iterations."""
        return self.at.noslip_iterations > 0

    @property
    def is_discrete(self):
        """Whether the last forward pass used a matrix other than M."""
        return self.at.is_discrete != 0

    @property
    def has_mass(self):
        """Whether M was computed; its first diagonal entry is then positive."""
        return self.at.n == 0 or self.at.M[0] != 0.0

    @property
    def type_counts(self):
        """Number of objects that rows of each type may refer to, in the order of the codes of `lav_export_blocks`."""
        return [self.object_counts[i] for i in range(5)] + 3 * [self.at.contacts]
