"""The command line as a process of its own: ``lfm-ppl``, or ``python -m lfm_ppl``."""

import gc
import sys

_NEW_OBJECTS = 100_000
"""Number of new objects after which Python looks among them for garbage."""


def main() -> int:
    """Run the command line in this process, which ends after it.

    Libraries that are imported and programs that are traced are millions of small objects which live to the end. By
    default Python looks for garbage among them after every 700 or 2,000 new ones, and among all of them at its end: a
    tenth of the time of a short fit.
    """
    gc.set_threshold(_NEW_OBJECTS, 20, 100)
    from lfm_ppl import cli  # which imports the most

    try:
        return cli.main()
    finally:
        gc.freeze()


if __name__ == "__main__":
    sys.exit(main())
