"""`python -m cqrun` is the `cqrun` command."""

from cqrun.cli.app import main

main()
