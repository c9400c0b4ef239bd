"""``python -m scgs_warp train ...`` is ``scgs-warp train ...``."""

import sys

from .apps.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
