"""Why two engines, or an engine and the rigid law, make different velocities in one step."""
