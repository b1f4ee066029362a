"""Run the command line as ``python -m lfm_ppl``."""

import sys

from lfm_ppl.cli import main

if __name__ == "__main__":
    sys.exit(main())
