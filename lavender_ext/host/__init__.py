"""Functions for programs without Python that contain the engine: solver values, and growth of the buffers."""
