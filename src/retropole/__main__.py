"""`python -m retropole` is the command `retropole`."""

from .cli import main

main()
