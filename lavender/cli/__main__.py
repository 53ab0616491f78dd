"""`python -m lavender.cli`: the same as the command `lavender`."""

from lavender.cli.entry import main

main()
