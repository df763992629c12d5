"""`python -m softtissue_training` is `softtissue-train`."""

import sys

from softtissue_training.cli import main

if __name__ == "__main__":
    sys.exit(main())
