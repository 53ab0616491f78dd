"""Benchmarks of lavender itself, not part of the package. `python -m benchmarks` lists the commands.

Each command is one file with the measurement, a dataclass for the lines of the result, the table and the options.
`benchmarks.output` writes all tables (markdown) and files (JSON).
"""
