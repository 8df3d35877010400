"""``python -m symsteer`` is the same program as ``symsteer``."""

from symsteer.launch import main

if __name__ == "__main__":
    raise SystemExit(main())
