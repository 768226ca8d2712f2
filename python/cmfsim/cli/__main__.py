"""`python -m cmfsim.cli`: the command line without the installed program."""

import sys

from cmfsim.cli import main

if __name__ == "__main__":
    sys.exit(main())
