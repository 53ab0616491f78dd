"""What every room stands on: arrays, errors, deadlines, child processes, modules loaded later."""
