"""Backends that are called by their own interface, a file each: `call(qp, impulse, limit, settings) -> Answer`.

qpsolvers passes on their iterate, but not what happened: iterations, exit flag, certificates, warm start.
"""
