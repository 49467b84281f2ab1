"""`python -m fdtasil` is the command line."""

from fdtasil.cli import main

main()
