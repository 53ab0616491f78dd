"""Functions for engine hosts without Python: solver values and growth of buffers."""
