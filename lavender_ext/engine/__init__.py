"""LavenderSim's substep: arrays, collision detection, contact and joint rows, solves, projection, integration."""
