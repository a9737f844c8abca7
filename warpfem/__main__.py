"""``python -m warpfem``."""

import sys

from warpfem.cli import main

sys.exit(main())
