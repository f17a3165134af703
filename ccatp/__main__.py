"""``python -m ccatp``."""

import sys

from ccatp.cli import main

if __name__ == "__main__":
    sys.exit(main())
