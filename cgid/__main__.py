"""`python -P -m cgid` is the command line."""

import sys

from cgid.cli import main

sys.exit(main())
