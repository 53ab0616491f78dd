"""Define the exit codes of all commands; the table of docs/commands.md has the same codes and words."""

EXIT_UNMET = 1
EXIT_BAD_INPUT = 2
EXIT_INFEASIBLE = 3
EXIT_INTERRUPTED = 130
EXIT_CODES = {
    0: "completed",
    EXIT_UNMET: "completed, but a problem is not solved, a check failed, a run diverged, a step or a file "
    "is left out, or too few steps have contact",
    EXIT_BAD_INPUT: "invalid input",
    EXIT_INFEASIBLE: "`solve`: the problem is infeasible, with a certificate that the judge confirms",
    EXIT_INTERRUPTED: "stopped by Ctrl-C; the results of the completed work are written",
}
