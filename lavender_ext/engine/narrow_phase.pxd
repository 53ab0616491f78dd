"""The narrow phase: contact manifolds of at most four points between planes, spheres and boxes.

The normal points from a to b. A point lies halfway between the two surfaces; its gap is the distance
between them along the normal [m], negative if they overlap. Points with a gap up to the margin are kept
(speculative contacts). Each has a feature number that stays the same while the same corners and
faces touch:

    plane-box       the box's corner; bit k is set if its coordinate along axis k is positive
    box-box, faces  reference face (4 bits), other face (3 bits), and the two lines that intersect in the
                    point (3 bits each): 0-3 edges of the other face, 4-7 sides of the reference face
    box-box, edges  8192 + the two axes and four signs that identify the edges

Box-box: the axis of least penetration among 3 + 3 face normals and 9 cross products (Gottschalk, Lin,
Manocha 1996). Within a tolerance, faces are preferred to edges and faces of a to faces of b, so that a
resting pair keeps its manifold. The incident face, the one most antiparallel to the reference face, is clipped by the
four sides of the reference face (Sutherland, Hodgman 1974).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.validate cimport min_magnitude
from lavender_ext.core.rows cimport cross, dot3
from lavender_ext.engine.arrays cimport BOX, PLANE, SPHERE, engine_t
from lavender_ext.engine.bodies cimport rotate_to_body, rotate_to_world
from lavender_ext.core.vectors cimport copy_column3, copy3, subtract3, add_scaled3, scale3


cdef struct manifold_t:
    int32_t n
    int32_t feature[4]
    double normal[3]
    double point[12]
    double gap[4]


cdef inline void collide_sphere_sphere(const double* xa, double ra, const double* xb, double rb, double margin,
                                       manifold_t* m) noexcept nogil:
    """Compute the manifold m of two spheres with centres xa, xb (3) and radii ra, rb [m]; empty beyond the margin."""
    cdef double d[3]
    cdef double s, f
    cdef int32_t k
    subtract3(xb, xa, d)
    s = dot3(d, d)
    if s > (ra + rb + margin) * (ra + rb + margin):
        return
    s = sqrt(s)
    if s > min_magnitude():
        for k in range(3):
            m.normal[k] = d[k] / s
    else:                                               # The spheres are concentric: use a fixed normal.
        s = m.normal[0] = m.normal[1] = 0.0
        m.normal[2] = 1.0
    f = 0.5 * (ra - rb + s)                             # The point is halfway between the surfaces.
    add_scaled3(xa, f, m.normal, m.point)
    m.gap[0] = s - ra - rb
    m.feature[0] = 0
    m.n = 1


cdef inline void collide_plane_sphere(const double* plane, const double* x, double r, double margin,
                                      manifold_t* m) noexcept nogil:
    """Compute the manifold m of a plane (normal, offset) and a sphere with centre x (3) and radius r [m]."""
    cdef double gap = dot3(plane, x) - plane[3] - r
    if gap > margin:
        return
    copy3(plane, m.normal)
    add_scaled3(x, -(r + 0.5 * gap), plane, m.point)
    m.gap[0] = gap
    m.feature[0] = 0
    m.n = 1


cdef inline void collide_plane_box(const double* plane, const double* x, const double* rot, const double* half, double margin,
                                   manifold_t* m) noexcept nogil:
    """Compute the manifold m of a plane and a box: the four corners with the smallest gaps g + sum +-p_k.

    Of equal gaps, the lower corner number is taken first.
    """
    cdef double p[3]
    cdef double gap[8]
    cdef double low, g = dot3(plane, x) - plane[3]
    cdef int32_t i, _j, k, best, selected = 0
    rotate_to_body(rot, plane, p)
    # early out: the lowest corner is above the margin
    low = g
    for k in range(3):
        p[k] *= half[k]
        low -= fabs(p[k])
    if low > margin:
        return
    for i in range(8):
        gap[i] = g + (p[0] if i & 1 else -p[0]) + (p[1] if i & 2 else -p[1]) + (p[2] if i & 4 else -p[2])
    copy3(plane, m.normal)
    # select the four lowest corners
    for _j in range(4):
        best = -1
        for i in range(8):
            if not (selected >> i) & 1 and gap[i] <= margin and (best < 0 or gap[i] < gap[best]):
                best = i
        if best < 0:
            break
        selected |= 1 << best
    # build the points in corner order
    m.n = 0
    for i in range(8):
        if (selected >> i) & 1:
            for k in range(3):
                m.point[3 * m.n + k] = (x[k] + (half[0] if i & 1 else -half[0]) * rot[3 * k]
                                        + (half[1] if i & 2 else -half[1]) * rot[3 * k + 1]
                                        + (half[2] if i & 4 else -half[2]) * rot[3 * k + 2]
                                        - 0.5 * gap[i] * plane[k])
            m.gap[m.n] = gap[i]
            m.feature[m.n] = i
            m.n += 1


cdef inline void collide_box_sphere(const double* xa, const double* rot, const double* half, const double* xb, double r,
                                    double margin, manifold_t* m) noexcept nogil:
    """Compute the manifold m of a box (centre xa, axes rot, half extents) and a sphere (centre xb, radius r [m])."""
    cdef double d[3]
    cdef double c[3]
    cdef double near[3]
    cdef double s, best
    cdef int32_t k, axis = -1
    subtract3(xb, xa, d)
    rotate_to_body(rot, d, c)
    # closest point of the box to the sphere's centre, in the box's frame
    s = 0.0
    for k in range(3):
        near[k] = -half[k] if c[k] < -half[k] else (half[k] if c[k] > half[k] else c[k])
        d[k] = c[k] - near[k]
        s += d[k] * d[k]
    if s > (r + margin) * (r + margin):
        return
    if s > min_magnitude() * min_magnitude():
        s = sqrt(s)
        for k in range(3):
            d[k] = d[k] / s
    else:                                               # The centre is inside: separate along the nearest face's normal.
        best = -1.0 / 0.0
        for k in range(3):
            if fabs(c[k]) - half[k] > best:
                best = fabs(c[k]) - half[k]
                axis = k
        for k in range(3):
            d[k] = 0.0
        d[axis] = -1.0 if c[axis] < 0.0 else 1.0
        near[axis] = d[axis] * half[axis]
        s = best
    m.gap[0] = s - r
    rotate_to_world(rot, d, m.normal)
    add_scaled3(near, 0.5 * m.gap[0], d, c)
    rotate_to_world(rot, c, m.point)
    add_scaled3(xa, 1.0, m.point, m.point)
    m.feature[0] = 0
    m.n = 1


cdef inline int32_t clip_polygon_to_side(int32_t n, const double* p, const int32_t* code, int32_t axis, double sign,
                                         double bound, double tol, int32_t line, double* out, int32_t* out_code) noexcept nogil:
    """Clip the polygon p (n, 3) against sign * p[axis] <= bound and return the number of points left.

    code[i] identifies the edge from point i to i + 1, `line` the clipping side. A corner within tol of the side
    counts as inside, so that a pair with aligned edges keeps its corners.
    """
    cdef int32_t i, j, n_out = 0
    cdef double a, b, t
    cdef double edge[3]
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        a = sign * p[3 * i + axis] - bound
        b = sign * p[3 * j + axis] - bound
        if a <= tol:
            copy3(p + 3 * i, out + 3 * n_out)
            out_code[n_out] = code[i]
            n_out += 1
        if (a <= tol) != (b <= tol):
            t = a / (a - b)
            t = 0.0 if t < 0.0 else (1.0 if t > 1.0 else t)
            subtract3(p + 3 * j, p + 3 * i, edge)
            add_scaled3(p + 3 * i, t, edge, out + 3 * n_out)
            # leaving the half-space, the outline continues on the clipping side; entering, on its own edge
            out_code[n_out] = line if a <= tol else code[i]
            n_out += 1
    return n_out


cdef inline void select_four_contact_points(const double* p, int32_t kept, double margin, int32_t* pick) noexcept nogil:
    """Select the outermost points along four directions, skewed so that the corners of a square do not tie.

    If the deepest point is not among them, it replaces the nearest selected point.
    """
    cdef double s, best, deep
    cdef int32_t i, j, at, other
    for i in range(4):
        best = -1.0 / 0.0
        pick[i] = 0
        for j in range(kept):
            if i & 1:
                s = p[3 * j + 1] - 0.3 * p[3 * j]
            else:
                s = p[3 * j] + 0.3 * p[3 * j + 1]
            if i < 2:
                s = -s
            if s > best:
                best = s
                pick[i] = j
    at = 0
    for j in range(kept):
        if p[3 * j + 2] < p[3 * at + 2]:
            at = j
    deep = 1.0 / 0.0
    for i in range(4):
        if p[3 * pick[i] + 2] < deep:
            deep = p[3 * pick[i] + 2]
    if p[3 * at + 2] < deep - 1e-3 * margin:
        best = 1.0 / 0.0
        other = 0
        for i in range(4):
            s = (p[3 * pick[i]] - p[3 * at]) * (p[3 * pick[i]] - p[3 * at])
            s += (p[3 * pick[i] + 1] - p[3 * at + 1]) * (p[3 * pick[i] + 1] - p[3 * at + 1])
            if s < best:
                best = s
                other = i
        pick[other] = at


cdef inline void transform_to_face_frame(const double* along_x, const double* along_y, const double* along_z, const double* a,
                                         double* out) noexcept nogil:
    """Transform a world vector to the frame of a face."""
    out[0] = dot3(a, along_x)
    out[1] = dot3(a, along_y)
    out[2] = dot3(a, along_z)


cdef inline void build_face_manifold(const double* xr, const double* rr, const double* hr, int32_t axis, double sign,
                                     const double* xo, const double* ro, const double* ho, int32_t on_b, double margin,
                                     manifold_t* m) noexcept nogil:
    """Build a face manifold: clip the other box's incident face by the reference face.

    The reference face of the box (xr, rr, hr) is given by `axis` and `sign`; x, y, n are the axes of its frame.
    on_b: the reference face belongs to b.
    """
    cdef double poly[36]
    cdef double more[36]
    cdef int32_t code[12]
    cdef int32_t more_code[12]
    cdef double x[3]
    cdef double y[3]
    cdef double n[3]
    cdef double c[3]
    cdef double u[3]
    cdef double w[3]
    cdef double s, best, hx, hy, tol
    cdef int32_t i, j, k, ax = axis + 1 if axis < 2 else 0, ay = axis - 1 if axis > 0 else 2
    cdef int32_t face = 0, fx, fy, count, kept, at, feature
    cdef int32_t pick[4]
    hx = hr[ax]
    hy = hr[ay]
    copy_column3(rr, ax, x)
    copy_column3(rr, ay, y)
    copy_column3(rr, axis, n)
    scale3(sign, n, n)
    # incident face: the other box's face most antiparallel to n
    rotate_to_body(ro, n, u)
    best = -1.0
    for i in range(3):
        if fabs(u[i]) > best:
            best = fabs(u[i])
            face = i
    fx = face + 1 if face < 2 else 0
    fy = face - 1 if face > 0 else 2
    s = -ho[face] if u[face] > 0.0 else ho[face]
    # corners of the incident face in the frame of the reference face, from its centre and half edges
    subtract3(xo, xr, u)
    copy_column3(ro, face, c)
    add_scaled3(u, s, c, c)
    transform_to_face_frame(x, y, n, c, w)
    w[2] -= hr[axis]
    for i in range(2):
        j = fx if i == 0 else fy
        copy_column3(ro, j, c)
        scale3(ho[j], c, c)
        transform_to_face_frame(x, y, n, c, more + 3 * i)
    for k in range(3):
        poly[k] = w[k] - more[k] - more[3 + k]
        poly[3 + k] = w[k] + more[k] - more[3 + k]
        poly[6 + k] = w[k] + more[k] + more[3 + k]
        poly[9 + k] = w[k] - more[k] + more[3 + k]
    for i in range(4):
        code[i] = i
    count = 4
    tol = 1e-3 * (hx if hx < hy else hy)
    # clip by each side of the reference face that a corner is outside of
    for i in range(4):
        k = i >> 1
        s = 1.0 if i & 1 else -1.0
        best = hx if k == 0 else hy
        kept = 0
        for j in range(count):
            if s * poly[3 * j + k] - best > tol:
                kept += 1
        if kept == 0:
            continue
        kept = clip_polygon_to_side(count, poly, code, k, s, best, tol, 4 + i, more, more_code)
        count = kept
        for j in range(count):
            code[j] = more_code[j]
            copy3(more + 3 * j, poly + 3 * j)
    # drop points above the margin; a point's feature is the pair of lines before and after it
    kept = 0
    for i in range(count):
        if poly[3 * i + 2] <= margin:
            j = code[i - 1] if i > 0 else code[count - 1]
            more_code[kept] = j * 8 + code[i]
            copy3(poly + 3 * i, more + 3 * kept)
            kept += 1
    # reduce to four points
    if kept > 4:
        select_four_contact_points(more, kept, margin, pick)
    else:
        for i in range(kept):
            pick[i] = i
        for i in range(kept, 4):
            pick[i] = pick[0] if kept > 0 else 0
    feature = (((on_b * 8 + axis * 2 + (sign > 0.0)) * 8) + face) * 64
    m.n = 0
    # reorder from counter-clockwise to row by row, like the corners of a box
    if kept >= 4:
        i = pick[2]
        pick[2] = pick[3]
        pick[3] = i
    # build the points, skipping duplicates
    for i in range(4 if kept > 4 else kept):
        at = pick[i]
        for j in range(i):
            if pick[j] == at:
                at = -1
                break
        if at < 0:
            continue
        s = hr[axis] + 0.5 * more[3 * at + 2]
        add_scaled3(xr, more[3 * at], x, u)
        add_scaled3(u, more[3 * at + 1], y, u)
        add_scaled3(u, s, n, m.point + 3 * m.n)
        m.gap[m.n] = more[3 * at + 2]
        m.feature[m.n] = feature + more_code[at]
        m.n += 1
    scale3(-1.0 if on_b else 1.0, n, m.normal)


cdef inline int32_t find_support_edge_centre(const double* x, const double* rot, const double* half, int32_t axis,
                                             const double* n, double sign, double* out) noexcept nogil:
    """Compute the centre of the edge along `axis` that is farthest along sign n; return two bits that identify it."""
    cdef double side[3]
    cdef double u[3]
    cdef int32_t r, bits = 0
    rotate_to_body(rot, n, u)
    copy3(x, out)
    for r in range(3):
        if r != axis:
            bits = bits * 2 + (u[r] > 0.0)
            copy_column3(rot, r, side)
            add_scaled3(out, sign * (half[r] if u[r] > 0.0 else -half[r]), side, out)
    return bits


cdef inline void build_edge_manifold(const double* xa, const double* ra, const double* ha, int32_t i, const double* xb,
                                     const double* rb, const double* hb, int32_t j, double* n, double gap,
                                     manifold_t* m) noexcept nogil:
    """Build an edge manifold from the closest points of the edges along axis i of a and axis j of b."""
    cdef double p[3]
    cdef double q[3]
    cdef double d[3]
    cdef double along_a[3]
    cdef double along_b[3]
    cdef double u, v, w, s, t
    cdef int32_t bits
    bits = 4 * find_support_edge_centre(xa, ra, ha, i, n, 1.0, p)
    bits += find_support_edge_centre(xb, rb, hb, j, n, -1.0, q)
    subtract3(q, p, d)
    copy_column3(ra, i, along_a)
    copy_column3(rb, j, along_b)
    u = dot3(along_a, along_b)
    v = dot3(along_a, d)
    w = dot3(along_b, d)
    s = (v - u * w) / (1.0 - u * u)
    t = (u * v - w) / (1.0 - u * u)
    s = -ha[i] if s < -ha[i] else (ha[i] if s > ha[i] else s)
    t = -hb[j] if t < -hb[j] else (hb[j] if t > hb[j] else t)
    add_scaled3(p, s, along_a, p)
    add_scaled3(p, 1.0, q, p)
    add_scaled3(p, t, along_b, p)
    scale3(0.5, p, m.point)
    copy3(n, m.normal)
    m.gap[0] = gap
    m.feature[0] = 8192 + (i * 3 + j) * 16 + bits
    m.n = 1


cdef inline void collide_box_box(const double* xa, const double* ra, const double* ha, const double* xb, const double* rb,
                                 const double* hb, double margin, manifold_t* m) noexcept nogil:
    """Compute the manifold m of two boxes: separating axis test, then a face or edge manifold on the axis of least penetration."""
    cdef double c[9]            # R_a^T R_b
    cdef double f[9]            # |c|
    cdef double d[3]
    cdef double ta[3]
    cdef double tb[3]
    cdef double n[3]
    cdef double l[3]
    cdef double s, t, length, face_a = -1.0 / 0.0, face_b = -1.0 / 0.0, edge = -1.0 / 0.0, tol, best, small
    cdef int32_t i, j, k, i1, i2, j1, j2, axis_a = 0, axis_b = 0, edge_i = -1, edge_j = -1, parallel = 0
    subtract3(xb, xa, d)
    rotate_to_body(ra, d, ta)
    rotate_to_body(rb, d, tb)
    for i in range(3):
        for j in range(3):
            s = ra[i] * rb[j] + ra[3 + i] * rb[3 + j] + ra[6 + i] * rb[6 + j]
            c[3 * i + j] = s
            f[3 * i + j] = fabs(s)
    # face normals of a
    for i in range(3):
        s = fabs(ta[i]) - ha[i] - (f[3 * i] * hb[0] + f[3 * i + 1] * hb[1] + f[3 * i + 2] * hb[2])
        if s > margin:
            return
        if s > face_a:
            face_a = s
            axis_a = i
    # face normals of b
    for j in range(3):
        s = fabs(tb[j]) - hb[j] - (f[j] * ha[0] + f[3 + j] * ha[1] + f[6 + j] * ha[2])
        if s > margin:
            return
        if s > face_b:
            face_b = s
            axis_b = j
    # preference for faces: a thousandth of the smallest half extent
    small = ha[0]
    for k in range(3):
        small = ha[k] if ha[k] < small else small
        small = hb[k] if hb[k] < small else small
    tol = 1e-3 * small
    best = face_a if face_a > face_b else face_b
    # cross products of the edges, unless two axes are parallel within 1 mrad: then they add no separating axis
    for k in range(9):
        if f[k] > 0.9999995:
            parallel = 1
    if not parallel:
        for i in range(3):
            i1 = i + 1 if i < 2 else 0
            i2 = i - 1 if i > 0 else 2
            for j in range(3):
                j1 = j + 1 if j < 2 else 0
                j2 = j - 1 if j > 0 else 2
                length = 1.0 - c[3 * i + j] * c[3 * i + j]
                if length < 1e-6:
                    continue
                # the axis a_i x b_j has the components (0, -c_i2j, c_i1j) along the axes i, i1, i2 of a
                t = ta[i2] * c[3 * i1 + j] - ta[i1] * c[3 * i2 + j]
                s = (fabs(t) - (ha[i1] * f[3 * i2 + j] + ha[i2] * f[3 * i1 + j] + hb[j1] * f[3 * i + j2]
                                + hb[j2] * f[3 * i + j1])) / sqrt(length)
                if s > margin:
                    return
                if s > edge:
                    edge = s
                    edge_i = i
                    edge_j = j
    # manifold on the axis of least penetration
    if edge_i >= 0 and edge > best + tol + 0.05 * fabs(best):
        copy_column3(ra, edge_i, n)
        copy_column3(rb, edge_j, l)
        cross(n, l, m.normal)
        length = sqrt(dot3(m.normal, m.normal))
        s = 1.0 / length if dot3(m.normal, d) >= 0.0 else -1.0 / length
        scale3(s, m.normal, n)
        build_edge_manifold(xa, ra, ha, edge_i, xb, rb, hb, edge_j, n, edge, m)
    elif face_b > face_a + tol + 0.05 * fabs(face_a):
        build_face_manifold(xb, rb, hb, axis_b, -1.0 if tb[axis_b] > 0.0 else 1.0, xa, ra, ha, 1, margin, m)
    else:
        build_face_manifold(xa, ra, ha, axis_a, -1.0 if ta[axis_a] < 0.0 else 1.0, xb, rb, hb, 0, margin, m)


cdef inline void collide_bodies(const engine_t* e, int32_t a, int32_t b, double margin, manifold_t* m) noexcept nogil:
    """Compute the manifold of bodies a < b; m.n = 0 if their gap exceeds the margin."""
    cdef int32_t ka = e.kind_of_shape[a], kb = e.kind_of_shape[b], flip = 0
    cdef const double* xa = e.x + 3 * a
    cdef const double* xb = e.x + 3 * b
    cdef const double* sa = e.shape + 4 * a
    cdef const double* sb = e.shape + 4 * b
    m.n = 0
    if ka == SPHERE and kb == SPHERE:
        collide_sphere_sphere(xa, sa[0], xb, sb[0], margin, m)
        return
    if ka == BOX and kb == BOX:
        collide_box_box(xa, e.rot + 9 * a, sa, xb, e.rot + 9 * b, sb, margin, m)
        return
    if ka > kb if kb == PLANE or ka == PLANE else kb == BOX:     # Exchange the bodies: planes come first, then boxes.
        flip = 1
        a, b = b, a
        ka, kb = kb, ka
        xa, xb = xb, xa
        sa, sb = sb, sa
    if ka == PLANE and kb == SPHERE:
        collide_plane_sphere(sa, xb, sb[0], margin, m)
    elif ka == PLANE and kb == BOX:
        collide_plane_box(sa, xb, e.rot + 9 * b, sb, margin, m)
    elif ka == BOX and kb == SPHERE:
        collide_box_sphere(xa, e.rot + 9 * a, sa, xb, sb[0], margin, m)
    if flip:
        scale3(-1.0, m.normal, m.normal)
