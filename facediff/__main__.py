"""``python -m facediff``."""

import sys

from facediff.cli import main

if __name__ == "__main__":
    sys.exit(main())
