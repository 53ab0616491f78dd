"""`python -m lavender`: the command line."""

from lavender.cli import main

main()
