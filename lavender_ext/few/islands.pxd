"""How an island ended, for whom solves one."""


cpdef enum:                     # how an island ended
    LEFT = 0                    # it is the caller's
    AT_START = 1                # its start is a solution
    BY_PIVOTS = 2
    BY_SWEEPS = 3
    BY_VELOCITIES = 4
