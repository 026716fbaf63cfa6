"""List the output hash of every unit of a store, one a line: `python tests/output_hashes.py STORE`.

A change of the code that is to change no output is shown to be one by the same list before and after it.
"""

import json
import sys
from pathlib import Path


def output_hashes(store: Path) -> dict[str, str]:
    """Return the hash of what each unit of a store holds, by stage and unit, from its manifest."""
    records = [json.loads(path.read_text()) for path in (store / "manifest").rglob("*.json")]
    return {f"{record['stage']}/{record['unit']}": record["output"] for record in records}


if __name__ == "__main__":
    for unit, value in sorted(output_hashes(Path(sys.argv[1])).items()):
        print(value, unit)
