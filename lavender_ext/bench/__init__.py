"""What the machine can do: loops that hold one thing and nothing else."""
