"""Commands of `romandask export`: their names and options, and that a new module is all that a new format needs."""

import importlib
import re
import sys

import pytest
from typer.main import get_command
from typer.testing import CliRunner

import romandask.export
from romandask.cli.export import make_export_app
from romandask.export import sha256sums
from romandask.export.command import declared_commands

COMMANDS = {
    "asdf": ["STORE", "OUT", "--exposure", "--tile", "--band"],
    "coadd-psf": ["STORE", "OUT", "--at", "--band", "--scale"],
    "fits": ["STORE", "OUT", "--survey", "--exposure", "--tile", "--band"],
    "meds": ["STORE", "OUT", "--id", "--cone", "--band", "--size", "--catalog"],
    "moc": ["STORE", "OUT"],
    "obscore": ["STORE", "OUT"],
    "obseq": ["PIPELINE", "OUT", "KEY=VALUE"],
    "page": ["STORE", "OUT"],
    "psf": ["STORE", "OUT", "--exposure"],
    "truth": ["STORE", "OUT"],
}
MADE_UP_FORMAT = '''
"""A format for this test."""

from __future__ import annotations

from romandask.export.command import export_command, report_written
from romandask.export.options import Folder, TileNames


@export_command("made-up")
def command(out: Folder, tile: TileNames = None) -> None:
    """Write the names of tiles."""
    path = out / "tiles.txt"
    path.write_text(" ".join(tile or []))
    report_written([path], "tiles")
'''


@pytest.fixture
def made_up_format(tmp_path, monkeypatch):
    """A module `made_up` in the package, while the test runs."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "made_up.py").write_text(MADE_UP_FORMAT)
    monkeypatch.setattr(romandask.export, "__path__", [*romandask.export.__path__, str(folder)])
    importlib.invalidate_caches()
    yield
    sys.modules.pop("romandask.export.made_up", None)
    vars(romandask.export).pop("made_up", None)


def parameters(app) -> dict[str, list[str]]:
    """Return the arguments, by the name that the help shows, and the options of each command."""
    return {
        name: [p.opts[0] if p.param_type_name == "option" else p.metavar for p in command.params]
        for name, command in get_command(app).commands.items()
    }


def test_every_format_has_a_command_and_its_options():
    found = parameters(make_export_app())
    assert found == COMMANDS
    assert list(found) == sorted(found)


def test_a_new_format_is_one_new_module(made_up_format, tmp_path):
    app = make_export_app()
    assert parameters(app) == COMMANDS | {"made-up": ["OUT", "--tile"]}
    done = CliRunner().invoke(app, ["made-up", str(tmp_path), "--tile", "a", "--tile", "b"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "tiles.txt").read_text() == "a b"
    assert "wrote tiles to " in done.output
    assert dict(sha256sums.check(tmp_path)) == {"tiles.txt": ""}


def test_a_name_is_declared_once(made_up_format, tmp_path):
    (tmp_path / "modules" / "other.py").write_text(MADE_UP_FORMAT)
    with pytest.raises(ValueError, match="'made-up' is declared twice"):
        declared_commands(romandask.export)


def test_help_and_completion_list_the_commands_with_their_help():
    app = make_export_app()
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    for name, command in get_command(app).commands.items():
        assert re.search(rf"{name} +{re.escape(command.help)}", shown), name
    assert "--help" in shown
    environment = {"_ROMANDASK_COMPLETE": "complete_bash", "COMP_WORDS": "romandask o", "COMP_CWORD": "1"}
    done = CliRunner().invoke(app, [], prog_name="romandask", env=environment)
    assert done.output.split() == ["obscore", "obseq"]
