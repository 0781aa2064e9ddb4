"""`python -m cqrun` is the `cqrun` command."""

from cqrun.cli.start import main

main()
