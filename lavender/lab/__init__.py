"""Measuring: engines audited over many worlds, and their settings chosen."""
