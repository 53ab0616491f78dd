"""Derived numbers of a problem: diagonal d, velocity weight nu, sweep step, coupling of the rows of a contact.

    d_i     = A_ii; max_j |A_ij| if A_ii <= 1e-10 of it (only for a matrix A). An empty row (largest entry below 1e-60) gets the
              mean d of the other rows, or 1 if all are empty. The two tangents of a disk get their mean, and so do the two
              rolling rows.                                                                                        (1)
    nu_i    = d_i; on a spin or rolling row d of its normal; on an angular joint row 1/m_a + 1/m_b                 (2)
    step_i    see core/steps.pxd                                                                                   (3)
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy, memset

cimport cython

import numpy as np

from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles, take_integers
from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer, make_read_only
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.validate cimport find_invalid_number, min_magnitude
from lavender_ext.core.dot cimport dot
from lavender_ext.core.faults cimport CONTACT_ELLIPSE
from lavender_ext.core.generalized cimport Operator
from lavender_ext.core.block_types cimport (CONE, COULOMB, MAX_FRICTION_COMPONENTS, blocks_t, is_box_friction_contact, islands_t,
                                            count_tangent_rows,
                                            count_angular_rows, get_friction_components, friction_components_t)
from lavender_ext.core.rows cimport (compute_contact_delassus_block, dot12, largest_eigenvalue_2x2, multiply_inverse_mass,
                                     multiply_jacobian)
from lavender_ext.core.steps cimport finish_metric
from lavender_ext.core.whiten cimport find_panel_pattern, whiten_panel
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.core.weights cimport compute_velocity_weights, set_angular_joint_weights


cdef object new = np.empty, I4 = np.dtype(np.int32)

#: Kernel numbers of the friction laws.
LAWS = {"coulomb": COULOMB, "cone": CONE}


cdef inline void replace_empty_diagonal(int32_t m, double* d) noexcept nogil:
    """Replace entries of d (m) [1/kg] that are not positive by the mean of the positive ones, or by 1 without any; keep NaN."""
    cdef int32_t i, count = 0
    cdef double total = 0.0, mean
    for i in range(m):
        if d[i] > 0.0:
            count += 1
            total += d[i] / m
    mean = total * m / count if count > 0 and total > 0.0 else 1.0
    for i in range(m):
        if d[i] <= 0.0:
            d[i] = mean


cdef inline double get_csr_entry(const csr_t* a, int32_t i, int32_t j) noexcept nogil:
    """Return A_ij."""
    cdef int32_t q
    cdef double s = 0.0
    for q in range(a.indptr[i], a.indptr[i + 1]):
        if a.indices[q] == j:
            s += a.data[q]
    return s


cdef public int32_t lav_compute_csr_diagonal(const blocks_t* p, const csr_t* a, int32_t* empty) noexcept nogil:
    """Compute p.d, p.nu and p.step from the rows of A; mark empty rows (m) and return their number."""
    cdef double* d = <double*>p.d
    cdef double* step = <double*>p.step
    cdef int32_t i, j, q, g, n_empty = 0
    cdef double diag, big, x
    cdef double eigenvalue[MAX_FRICTION_COMPONENTS]
    cdef friction_components_t part
    for i in range(p.n_rows):
        diag = big = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            x = fabs(a.data[q])
            if x > big:
                big = x
            if a.indices[q] == i:
                diag += a.data[q]
        d[i] = diag if diag > 1e-10 * big else big
        empty[i] = big < min_magnitude()
        if empty[i]:
            d[i] = 0.0
        n_empty += empty[i]
        step[i] = big                                   # Store the largest |A_ij| of the row for the end of this function.
    replace_empty_diagonal(p.n_rows, d)
    for i in range(p.n_blocks):
        j = p.ptr[i]
        get_friction_components(p, i, &part)
        for g in range(part.n):
            if part.size[g] == 2:
                q = j + part.first[g]                   # (3) of core/steps.pxd, or 0 if it is at most 0 within rounding
                x = largest_eigenvalue_2x2(get_csr_entry(a, q, q), 0.5 * (get_csr_entry(a, q, q + 1) + get_csr_entry(a, q + 1, q)),
                                           get_csr_entry(a, q + 1, q + 1))
                eigenvalue[g] = x if x > 1e-10 * (step[q] if step[q] > step[q + 1] else step[q + 1]) else 0.0
        finish_metric(p, i, eigenvalue, d, step)
    compute_velocity_weights(p, d, <double*>p.nu)
    return n_empty


cdef public int32_t lav_compute_body_diagonal(const blocks_t* p, const rows_t* r, int32_t* empty) noexcept nogil:
    """Compute p.d, p.nu, p.step, and the other arrays of `derive_row_numbers`; mark empty rows (m) and return their number."""
    cdef double* d = <double*>p.d
    cdef double* step = <double*>p.step
    cdef int32_t i, j, q, g, c, nt, n_empty = 0, a, b
    cdef double off[2]
    cdef double eigenvalue[MAX_FRICTION_COMPONENTS]
    cdef friction_components_t part
    # joints: M^-1 J^T and diagonal
    for i in range(r.n_joints):
        a = r.joint_body[2 * i]
        b = r.joint_body[2 * i + 1]
        for j in range(p.ptr[i], p.ptr[i + 1]):
            multiply_inverse_mass(r.jac + 12 * j, r.inv_mass, r.inv_inertia, a, b, <double*>r.minv_jac + 12 * j)
            d[j] = dot12(r.jac + 12 * j, r.minv_jac + 12 * j) + r.compliance[j]
            step[j] = 0.0
    # contacts: block of A
    for c in range(r.n_contacts):
        i = r.n_joints + c
        j = p.ptr[i]
        nt = count_tangent_rows(p, i)
        compute_contact_delassus_block(r.normal + 3 * c, r.tangent + 3 * c, r.arm_a + 3 * c, r.arm_b + 3 * c, nt,
                         count_angular_rows(p, i), r.contact_body[2 * c], r.contact_body[2 * c + 1], r.inv_mass,
                         r.inv_inertia, d + j, off,
                         <double*>r.coupling + 5 * c, <double*>r.inv_inertia_arm + 6 * (j - p.ptr[r.n_joints]))
        for q in range(j, p.ptr[i + 1]):
            d[q] += r.compliance[q]
            step[q] = 0.0
        # The second tangent of a box uses the impulse change of the first.
        if is_box_friction_contact(p, i):
            (<double*>r.coupling)[5 * c + 2] = off[0]
        get_friction_components(p, i, &part)
        for g in range(part.n):
            if part.size[g] == 2:
                q = j + part.first[g]
                step[q] = largest_eigenvalue_2x2(d[q], off[part.first[g] > nt], d[q + 1])
    # empty rows
    for j in range(p.n_rows):
        empty[j] = fabs(d[j]) < min_magnitude()
        if empty[j]:
            d[j] = 0.0
        n_empty += empty[j]
    replace_empty_diagonal(p.n_rows, d)
    # steps
    for i in range(p.n_blocks):
        get_friction_components(p, i, &part)
        for g in range(part.n):
            eigenvalue[g] = step[p.ptr[i] + part.first[g]]
        finish_metric(p, i, eigenvalue, d, step)
    compute_velocity_weights(p, d, <double*>p.nu)
    set_angular_joint_weights(p, r, <double*>p.nu)
    return n_empty


cdef int32_t derive_row_numbers(blocks_t* p, const csr_t* a, rows_t* r, arena_t* arena) noexcept nogil:
    """Compute d, nu and step, and for bodies M^-1 J^T of joints, coupling and inv_inertia_arm of contacts, in an arena.

    A (NULL for bodies) or the bodies (NULL for A) are given. Returns the number of empty rows, which the arena's next m + 1
    integers mark, and 0 if the arena only counts.
    """
    cdef int64_t m = p.n_rows, joint_rows
    cdef int32_t* empty = take_integers(arena, m + 1)
    p.d, p.nu, p.step = take_doubles(arena, m + 1), take_doubles(arena, m + 1), take_doubles(arena, m + 1)
    if r != NULL:
        joint_rows = p.ptr[r.n_joints]
        r.minv_jac, r.coupling = take_doubles(arena, 12 * joint_rows), take_doubles(arena, 5 * <int64_t>r.n_contacts)
        r.inv_inertia_arm = take_doubles(arena, 6 * (m - joint_rows))
    if not has_memory(arena):
        return 0
    if r == NULL:
        return lav_compute_csr_diagonal(p, a, empty)
    memset(<double*>r.minv_jac, 0, (12 * joint_rows + 5 * <int64_t>r.n_contacts + 6 * (m - joint_rows)) * sizeof(double))
    return lav_compute_body_diagonal(p, r, empty)


cdef int bind_body_arrays(rows_t* r, const blocks_t* p, rows) except -1:
    """Point r at the arrays of the factored form (argument `rows` of `Data`); the caller keeps them alive."""
    jac, joint_body, normal, tangent, arm_a, arm_b, contact_body, inv_mass, inv_inertia, compliance = rows
    cdef Py_ssize_t n = len(inv_mass), kj = len(joint_body), c = len(contact_body)
    r.n_bodies, r.n_joints, r.n_contacts = <int32_t>n, <int32_t>kj, <int32_t>c
    r.jac, r.joint_body = as_double_pointer(jac, 12 * <Py_ssize_t>p.ptr[kj]), as_int_pointer(joint_body, 2 * kj)
    r.normal, r.tangent = as_double_pointer(normal, 3 * c), as_double_pointer(tangent, 3 * c)
    r.arm_a, r.arm_b = as_double_pointer(arm_a, 3 * c), as_double_pointer(arm_b, 3 * c)
    r.contact_body, r.compliance = as_int_pointer(contact_body, 2 * c), as_double_pointer(compliance, p.n_rows)
    r.inv_mass, r.inv_inertia = as_double_pointer(inv_mass, n), as_double_pointer(inv_inertia, 9 * n)
    return 0


cdef public int32_t lav_compute_generalized_diagonal(const blocks_t* p, const generalized_t* g, int32_t* empty,
                                                     int32_t* place) noexcept nogil:
    """Compute g.y, p.d, p.nu and p.step in generalised coordinates; return the number of empty rows. place (n) is scratch."""
    cdef double* d = <double*>p.d
    cdef double* y = <double*>g.y
    cdef int32_t i, j, b, nc, part_, n_empty = 0
    cdef double eigenvalue[MAX_FRICTION_COMPONENTS]
    cdef friction_components_t part
    cdef const double* row
    for b in range(g.n_panels):
        whiten_panel(g, b, place, y + g.pval[b])
        nc = g.pcol[b + 1] - g.pcol[b]
        row = y + g.pval[b]
        for i in range(g.prow[b], g.prow[b + 1]):
            d[i] = dot(row, row, nc) + g.compliance[i]
            empty[i] = d[i] < min_magnitude()
            if empty[i]:
                d[i] = 0.0
                n_empty += 1
            row += nc
    if n_empty > 0:
        replace_empty_diagonal(p.n_rows, d)
    b = 0
    for i in range(p.n_blocks):
        j = p.ptr[i]
        while g.prow[b + 1] <= j:
            b += 1
        nc = g.pcol[b + 1] - g.pcol[b]
        get_friction_components(p, i, &part)
        for part_ in range(part.n):
            if part.size[part_] == 2:
                j = p.ptr[i] + part.first[part_]
                row = y + g.pval[b] + (j - g.prow[b]) * nc
                eigenvalue[part_] = largest_eigenvalue_2x2(d[j], dot(row, row + nc, nc), d[j + 1])
        finish_metric(p, i, eigenvalue, d, <double*>p.step)
    compute_velocity_weights(p, d, <double*>p.nu)
    return n_empty


cdef void bind_derived_numbers(blocks_t* p, generalized_t* g, const derived_t* derived) noexcept nogil:
    """Point d, nu, step of p and the panels of Y of g at the arrays of `derived`."""
    cdef ssize_t k = p.n_blocks, m = p.n_rows
    p.d = derived.numbers
    p.nu = derived.numbers + m + 1
    p.step = derived.numbers + 2 * (m + 1)
    g.y = derived.numbers + 3 * (m + 1)
    g.n_panels = derived.n_panels
    g.prow = derived.marks + 2 * <ssize_t>g.n
    g.pcol = g.prow + k + 1
    g.pval = g.pcol + k + 1
    g.home = derived.empty + m + 1
    g.cols = g.home + k


cdef int32_t compute_derived_numbers_of_jacobian(blocks_t* p, generalized_t* g, derived_t* out) noexcept nogil:
    """Compute panels, Y, d, nu and step in generalised coordinates, and point p and g at them.

    `out` is zero-initialised, or holds the memory of an earlier problem, which is reused. Returns DERIVED, NO_MEMORY or
    TOO_MANY (indices exceed 32 bits).
    """
    cdef int32_t n = g.n, k = p.n_blocks, m = p.n_rows, n_cols, i, b = 0
    cdef int32_t* home
    cdef ssize_t head = 2 * <ssize_t>n + 3 * (<ssize_t>k + 1) + m + 1 + k, workspace = 2 * <ssize_t>g.jptr[m] + 64, max_workspace
    cdef ssize_t size
    cdef int32_t* w
    max_workspace = 2147483647 - head
    # panels, with more memory until it suffices
    while True:
        if out.n_marks < head + workspace:
            free(out.marks)
            out.marks = <int32_t*>malloc((head + workspace) * sizeof(int32_t))
            out.n_marks = head + workspace if out.marks != NULL else 0
        w = out.marks
        if w == NULL:
            return NO_MEMORY
        out.n_panels = find_panel_pattern(g, k, p.ptr, w, w + 2 * n, w + 2 * n + k + 1, w + 2 * n + 2 * (k + 1), w + head,
                                     <int32_t>workspace, &n_cols, &out.values)
        if out.n_panels >= 0:
            break
        if workspace >= max_workspace:
            return TOO_MANY
        workspace = 2 * workspace if 2 * workspace < max_workspace else max_workspace
    if out.values >= 2147483647.0:
        return TOO_MANY
    size = 3 * (<ssize_t>m + 1) + <ssize_t>out.values + 1
    if out.n_numbers < size:
        free(out.numbers)
        out.numbers = <double*>malloc(size * sizeof(double))
        out.n_numbers = size if out.numbers != NULL else 0
    if out.numbers == NULL:
        return NO_MEMORY
    # panel of each block
    out.empty = w + head - (m + 1) - k
    home = w + head - k
    for i in range(k):
        while w[2 * <ssize_t>n + b + 1] <= p.ptr[i]:        # prow
            b += 1
        home[i] = b
    bind_derived_numbers(p, g, out)
    out.n_empty = lav_compute_generalized_diagonal(p, g, out.empty, w)
    return DERIVED


cdef class Workspace:
    """Memory that is freed with its Python object. Creating it takes a quarter of the time of a NumPy array with a view."""

    def __dealloc__(self):
        free(self.at)


cdef Workspace allocate_bytes(Py_ssize_t bytes):
    """Allocate uninitialised memory; raise MemoryError if that fails."""
    cdef Workspace workspace = Workspace.__new__(Workspace)
    workspace.at = malloc(bytes if bytes > 0 else 1)
    if workspace.at == NULL:
        raise MemoryError(f"{bytes} bytes")
    return workspace


cdef class Data:
    """Pointers to the arrays of a problem, and the numbers derived from them once.

    The arrays must be validated, C-contiguous float64 or int32 arrays; they are kept alive. Either `csr` = (indptr, indices,
    data) or `rows` = (joint_jac, joint_body, normal, tangent, arm_a, arm_b, contact_body, inv_mass, inv_inertia, compliance)
    is given. `make_generalized_data` creates data in generalised coordinates.
    """

    def __init__(self, Blocks blocks, b_, int law, csr=None, rows=None):
        cdef int32_t m = blocks.at.n_rows, n_empty, i
        cdef arena_t arena = make_arena(NULL, NULL)
        cdef csr_t* a = NULL
        cdef rows_t* r = NULL
        cdef Workspace marks
        self.blocks = blocks.at
        self.blocks.law = law
        self.blocks.b = as_double_pointer(b_, m)
        self.reference_energy = self.reference_velocity = self.relative_at_zero = -1.0
        self.ready = True
        self.factored = rows is not None
        self.single_rows = blocks.single_rows
        if self.factored:
            r = &self.rows
            bind_body_arrays(r, &self.blocks, rows)
        else:
            a = &self.csr
            indptr, indices, data = csr
            a.indptr, a.indices = as_int_pointer(indptr, m + 1), as_int_pointer(indices, len(indices))
            a.data = as_double_pointer(data, len(data))
        derive_row_numbers(&self.blocks, a, r, &arena)
        marks, numbers = allocate_bytes(arena.n_index * sizeof(int32_t)), new(arena.n_real)
        arena = make_arena(as_double_pointer(numbers, arena.n_real), <int32_t*>marks.at)
        n_empty = derive_row_numbers(&self.blocks, a, r, &arena)
        self.keep = [blocks, b_, numbers, csr, rows]
        self._numbers, self._arrays = numbers, [None, None, None]
        self.empty = _NONE
        if n_empty:
            self.empty = make_read_only(np.array([i for i in range(m) if arena.index[i]], np.intp))

    def __dealloc__(self):
        free(self.derived.marks)
        free(self.derived.numbers)

    @property
    def n_rows(self):
        return self.blocks.n_rows

    @property
    def has_ellipse(self):
        """Whether some contact bounds its two tangents by an ellipse."""
        cdef int32_t i
        for i in range(self.blocks.n_blocks):
            if self.blocks.kind[i] == CONTACT_ELLIPSE:
                return True
        return False

    def with_law(self, int law, b):
        """Return data of the same operator with another friction law (a value of `LAWS`) and right-hand side b (m,) [m/s]."""
        cdef Data other = Data.__new__(Data)
        other.owner = self if self.owner is None else self.owner
        other.keep = [b]
        other.blocks, other.csr, other.rows, other.general = self.blocks, self.csr, self.rows, self.general
        other.blocks.law, other.blocks.islands, other.blocks.b = law, NULL, as_double_pointer(b, self.blocks.n_rows)
        other.factored, other.is_general = self.factored, self.is_general
        other.ready, other.single_rows, other.empty = self.ready, self.single_rows, self.empty
        other._numbers, other._arrays = self._numbers, self._arrays.copy()
        other.reference_energy = other.reference_velocity = other.relative_at_zero = -1.0
        return other

    cdef view_t get_pointers(self) noexcept nogil:
        """Return the problem as structs that point into this object, which must live as long as they are used."""
        cdef view_t v = view_t(self.blocks, NULL, NULL, NULL)
        if self.is_general:
            v.g = &self.general
        elif self.factored:
            v.r = &self.rows
        else:
            v.a = &self.csr
        return v

    def compute_derived_numbers(self):
        """Compute d, nu, step and Y in generalised coordinates, unless they are known."""
        cdef derived_t derived = derived_t(NULL, NULL, 0, 0, NULL, 0, 0, 0.0)
        cdef blocks_t blocks = self.blocks
        cdef generalized_t general = self.general
        cdef int32_t end
        if self.ready:
            return
        end = compute_derived_numbers_of_jacobian(&blocks, &general, &derived)
        if end == DERIVED:
            self.adopt_derived(&derived)
            return
        free(derived.marks)
        free(derived.numbers)
        if end == TOO_MANY:
            raise OverflowError(f"M^-1 J^T has {derived.values:.3g} entries, more than 32-bit indices reach")
        raise MemoryError(f"{derived.values:.3g} entries of M^-1 J^T")

    cdef void adopt_derived(self, derived_t* derived):
        """Take ownership of numbers of `compute_derived_numbers_of_jacobian`; free them if another thread was first."""
        cdef int32_t m = self.blocks.n_rows, i
        empty = _NONE
        if derived.n_empty:
            empty = make_read_only(np.array([i for i in range(m) if derived.empty[i]], np.intp))
        with cython.critical_section(self):
            if self.ready:
                free(derived.marks)
                free(derived.numbers)
                return
            self.empty = empty
            self.derived = derived[0]
            bind_derived_numbers(&self.blocks, &self.general, derived)
            self.ready = True

    cdef object get_derived_array(self, int which):
        """Return d (0), nu (1) or step (2) as a read-only array (m,), which is created at first use."""
        cdef Py_ssize_t m = self.blocks.n_rows, at = which * (m + 1)
        if self._arrays[which] is None:
            out = new(m) if self.is_general else self._numbers[at:at + m]
            if self.is_general:
                memcpy(as_double_pointer(out, m), self.blocks.d + at, m * sizeof(double))
            self._arrays[which] = make_read_only(out)
        return self._arrays[which]

    @property
    def d(self):
        """Diagonal of A with fallbacks (m,) [1/kg]."""
        return self.get_derived_array(0)

    def copy_velocity_weight(self, Data other, bint joints=False):
        """Copy nu from the same problem given by bodies, because A does not distinguish angular from linear rows.

        If `joints` is true, only nu of the rows before the first contact is copied; the contacts may then differ.
        """
        cdef int32_t rows = self.blocks.ptr[other.rows.n_joints] if joints else self.blocks.n_rows
        memcpy(<double*>self.blocks.nu, other.blocks.nu, rows * sizeof(double))
        self._arrays[1] = self._weight = None

    @property
    def nu(self):
        """Velocity weight nu (m,) [1/kg]: velocity error = sqrt(nu d) |e|."""
        return self.get_derived_array(1)

    @property
    def step(self):
        """Array (m,) of the steps of a sweep [kg]."""
        return self.get_derived_array(2)

    @property
    def outside(self):
        """First row with a d above the valid range of core/validate.pxd, or -1 if there is none."""
        return find_invalid_number(self.blocks.d, self.blocks.n_rows)

    @property
    def work(self):
        """Approximate number of multiply-adds of one sweep, by which the caller sizes chunks of sweeps."""
        if self.is_general:
            return 2 * self.general.pval[self.general.n_panels] + 4 * self.blocks.n_rows
        if self.factored:
            of_contacts = self.blocks.n_rows - self.blocks.ptr[self.rows.n_joints]
            return 24 * self.rows.n_joints + 20 * of_contacts + 12 * self.blocks.n_rows
        return self.csr.indptr[self.blocks.n_rows] + 4 * self.blocks.n_rows

    @property
    def weight(self):
        """Weight sqrt(nu d) (m,) [1/kg]: velocity error of a row per N s of e."""
        if self._weight is None:
            self._weight = make_read_only(np.sqrt(self.nu) * np.sqrt(self.d))
        return self._weight

    @property
    def entries_of_matrix(self):
        """Upper bound on the entries of A, from J and M: rows on the same tree are coupled; rows on two trees count twice."""
        cdef const generalized_t* g = &self.general
        cdef double[::1] on = np.zeros(g.n + 1)         # at the root of each tree, the number of its rows
        cdef int32_t b, q
        cdef double out = 0.0
        for b in range(g.n_panels):
            for q in range(g.pcol[b], g.pcol[b + 1]):
                if g.parent[g.cols[q]] < 0:
                    on[g.cols[q]] += g.prow[b + 1] - g.prow[b]
        for b in range(g.n):
            out += on[b] * on[b]
        return min(out, <double>g.m * g.m)

    @property
    def products_of_matrix(self):
        """Multiply-adds of forming A = Y Y^T from J and M: the sum over columns of Y of (number of entries)^2."""
        cdef const generalized_t* g = &self.general
        cdef double[::1] on = np.zeros(g.n + 1)
        cdef int32_t b, q
        cdef double out = 0.0
        for b in range(g.n_panels):
            for q in range(g.pcol[b], g.pcol[b + 1]):
                on[g.cols[q]] += g.prow[b + 1] - g.prow[b]
        for b in range(g.n):
            out += on[b] * on[b]
        return out

    @property
    def max_bandwidth(self):
        """Upper bound of the half bandwidth of A = Y Y^T: the largest distance of two rows with the same column of Y."""
        cdef const generalized_t* g = &self.general
        cdef int32_t[::1] first = np.full(g.n + 1, -1, np.int32)
        cdef int32_t b, q, band = 0
        for b in range(g.n_panels):
            for q in range(g.pcol[b], g.pcol[b + 1]):
                if first[g.cols[q]] < 0:
                    first[g.cols[q]] = g.prow[b]
                band = max(band, g.prow[b + 1] - 1 - first[g.cols[q]])
        return band

    def whitened(self):
        """Return (data, indices, indptr) of Y (m, n) in generalised coordinates, without zero entries."""
        cdef const generalized_t* g = &self.general
        cdef int32_t b, i, a, nc, at = 0
        cdef const double* y
        indptr_ = np.zeros(self.blocks.n_rows + 1, np.int32)
        indices_ = np.empty(g.pval[g.n_panels], np.int32)
        data_ = np.empty(g.pval[g.n_panels])
        cdef int32_t[::1] indptr = indptr_, indices = indices_
        cdef double[::1] data = data_
        for b in range(g.n_panels):
            nc = g.pcol[b + 1] - g.pcol[b]
            y = g.y + g.pval[b]
            for i in range(g.prow[b], g.prow[b + 1]):
                for a in range(nc):
                    if y[a] != 0.0:
                        indices[at] = g.cols[g.pcol[b] + a]
                        data[at] = y[a]
                        at += 1
                y += nc
                indptr[i + 1] = at
        return data_[:at], indices_[:at], indptr_

    cdef void store_reference(self, const islands_t* islands, const double* start):
        """Store a copy of the islands with their references (or NULL) and the start of `reference_of`, unless known."""
        cdef Py_ssize_t k = self.blocks.n_blocks, m = self.blocks.n_rows
        cdef Workspace numbers, marks
        cdef int32_t* at
        with cython.critical_section(self):
            if self.reference_energy >= 0.0:
                return
            if islands != NULL:
                numbers = allocate_bytes((3 * islands.n + (m if islands.terms != NULL else 0)) * sizeof(double))
                marks = allocate_bytes((2 * k + islands.n + 1) * sizeof(int32_t))
                memcpy(numbers.at, islands.reference, 3 * islands.n * sizeof(double))
                at = <int32_t*>marks.at
                memcpy(at, islands.label, k * sizeof(int32_t))
                memcpy(at + k, islands.order, k * sizeof(int32_t))
                memcpy(at + 2 * k, islands.ptr, (islands.n + 1) * sizeof(int32_t))
                self.islands_at = islands_t(islands.n, at, at + 2 * k, at + k, <double*>numbers.at, NULL)
                if islands.terms != NULL:
                    memcpy(<double*>numbers.at + 3 * islands.n, islands.terms, m * sizeof(double))
                    self.islands_at.terms = <double*>numbers.at + 3 * islands.n
                self.keep += [numbers, marks]
                self.blocks.islands = &self.islands_at
            self.reference_velocity, self.relative_at_zero = start[1], start[2]
            self.reference_energy = start[0]

    def share_reference(self, Data other):
        """Copy islands and references from the same problem in another form, which must know them."""
        cdef double start[3]
        if other is not self:
            start[0], start[1], start[2] = other.reference_energy, other.reference_velocity, other.relative_at_zero
            self.store_reference(other.blocks.islands, start)

    def islands(self):
        """Return (number of islands, island of each block (k,)), as labelled with the references of the zero impulse."""
        cdef const islands_t* islands = self.blocks.islands
        cdef Py_ssize_t k = self.blocks.n_blocks
        label_ = np.zeros(k, np.int32)
        cdef int32_t[::1] label = label_
        if islands == NULL:
            return 1 if k else 0, label_
        memcpy(&label[0], islands.label, k * sizeof(int32_t))
        return islands.n, label_


def make_generalized_data(Blocks blocks, b, Operator operator, compliance, int law):
    """Create the data of a problem by J and M (`operator`); `compute_derived_numbers` derives its numbers.

    law is COULOMB or CONE; b (m,) [m/s], compliance (m,) [1/kg].
    """
    cdef Data data = Data.__new__(Data)
    data.keep = [blocks, b, operator, compliance]
    data.blocks = blocks.at
    data.blocks.law = law
    data.general = operator.g
    data.is_general = True
    data.single_rows = blocks.single_rows
    data.reference_energy = data.reference_velocity = data.relative_at_zero = -1.0
    data.empty, data._arrays = _NONE, [None, None, None]
    data.blocks.b = as_double_pointer(b, blocks.at.n_rows)
    data.general.compliance = as_double_pointer(compliance, blocks.at.n_rows)
    return data


def clip_zero_to_bounds(const double[::1] lower, const double[::1] upper):
    """Return Pi(0) (m,) [N s], zero clipped to the bounds, read-only."""
    cdef Py_ssize_t i, m = lower.shape[0]
    out = np.zeros(m)
    cdef double[::1] x = out
    for i in range(m):
        if lower[i] > 0.0:
            x[i] = lower[i]
        elif upper[i] < 0.0:
            x[i] = upper[i]
    return make_read_only(out)


_NONE = make_read_only(np.empty(0, np.intp))


def multiply_body_jacobian(Data p, const double[:, ::1] v, double[::1] out):
    """Write J v (m,) of a factored problem to `out`, for v (n, 6) [m/s, rad/s]."""
    if p.blocks.n_rows and p.rows.n_bodies:
        multiply_jacobian(&p.blocks, &p.rows, &v[0, 0], &out[0])
    else:
        out[:] = 0.0
