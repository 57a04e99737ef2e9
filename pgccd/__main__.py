"""`pgccd` and `python -m pgccd`: see `pgccd.cli`."""

import signal
import sys

from pgccd.cli import main


def run() -> int:
    """Runs the command line of this process. Returns the exit code."""
    if sys.argv[1:2] != ["simulate"] and hasattr(signal, "SIGPIPE"):
        # End silently if the output is no longer read (`| head`). Not in simulations, whose ranks have connections.
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    return main()


if __name__ == "__main__":
    sys.exit(run())
