"""LavenderSim's substep: arrays, collision detection, rows of contacts and joints, solves, projection, integration."""
