"""`python -m wlplan`: the same as the command `wlplan`."""

from wlplan.cli import run

if __name__ == "__main__":
    run()
