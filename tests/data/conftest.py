"""Makes the fakes importable, in worker processes too (spawned ones get this path)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
