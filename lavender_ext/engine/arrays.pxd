"""The flat arrays of LavenderSim: three buffers, one layout.

The complete engine state is stored in one buffer of doubles, one of int32 and one of uint64, allocated by
the caller. `bind_engine_arrays` places the arrays one after the other, so that a host (Python, WebAssembly) needs only the
sizes and three pointers, and a snapshot is a copy of three buffers. An array that the scene does not
need has length 0: no frames for spheres, no tangents without friction, no joint rows without joints.

Bodies are in the order of the scene, static ones included. The velocity solve uses the dynamic bodies
only, by their index `dyn` (-1 = static), as core/rows.pxd requires.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers


# size[]: the array sizes that `bind_engine_arrays` needs
cpdef enum:
    N_BODY = 0
    N_DYNAMIC = 1
    N_JOINT = 2
    N_JOINT_ROW = 3
    N_EXCLUDED = 4
    N_BUCKET = 5            # buckets of the hash grid, a power of two; 0: every pair is tested
    N_FRAME = 6             # rotation matrices: n_bodies if the scene has boxes, joints or anisotropic inertia, else 0
    ROWS_PER_CONTACT = 7    # 1 without friction, 3 with, 4 with patch friction, 2 more with rolling friction
    CAP_PAIR = 8
    CAP_CONTACT = 9
    N_SIZES = 10

# head[]: integer state and settings
cpdef enum:
    H_CONTACTS = 0
    H_CONTACT_ROWS = 1
    H_PAIRS = 2
    H_PAIRS_VALID = 3       # 0: the pair list must be rebuilt
    H_MATCHES = 4
    H_CACHED = 5            # contacts in the cache
    H_ITERATIONS = 6
    H_WARM_START = 7
    H_POSITION_ITERATIONS = 8
    H_ORDER = 9
    H_SEED = 10
    H_STEP = 11             # completed substeps; wraps around to 0
    H_NEED_PAIRS = 12
    H_NEED_CONTACTS = 13
    H_REBUILDS = 14
    H_PROJECTED = 15        # position sweeps done in the last substep
    H_LOST = 16             # first body with a state that is not finite, or -1
    H_SOLVED = 17           # 1: the arrays hold the last substep's problem and its impulses
    H_FRICTION_SHAPE = 18   # 1: each tangent is bounded separately (box friction)
    H_SUBSTEPS = 19         # substeps of a step
    H_PHASE = 20            # substeps that the present step has done; 0: the next one builds all contacts anew, but see H_KEPT
    H_REBUILT = 21          # 1: the last substep built contacts anew; 0: it kept the rows of the substep before
    H_KEPT = 22             # 1: the first substep of the next step keeps contacts, as the others do
    N_HEAD = 24

# H_ORDER: sweep order of the blocks; joints and contacts are ordered separately
cpdef enum:
    AS_GIVEN = 0
    REVERSED = 1
    SYMMETRICALLY = 2
    AT_RANDOM = 3
    BOTTOM_UP = 4
    TOP_DOWN = 5
    COLORED = 6
    ALTERNATING = 7         # as given; in odd substeps contacts are built from the last pair to the first
    COLORED_PAIRS = 8       # colour by colour, all contacts of a pair in one colour; in odd substeps reversed

# setting[]: real settings; the engine writes the entries from S_OUT to S_JOINT_ERROR
cpdef enum:
    S_H = 0                 # s, substep
    S_GRAVITY = 1           # m/s^2, three
    S_SLOP = 4              # m
    S_MARGIN = 5            # m, a contact is built if its gap is below this
    S_SKIN = 6              # m, additional size of the bounding boxes of the pair list
    S_BETA = 7              # -, fraction of the position error removed per substep
    S_MAX_PUSH = 8          # m, largest position error corrected per substep
    S_BOUNCE = 9            # m/s, restitution is 0 at closing speeds below this
    S_MATCH = 10            # m, a cached contact farther away than this is not reused
    S_OUT = 11              # eight solver statistics, see engine/substep.pyx
    S_DEPTH = 19            # m, deepest penetration
    S_JOINT_ERROR = 20      # m or rad, largest joint error
    S_ROLLING = 21          # m, mu_r of every contact with friction
    S_JOINT_GIVE = 22       # -, compliance of rigid joints in closed loops, relative to the mean d of their rows
    S_RECYCLE = 23          # m, contacts of bodies that move less are kept over steps; 0: they are built anew in each step
    N_SETTINGS = 24

# The broad phase stops if more than MAX_PAIRS boxes overlap; it then reports PAIR_COUNT_OVERFLOW as the needed capacity.
cpdef enum:
    MAX_PAIRS = 16777216
    PAIR_COUNT_OVERFLOW = 2147483647

# status of a substep
cpdef enum:
    OK = 0
    NEED_CAPACITY = 1           # H_NEED_PAIRS and H_NEED_CONTACTS hold the needed capacities; the state is unchanged
    NOT_FINITE = 2          # H_LOST holds the body

# shapes
cpdef enum:
    NO_SHAPE = 0
    PLANE = 1
    SPHERE = 2
    BOX = 3

# joints
cpdef enum:
    DISTANCE = 0
    BALL = 1
    HINGE = 2

# joint parameters, in doubles
cpdef enum:
    J_ANCHOR_A = 0          # m, in the frame of a, three
    J_ANCHOR_B = 3          # m, in the frame of b, three
    J_AXIS_A = 6            # -, unit, in the frame of a, three
    J_AXIS_B = 9            # -, unit, in the frame of b, three
    J_SIDE_A = 12           # -, unit, normal to the axis, in the frame of a, three
    J_LENGTH = 15           # m
    J_HERTZ = 16            # 1/s, 0 = rigid
    J_DAMPING = 17          # -, damping ratio
    J_SPEED = 18            # rad/s, motor speed of b relative to a
    J_TORQUE = 19           # N m, maximum motor torque
    J_LOOP = 20             # -, 1 if the joint is rigid and in a closed loop of rigid joints, else 0
    N_JOINT_REAL = 21

# arrays in each buffer
cdef enum:
    N_REAL_ARRAYS = 48
    N_INDEX_ARRAYS = 23
    N_KEY_ARRAYS = 3

# entries of a cached contact impulse: normal, friction as a world vector (3), spin
cpdef enum:
    N_CACHE_IMPULSE = 5


cdef struct engine_t:
    const int32_t* size
    # The buffer of doubles, in order: `lav_engine_offsets` iterates over these fields.
    double* setting         # (N_SETTINGS)
    double* x               # (n, 3) m
    double* q               # (n, 4) unit quaternion w, x, y, z
    double* v               # (n, 6) m/s, rad/s
    double* inv_mass_body   # (n) 1/kg, 0 = static
    double* inertia         # (n, 9) kg m^2, in the body's frame
    double* inv_inertia_body  # (n, 9) 1/(kg m^2), in the body's frame
    double* shape           # (n, 4) m: plane normal and offset, sphere radius, box half extents
    double* friction        # (n) -
    double* restitution     # (n) -
    double* patch           # (n) m
    double* rot             # (N_FRAME, 9) body to world
    double* fat             # (n, 6) m, enlarged bounding box of the pair list: lower, upper corner
    double* joint           # (kj, N_JOINT_REAL)
    double* joint_error     # (mj) m or rad
    double* jac             # (mj, 12)
    double* minv_jac        # (mj, 12)
    double* joint_impulse   # (mj) N s, N m s
    double* inv_mass        # (nd) 1/kg
    double* inv_inertia     # (nd, 9) 1/(kg m^2), world
    double* v_free          # (nd, 6) m/s, rad/s
    double* dv              # (nd, 6) m/s, rad/s
    double* shift           # (nd, 6) m, rad: displacement of the position projection
    double* point           # (c, 3) m
    double* gap             # (c) m, negative = penetration
    double* normal          # (c, 3)
    double* tangent         # (c, 3), absent without friction
    double* arm_a           # (c, 3) m
    double* arm_b           # (c, 3) m
    double* coupling        # (c, 5) 1/kg, absent without friction
    double* inv_inertia_arm           # (contact rows, 6) 1/(kg m)
    double* local           # (c, 6) m, arms in the frames of a and b
    double* cache_impulse   # (c, N_CACHE_IMPULSE) N s, N m s
    double* cache_local     # (c, 6) m
    double* push            # (c + mj) N s / s: multipliers of the position projection
    double* target          # (m) m/s
    double* lower           # (mj) N s, joint rows only
    double* upper           # (mj) N s
    double* b               # (m) m/s
    double* d               # (m) 1/kg
    double* step            # (m) kg
    double* compliance      # (m) 1/kg
    double* impulse         # (m) N s, N m s
    double* mu              # (kj + c)
    double* patch_radius    # (kj + c) m
    double* rolling         # (kj + c) m, absent without rolling friction
    double* cache_roll      # (c, 3) N m s, world; absent without rolling friction
    double* moved           # (n) m, path of the surface of a body since its contacts were built
    # The buffer of int32, in order: `lav_engine_offsets` iterates over these fields.
    int32_t* head           # (N_HEAD)
    int32_t* kind_of_shape  # (n)
    int32_t* dyn            # (n) index among the dynamic bodies, -1 = static
    int32_t* uneven         # (n) 1 if the inertia is anisotropic
    int32_t* body_of        # (nd) body index of each dynamic body
    int32_t* joint_kind     # (kj)
    int32_t* joint_motor    # (kj) 0 or 1
    int32_t* joint_bodies   # (kj, 2) bodies, -1 = the world
    int32_t* excluded       # (N_EXCLUDED, 2) body pairs that never collide, sorted
    int32_t* pair           # (CAP_PAIR, 2) bodies a < b, sorted
    int32_t* pair_scratch   # (CAP_PAIR, 2)
    int32_t* count          # (n + 1)
    int32_t* bucket         # (N_BUCKET) first body of the chain
    int32_t* chain          # (n) next body of the chain
    int32_t* cell           # (n, 4) cell and level
    int32_t* contact_pair   # (c, 2) bodies
    int32_t* joint_body     # (kj, 2) dynamic indices, -1 = static; contact_body follows
    int32_t* contact_body   # (c, 2) dynamic indices; directly after joint_body, so that joint_body covers all blocks
    int32_t* ptr            # (kj + c + 1)
    int32_t* kind           # (kj + c)
    int32_t* order          # (kj + c) sweep order of the blocks
    int32_t* order_scratch  # (2 (n + kj + c) + 8): level of each body, level of each block, sorting scratch
    int32_t* due            # (n) 1 if the contacts of a body are built anew in the next substep
    # The buffer of uint64, in order: `lav_engine_offsets` iterates over these fields.
    uint64_t* key           # (c)
    uint64_t* cache_key     # (c)
    uint64_t* color_scratch  # (nd)


cdef inline void bind_engine_arrays(const int32_t* size, double* real, int32_t* index, uint64_t* keys, engine_t* e,
                                    int64_t* used) noexcept nogil:
    """Point every array of `e` into the three buffers; `used` (3) receives the number of entries of each buffer."""
    cdef int64_t n = size[N_BODY], nd = size[N_DYNAMIC], kj = size[N_JOINT], mj = size[N_JOINT_ROW]
    cdef int64_t c = size[CAP_CONTACT], p = size[CAP_PAIR], k = kj + c, m = mj + c * size[ROWS_PER_CONTACT]
    cdef int64_t frames = size[N_FRAME], nt = c if size[ROWS_PER_CONTACT] > 1 else 0
    cdef int64_t rolls = 1 if size[ROWS_PER_CONTACT] > 4 else 0
    cdef int64_t grid = n if size[N_BUCKET] > 0 else 0, n_excluded = size[N_EXCLUDED]
    cdef arena_t a = make_arena(real, index)
    e.size = size
    e.setting = take_doubles(&a, N_SETTINGS)
    e.x = take_doubles(&a, 3 * n)
    e.q = take_doubles(&a, 4 * n)
    e.v = take_doubles(&a, 6 * n)
    e.inv_mass_body = take_doubles(&a, n)
    e.inertia = take_doubles(&a, 9 * n)
    e.inv_inertia_body = take_doubles(&a, 9 * n)
    e.shape = take_doubles(&a, 4 * n)
    e.friction = take_doubles(&a, n)
    e.restitution = take_doubles(&a, n)
    e.patch = take_doubles(&a, n)
    e.rot = take_doubles(&a, 9 * frames)
    e.fat = take_doubles(&a, 6 * n)
    e.joint = take_doubles(&a, N_JOINT_REAL * kj)
    e.joint_error = take_doubles(&a, mj)
    e.jac = take_doubles(&a, 12 * mj)
    e.minv_jac = take_doubles(&a, 12 * mj)
    e.joint_impulse = take_doubles(&a, mj)
    e.inv_mass = take_doubles(&a, nd)
    e.inv_inertia = take_doubles(&a, 9 * nd)
    e.v_free = take_doubles(&a, 6 * nd)
    e.dv = take_doubles(&a, 6 * nd)
    e.shift = take_doubles(&a, 6 * nd)
    e.point = take_doubles(&a, 3 * c)
    e.gap = take_doubles(&a, c)
    e.normal = take_doubles(&a, 3 * c)
    e.tangent = take_doubles(&a, 3 * nt)
    e.arm_a = take_doubles(&a, 3 * c)
    e.arm_b = take_doubles(&a, 3 * c)
    e.coupling = take_doubles(&a, 5 * nt)
    e.inv_inertia_arm = take_doubles(&a, 6 * (m - mj))
    e.local = take_doubles(&a, 6 * c)
    e.cache_impulse = take_doubles(&a, N_CACHE_IMPULSE * c)
    e.cache_local = take_doubles(&a, 6 * c)
    e.push = take_doubles(&a, mj + c)
    e.target = take_doubles(&a, m)
    e.lower = take_doubles(&a, mj)
    e.upper = take_doubles(&a, mj)
    e.b = take_doubles(&a, m)
    e.d = take_doubles(&a, m)
    e.step = take_doubles(&a, m)
    e.compliance = take_doubles(&a, m)
    e.impulse = take_doubles(&a, m)
    e.mu = take_doubles(&a, k)
    e.patch_radius = take_doubles(&a, k)
    e.rolling = take_doubles(&a, k * rolls)
    e.cache_roll = take_doubles(&a, 3 * c * rolls)
    e.moved = take_doubles(&a, n)
    e.head = take_integers(&a, N_HEAD)
    e.kind_of_shape = take_integers(&a, n)
    e.dyn = take_integers(&a, n)
    e.uneven = take_integers(&a, n)
    e.body_of = take_integers(&a, nd)
    e.joint_kind = take_integers(&a, kj)
    e.joint_motor = take_integers(&a, kj)
    e.joint_bodies = take_integers(&a, 2 * kj)
    e.excluded = take_integers(&a, 2 * n_excluded)
    e.pair = take_integers(&a, 2 * p)
    e.pair_scratch = take_integers(&a, 2 * p)
    e.count = take_integers(&a, n + 1)
    e.bucket = take_integers(&a, size[N_BUCKET])
    e.chain = take_integers(&a, grid)
    e.cell = take_integers(&a, 4 * grid)
    e.contact_pair = take_integers(&a, 2 * c)
    e.joint_body = take_integers(&a, 2 * k)
    e.contact_body = e.joint_body + 2 * kj
    e.ptr = take_integers(&a, k + 1)
    e.kind = take_integers(&a, k)
    e.order = take_integers(&a, k)
    e.order_scratch = take_integers(&a, 2 * (n + k) + 8)
    e.due = take_integers(&a, n)
    e.key = keys
    e.cache_key = keys + c
    e.color_scratch = keys + 2 * c
    used[0], used[1], used[2] = a.n_real, a.n_index, 2 * c + nd
