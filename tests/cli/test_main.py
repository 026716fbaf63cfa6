"""Commands: the plan, the ingest, version and completion, and mistakes that end with one line and exit code 2."""

import re

import pyarrow.parquet as pq
import pytest
import yaml
from conftest import MINI, command
from typer.testing import CliRunner

import romandask
from romandask.cli.main import app

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere.yaml", "--store", "s"], ["nowhere.yaml", "no such pipeline", "tiny"]),
        (["run", "dc2_sample", "--store", "s", "data=nowhere"], ["nowhere/skycatalogs_sample", "data=FOLDER"]),
        (["run", "tiny", "--store", "file/s"], ["file/s", "cannot be written", "--store"]),
        (
            ["run", "tiny", "--store", "s", "--scheduler", "tcp://127.0.0.1:1"],
            ["tcp://127.0.0.1:1", "no dask scheduler"],
        ),
    ],
)
def test_a_mistake_is_one_line_with_exit_code_2_and_nothing_written(tmp_path, arguments, words):
    (tmp_path / "file").write_text("")
    before = sorted(tmp_path.iterdir())
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]
    assert sorted(tmp_path.iterdir()) == before


def test_a_region_without_pointings_and_a_catalog_without_a_column_are_refused(shared, tmp_path):
    """Both are refused before any work starts."""
    path = "roman_obseq/Roman_WAS_obseq_11_1_23.fits"
    done = command(
        "run",
        "tiny",
        "--store",
        "s",
        f"data={shared}",
        f"roman.pointings={{source: obseq, path: {path}}}",
        cwd=tmp_path,
    )
    assert done.returncode == 2
    assert "no exposure of roman in Y106" in done.stderr
    folder = tmp_path / "catalog"
    folder.mkdir()
    (folder / "skyCatalog.yaml").write_bytes((shared / "skycatalogs_sample" / "skyCatalog.yaml").read_bytes())
    table = pq.read_table(shared / "skycatalogs_sample" / "galaxy_9683.parquet").drop_columns(["convergence"])
    pq.write_table(table, folder / "galaxy_9683.parquet")
    done = command("ingest", "skycatalogs", "catalog", "--store", "s", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "galaxy_9683.parquet: column 'convergence' is missing" in done.stderr
    assert not (tmp_path / "s").exists()


def test_plan_names_every_stage_and_writes_only_the_diagram(tmp_path):
    done = command("plan", "tiny", "--dag", "dag.svg", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for stage in ("truth/galaxies", "exposures/roman", "coadds/rubin", "matches/groups", "statistics/blends"):
        assert stage in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["dag.svg"]
    diagram = (tmp_path / "dag.svg").read_text()
    for text in ("exposures", "roman: 46", "truth_match"):
        assert f">{text}<" in diagram


def test_plan_shows_all_numbers_on_a_narrow_terminal(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    done = command("plan", "tiny", *MINI, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 40
    numbers = {name: line for name, line in zip(lines, lines[1:], strict=False) if "/" in name}
    assert len(numbers) > 40
    assert all(re.fullmatch(r" *\d+ +(\d+\.\d+ GB|-) +(\d+\.\d+|-) +\d+\.\d+ GiB", line) for line in numbers.values())
    assert re.fullmatch(r" *\d+ +\d+\.\d+ GB +\d+\.\d+ +limit 2\.00 GiB", lines[lines.index("total") + 1])


def test_the_version_is_that_of_the_package():
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    assert done.output == f"romandask {romandask.__version__}\n"


def test_a_shell_completes_commands():
    environment = {"_ROMANDASK_COMPLETE": "complete_bash", "COMP_WORDS": "romandask re", "COMP_CWORD": "1"}
    done = CliRunner().invoke(app, [], prog_name="romandask", env=environment)
    assert done.output.split() == ["report", "reference"]


def test_one_survey_of_a_pipeline_can_be_planned_alone(tmp_path):
    for alone, other in (("rubin=null", "coadds/rubin"), ("roman=null", "coadds/roman")):
        done = command("plan", "tiny", alone, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert other not in done.stdout


def test_ingest_accounts_for_every_row(shared, tmp_path):
    done = command("ingest", "skycatalogs", str(shared / "skycatalogs_sample"), "--store", "s", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "rows in 4987 = rows out" in done.stdout
    assert (tmp_path / "s" / "truth" / "galaxies" / "collection.properties").is_file()


def test_the_survey_of_the_paper_is_planned_at_full_size(tmp_path, monkeypatch):
    """The paper has 29,153 SCA images, 1039 tiles and 15.3 square degrees."""
    monkeypatch.setenv("COLUMNS", "120")
    done = command("plan", "troxel2023", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = [line.replace("│", " ").split() for line in done.stdout.splitlines() if "/" in line]
    units = {row[0]: int(row[1]) for row in rows}
    assert units["exposures/roman"] == pytest.approx(29153, rel=0.06)
    assert units["coadd_noise/roman"] == pytest.approx(1039, rel=0.02)
    assert units["detections/roman"] == 16 * units["coadd_noise/roman"], "patches"
    assert units["coadds/rubin"] == 6 * units["detections/rubin"]
    assert list(tmp_path.iterdir()) == []
    done = command("plan", "troxel2023", "run.memory_limit=1.8", cwd=tmp_path)
    assert done.returncode == 2
    assert "needs 1.8 GiB" in done.stderr
    assert ", or raise run.memory_limit" in done.stderr


def test_a_warning_of_an_input_is_one_line(shared, tmp_path):
    """The database has dithered places, which are not taken unless a setting says so."""
    content = {
        "name": "d",
        "seed": 1,
        "data": str(shared / "odd_inputs/opsim"),
        "region": {"ra": [225.08, 225.09], "dec": [-40.0, -39.99]},
        "rubin": {"bands": ["LSST_r"], "mode": "visits", "pointings": {"source": "opsim", "path": "dithered.db"}},
    }
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(content))
    done = command("plan", "p.yaml", cwd=tmp_path)
    assert done.returncode == 0
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith("warning: ")
    assert "rubin.pointings.dither: descDithered" in done.stderr
    done = command("plan", "p.yaml", "rubin.pointings.dither=descDithered", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
