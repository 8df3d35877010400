"""``python -m bench`` is the same program as ``symsteer``."""

import sys

from bench.cli import main

if __name__ == "__main__":
    sys.exit(main())
