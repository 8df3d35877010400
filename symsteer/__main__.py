"""``python -m symsteer`` is the same program as ``symsteer``."""

import sys

from symsteer.cli import main

if __name__ == "__main__":
    sys.exit(main())
