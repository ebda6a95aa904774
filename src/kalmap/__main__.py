"""`python -m kalmap`: the same as the command."""

from kalmap.cli.main import main

main()
