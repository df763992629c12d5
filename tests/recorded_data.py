"""Where organs and clouds lie that others recorded: tests of them are skipped where they do not."""

import os
from pathlib import Path

RECORDED = Path(os.environ.get("SOFTTISSUE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
PATIENT = RECORDED / "patient"
