"""Every command of every page runs, in the order of the pages, on one copy of a finished store."""

import shlex
import shutil

import pytest
from pages import blocks
from typer.testing import CliRunner

from romandask.cli.main import app

COMMANDS = list(
    dict.fromkeys(
        shlex.join(shlex.split(line, comments=True))
        for block in blocks("bash")
        if block.reason is None
        for line in block.commands
    )
)
"""Each once, without its comment."""

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]


@pytest.fixture(scope="module")
def folder(tiny_store, tmp_path_factory):
    """A working directory with a copy of the store: what commands write there is for later commands to read."""
    path = tmp_path_factory.mktemp("commands")
    shutil.copytree(tiny_store, path / "runs" / "tiny")
    yield path
    shutil.rmtree(path)


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_a_page_runs(line, folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(app, shlex.split(line)[1:], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    if line.startswith("romandask run") and "--dry-run" not in line:
        assert "nothing to do" in done.output, "the store is finished: a command that makes units takes too long here"
