"""Code that uses the package type-checks against it: the package is marked as typed."""

import re
import subprocess
import sys

import pytest
from conftest import ROOT

RIGHT = """
import pandas as pd
import xarray as xr
settings: rd.Pipeline = survey.pipeline
sky: xr.Dataset = coadds
table: pd.DataFrame = blends
"""
WRONG = """import romandask as rd
survey = rd.open(3.5)
survey.exposure("roman")
cone = rd.Cone(53.0, -40.0, radius="5")
"""


@pytest.mark.slow
def test_the_python_of_the_readme_type_checks_and_mistakes_do_not(tmp_path):
    block = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)[1]
    (tmp_path / "right.py").write_text(block + RIGHT)
    (tmp_path / "wrong.py").write_text(WRONG)
    command = [sys.executable, "-m", "mypy", "--strict", "--allow-untyped-calls", "--config-file", "", "."]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    assert "right.py" not in said
    for line, code in ((2, "arg-type"), (3, "attr-defined"), (4, "arg-type")):
        assert re.search(rf"wrong.py:{line}: error: .*\[{code}\]", said), said
