"""The site builds, and every warning is an error."""

import subprocess
import sys

import pytest
from conftest import ROOT


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*command, "-d", str(tmp_path / "doctrees"), "docs", str(tmp_path / "html")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    pages = {name: (tmp_path / "html" / f"{name}.html").read_text() for name in ("pipelines", "reference/command-line")}
    assert "coadds.pixfrac" in pages["pipelines"], "the settings are generated"
    assert "--retry-failed" in pages["reference/command-line"], "so are the commands"
    for path in (tmp_path / "html").rglob("*.html"):
        assert "TODO" not in path.read_text(), path
