"""`python -m wlplan`: the same as the command `wlplan`."""

import sys

from wlplan.cli import main

if __name__ == "__main__":
    sys.exit(main())
