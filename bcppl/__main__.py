"""`python -m bcppl`."""

from bcppl.cli import main

main()
