"""The problem of one block solved exactly, and the sweeps that do so block by block."""
