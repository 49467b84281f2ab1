"""`python -m fdtasil` is the command line."""

from fdtasil.shell.main import main

main()
