"""What measures lavender itself; not part of the package. `python -m benchmarks` lists the commands.

A command is one file: what is measured, a dataclass for each line of the result, the table, the options. Tables are
markdown and files JSON, made by `benchmarks.output` alone.
"""
