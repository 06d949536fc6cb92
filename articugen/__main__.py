"""`python -m articugen`."""

from articugen.cli import main

main()
