"""Entry point of `python -m kornia_tidy`, which runs the command `kornia-tidy`."""

import sys

from kornia_tidy.cli import main

if __name__ == "__main__":
    sys.exit(main())
