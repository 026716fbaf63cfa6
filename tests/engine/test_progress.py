"""Progress: the estimate of the remaining time, output during long activities, and the event log."""

import io
import json
import os
import sys
import threading
import time

import pytest
from conftest import command
from rich.console import Console

from romandask import survey
from romandask.cli.main import main
from romandask.engine import progress
from romandask.engine.event_log import Log, events, newest_event, runs
from romandask.engine.progress import Pace, Reporter, duration
from romandask.export import obseq
from romandask.storage.lock import in_use, locked
from romandask.survey import Survey


def test_the_remaining_time_follows_from_the_cost():
    """The first of four units has nine tenths of the cost and takes 90 s: 10 s are left."""
    pace = Pace(units=4, cost=10.0, start=100.0)
    assert pace.seconds_left() is None
    pace.advance(9.0, now=190.0)
    assert pace.seconds_left() == pytest.approx(10.0)
    assert "1/4 units  90.0 s, about 10 s left" in pace.text("coadds/roman", 190.0)
    for _ in range(3):
        pace.advance(1 / 3, now=200.0)
    assert "left" not in pace.text("coadds/roman", 200.0)


def test_the_remaining_time_excludes_the_time_that_other_stages_had_the_workers():
    """Of ten units of two seconds, one was made at the start and one after ten minutes: 16 s are left."""
    pace = Pace(units=10, cost=10.0, start=100.0)
    pace.advance(1.0, now=102.0, seconds=2.0)
    pace.advance(1.0, now=700.0, seconds=2.0)
    assert pace.seconds_left() == pytest.approx(16.0)
    # with two workers, units end one second after one another
    for now in (701.0, 702.0):
        pace.advance(1.0, now=now, seconds=2.0)
    assert pace.seconds_left() == pytest.approx(9.0)


@pytest.mark.parametrize(("seconds", "text"), [(3.2, "3 s"), (89, "89 s"), (600, "10 min"), (9000, "2.5 h")])
def test_durations_have_a_suitable_unit(seconds, text):
    assert duration(seconds) == text


def wait_for(text, console):
    """Wait until the console has the text; fail after a minute."""
    deadline = time.monotonic() + 60
    while text not in console.file.getvalue():
        assert time.monotonic() < deadline
        time.sleep(0.05)


class OutputSince:
    """Output of a console after the first `start` characters."""

    def __init__(self, console, start):
        self._console, self._start = console, start
        self.file = self

    def getvalue(self):
        return self._console.file.getvalue()[self._start :]


def test_a_long_activity_is_printed_repeatedly(monkeypatch):
    monkeypatch.setattr(progress, "MAX_SILENCE", 0.3)
    console = Console(file=io.StringIO(), width=200)
    start = time.monotonic()
    with Reporter(console).busy("planning"):
        wait_for("planning: ", console)
    lines = console.file.getvalue().splitlines()
    assert 1 <= len(lines) <= 1 + (time.monotonic() - start) / progress.MAX_SILENCE, "at most once per interval"
    assert all(line.startswith("planning: ") for line in lines)


@pytest.mark.parametrize(
    ("words", "module", "text"),
    [(["plan", "tiny"], survey, "planning: "), (["export", "obseq", "tiny", "o.fits"], obseq, "exporting: ")],
)
def test_a_long_command_prints_its_activity(words, module, text, monkeypatch, tmp_path, capsys):
    """The construction of the survey waits for the first output, so the speed of the command does not matter."""
    printed, say = threading.Event(), progress.Reporter.say

    def say_and_notify(reporter, line):
        say(reporter, line)
        printed.set()

    def delayed_survey(settings):
        assert printed.wait(60), "nothing was printed in a minute"
        return Survey(settings)

    monkeypatch.setattr(progress, "MAX_SILENCE", 0.2)
    monkeypatch.setattr(progress.Reporter, "say", say_and_notify)
    monkeypatch.setattr(module, "Survey", delayed_survey)
    monkeypatch.setattr(sys, "argv", ["romandask", *words])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert text in capsys.readouterr().out


def test_stages_without_a_finished_unit_are_printed_repeatedly(monkeypatch):
    monkeypatch.setattr(progress, "MAX_SILENCE", 0.3)
    console = Console(file=io.StringIO(), width=200)
    with Reporter(console).board() as board:
        meter, other = board.begin("coadds/roman", 2, 3.0), board.begin("truth_index/roman", 3, 3.0)
        board.expect(5, 6.0)
        wait_for("all stages           0/5 units", console)
        wait_for("coadds/roman 0/2, truth_index/roman 0/3", console)
        meter.advance(2.0)
        meter.advance(1.0)
        ended = console.file.getvalue()
        assert "2/2 units" in ended
        wait_for("truth_index/roman 0/3", OutputSince(console, len(ended)))
        assert "coadds" not in console.file.getvalue()[len(ended) :], "a finished stage is not printed again"
        for _ in range(3):
            other.advance(1.0)
    assert "3/3 units" in console.file.getvalue()


def test_active_stages_have_bars_and_finished_stages_have_lines():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with Reporter(console).board() as board:
        board.expect(5, 6.0)
        meter, other = board.begin("coadds/roman", 2, 3.0), board.begin("truth_index/roman", 3, 3.0)
        meter.advance(2.0)
        meter.advance(1.0)
        other.advance(1.0)
    written = console.file.getvalue()
    assert "2/2 units" in written
    assert written.rindex("1/3") > written.rindex("2/2"), (
        "the bar of the active stage is below the line of the finished one"
    )


def test_the_incomplete_last_line_of_a_log_is_ignored(tmp_path):
    log = Log(tmp_path / "log")
    log.write("run", pipeline="x")
    log.write("unit", stage="coadds/roman", unit="1-H158", seconds=2.5)
    assert runs(tmp_path / "log") == [log.name]
    logged = list(events(tmp_path / "log", log.name))
    assert [event["event"] for event in logged] == ["run", "unit"]
    assert logged[1]["seconds"] == 2.5
    assert logged[0]["time"] <= logged[1]["time"]
    assert newest_event(tmp_path / "log") == logged[1]
    path = tmp_path / "log" / f"{log.name}.jsonl"
    with open(path, "ab") as file:
        file.truncate(path.stat().st_size - 20)
    assert [event["event"] for event in events(tmp_path / "log", log.name)] == ["run"]
    assert newest_event(tmp_path / "none") is None


def test_a_store_is_in_use_while_the_process_of_its_lock_runs(tmp_path):
    assert not in_use(tmp_path)
    with locked(tmp_path):
        assert in_use(tmp_path)
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert not in_use(tmp_path)
    (tmp_path / ".lock").write_text('{"pid": 0}')
    assert not in_use(tmp_path)


@pytest.mark.slow
def test_watching_a_folder_that_is_no_store_is_refused(tmp_path):
    done = command("status", str(tmp_path), "--watch")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
