"""Write the golden results: ``python -m tests.golden``."""

import json
import tempfile
from pathlib import Path

from tests.golden.cases import CASES, HERE, PUBLISHED

for name, case in {**CASES, **PUBLISHED}.items():
    with tempfile.TemporaryDirectory() as scratch:
        text = json.dumps(case(Path(scratch)), indent=1)
    (HERE / f"{name}.json").write_text(text + "\n", encoding="utf-8")
