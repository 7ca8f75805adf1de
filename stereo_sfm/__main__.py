"""`python -m stereo_sfm`: the command line."""

import sys

from stereo_sfm.cli import main

if __name__ == "__main__":
    sys.exit(main())
