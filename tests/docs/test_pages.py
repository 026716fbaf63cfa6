"""What the pages name exists: paths, commands and their options."""

import re
import shlex

import pytest
from conftest import ROOT
from pages import PAGES, blocks
from typer.main import get_command

from romandask.cli.main import app

PATH = re.compile(r"`((?:romandask|pipelines|catalogs|docs|tests|\.ci|\.github)/[\w./-]*)`")


@pytest.mark.parametrize("page", PAGES)
def test_paths_of_a_page_exist(page):
    for path in PATH.findall((ROOT / page).read_text()):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PAGES)
def test_links_of_a_page_exist(page):
    for target in re.findall(r"\]\(([\w./-]+)\)", (ROOT / page).read_text()):
        assert ((ROOT / page).parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES)
def test_commands_of_a_page_exist(page, tmp_path, monkeypatch):
    """Commands, options and their values are parsed; nothing is run."""
    monkeypatch.chdir(tmp_path)
    for block in blocks("bash", page):
        for line in block.commands:
            command, words = get_command(app), shlex.split(line, comments=True)[1:]
            while hasattr(command, "commands"):
                assert words[0] in command.commands, line
                command, words = command.commands[words[0]], words[1:]
            command.make_context("romandask", words)


@pytest.mark.parametrize("page", PAGES)
def test_blocks_are_executed_or_say_why_not(page):
    for block in blocks("bash", page):
        if block.reason is None:
            assert block.text.splitlines() == block.commands, "only commands of romandask are executed"
    for kind in ("bash", "python"):
        assert all(block.reason is None or block.reason for block in blocks(kind, page))
    # every fence is one of these: none is missed by its spelling
    fences = re.findall(r"^\s*```(?:bash|sh|shell|python|py)\b.*$", (ROOT / page).read_text(), re.M)
    assert len(fences) == len(blocks("bash", page)) + len(blocks("python", page))
