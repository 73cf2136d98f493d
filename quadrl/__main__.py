"""`python -m quadrl` is the command `quadrl`."""

from quadrl.cli import main

main()
