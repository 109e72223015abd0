"""`python -m cgid` is the command line."""

from cgid.cli import main

main()
