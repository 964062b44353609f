"""`python -m disctrack` is the command `disctrack`."""

import sys

from disctrack.cli import main

sys.exit(main())
