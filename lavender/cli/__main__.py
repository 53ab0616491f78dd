"""Run the command line: `python -m lavender.cli`."""

from lavender.cli.entry import main

main()
