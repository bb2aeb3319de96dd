"""``python -m undulog``: the command."""

from . import main

main()
