"""`python -m bcppl.cli`."""

from bcppl.cli import main

main()
