"""Makes the fault zoo importable as ``zoo``: a namespace, since test folders are no packages."""

import sys
from pathlib import Path

TESTS = str(Path(__file__).parents[1])
if TESTS not in sys.path:
    sys.path.append(TESTS)
