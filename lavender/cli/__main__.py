"""Run `python -m lavender.cli`, which is the command `lavender`."""

from lavender.cli.entry import main

main()
