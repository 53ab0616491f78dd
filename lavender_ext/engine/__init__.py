"""LavenderSim's substep: its arrays, broad and narrow phase, contacts, joints, projection, integration; Newton."""
