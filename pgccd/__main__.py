"""`python -m pgccd`: see `pgccd.cli`."""

import sys

from pgccd.cli import main

sys.exit(main())
