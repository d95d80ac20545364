"""``python -m facediff``."""

from __future__ import annotations

import sys

from facediff.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
