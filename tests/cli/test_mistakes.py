"""Mistakes of users in settings, arguments and input files: one line that names the mistake, exit code 2, no files."""

import gzip
import os
import sqlite3
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from astropy.table import Table
from conftest import ROOT

from romandask.cli.main import main

TINY = yaml.safe_load((ROOT / "pipelines" / "tiny.yaml").read_text())
RUN = ("run", "p.yaml", "--store", "s")


def changed(**sections) -> bytes:
    """Return the tiny pipeline as YAML with some sections changed; None removes a section."""
    content = {key: dict(value) if isinstance(value, dict) else value for key, value in TINY.items()}
    for name, value in sections.items():
        if value is None:
            del content[name]
        elif isinstance(value, dict):
            content[name] = {**content.get(name, {}), **value}
        else:
            content[name] = value
    return yaml.safe_dump(content).encode()


def database(path, table="observations", **columns) -> None:
    """Write an OpSim database of two visits."""
    content = {
        "observationId": [1, 2],
        "filter": ["i", "i"],
        "observationStartMJD": [60980.1, 60980.2],
        "visitExposureTime": [30.0, 30.0],
        "fieldRA": [53.0, 53.0],
        "fieldDec": [-40.0, -40.0],
        "rotSkyPos": [0.0, 0.0],
        "seeingFwhm500": [0.7, 0.7],
        "airmass": [1.0, 1.1],
        "skyBrightness": [20.5, 20.5],
    } | columns
    with sqlite3.connect(path) as connection:
        frame = pd.DataFrame({name: values for name, values in content.items() if values is not None})
        frame.to_sql(table, connection, index=False)


def sequence(path, **columns) -> None:
    """Write an observing sequence of two visits."""
    content = {
        "date": [61541.0, 61541.1],
        "exptime": [140.0, 140.0],
        "ra": [53.03, 53.03],
        "dec": [-40.0, -40.0],
        "pa": [0.0, 0.0],
        "filter": ["H158", "H158"],
    } | columns
    Table({name: values for name, values in content.items() if values is not None}).write(path, format="fits")


YAMLS = {
    "empty file": (b"", ["p.yaml", "NoneType", "mapping"]),
    "list": (b"- 1\n- 2\n", ["p.yaml", "list", "mapping"]),
    "tab": (b"name: x\nregion:\n\tra: [1, 2]\n", ["p.yaml", "not valid YAML", "line 3"]),
    "open bracket": (b"name: x\nregion: {ra: [1, 2\n", ["p.yaml", "not valid YAML"]),
    "no text": (bytes(range(128, 256)), ["p.yaml", "not text"]),
    "key twice": (b"name: x\nseed: 1\nseed: 2\n", ["p.yaml", "seed", "twice", "line 3"]),
    "python object": (b"name: !!python/object/apply:os.system ['touch owned']\n", ["p.yaml", "not valid YAML"]),
    "no region": (changed(region=None), ["p.yaml", "missing key region"]),
    "no survey": (changed(roman=None, rubin=None), ["p.yaml", "roman", "rubin"]),
    "unknown section": (changed(coads={"pixels": 1000}), ["unknown key coads", "did you mean coadds"]),
    "unknown key": (changed(coadds={"pixel": 1000}), ["coadds.pixel", "did you mean coadds.pixels"]),
    "name with a path": (changed(name="../x"), ["name", "../x"]),
    "negative seed": (changed(seed=-1), ["seed", "-1"]),
    "text for a number": (changed(seed="many"), ["seed", "'many'"]),
    "declinations in disorder": (changed(region={"dec": [-40.0, -40.1]}), ["region", "dec", "increasing"]),
    "beyond the pole": (changed(region={"dec": [80, 95]}), ["region", "dec", "-90..90"]),
    "negative right ascension": (changed(region={"ra": [-1, 1]}), ["region", "ra", "0..360"]),
    "one right ascension": (changed(region={"ra": [53]}), ["region.ra"]),
    "right ascension that is no number": (changed(region={"ra": [float("nan"), 53]}), ["region.ra", "nan"]),
    "infinitely many galaxies": (changed(truth={"galaxies": float("inf")}), ["truth.galaxies", "inf"]),
    "no order": (changed(truth={"order": 40}), ["truth.order", "40"]),
    "no nside": (changed(truth={"nside": 100}), ["truth.nside", "100"]),
    "catalog without a path": (changed(truth={"source": "skycatalogs"}), ["truth.path"]),
    "unknown source": (changed(truth={"source": "cosmodc3"}), ["truth.source", "cosmodc3", "skycatalogs"]),
    "strong shear": (changed(truth={"shear": [0.3, 0.0]}), ["truth.shear", "0.2"]),
    "unknown band": (changed(roman={"bands": ["H159"]}), ["roman.bands", "H159", "H158"]),
    "band twice": (changed(roman={"bands": ["H158", "H158"]}), ["roman.bands", "H158", "twice"]),
    "no band": (changed(rubin={"bands": []}), ["rubin.bands"]),
    "unknown detector": (changed(roman={"detector": "h4rg"}), ["roman.detector", "h4rg", "sca"]),
    "calibration of the simple detector": (changed(roman={"calibration": "x"}), ["roman", "detector: sca"]),
    "no calibration there": (
        changed(roman={"detector": "sca", "calibration": "nowhere"}),
        ["nowhere", "calibration"],
    ),
    "band without dithers": (
        changed(roman={"pointings": {"source": "plan", "dithers": {"H158": [1]}}}),
        ["dithers", "Y106"],
    ),
    "negative dithers": (
        changed(roman={"pointings": {"source": "plan", "dithers": {"H158": [-1]}}}),
        ["dithers.H158", "-1"],
    ),
    "band of no visits": (
        changed(rubin={"pointings": {"source": "cadence", "visits": {"X": 3}}}),
        ["rubin.pointings.visits", "X"],
    ),
    "overlaps without an inside": (changed(coadds={"overlap": 600}), ["coadds", "pixels (1000)", "600"]),
    "drop of no size": (changed(coadds={"pixfrac": 0}), ["coadds.pixfrac", "0"]),
    "no linking length": (changed(matches={"linking_lengths": []}), ["matches.linking_lengths"]),
    "negative linking length": (changed(matches={"linking_lengths": [-1.0]}), ["matches.linking_lengths", "-1"]),
    "linking length twice": (changed(matches={"linking_lengths": [1.0, 1]}), ["matches.linking_lengths", "twice"]),
    "linking length of a degree": (changed(matches={"linking_lengths": [3600]}), ["linking_lengths", "3600"]),
    "limit of an unknown band": (changed(matches={"limits": {"Z": 25}}), ["matches.limits", "Z", "H158, i"]),
    "separations in disorder": (changed(lensing={"max_separation": 1.0}), ["lensing", "max_separation"]),
    "tiny memory": (changed(run={"memory_limit": 0.1}), ["run.memory_limit", "0.1"]),
    "worker too small": (changed(run={"memory_limit": 0.6}), ["GiB", "run.memory_limit"]),
    "no such data": (changed(truth={"source": "skycatalogs", "path": "none"}), ["none", "no such folder"]),
}
COMMANDS = {
    "override without a value": ([*RUN, "coadds.pixfrac"], ["coadds.pixfrac", "key=value"]),
    "override into a value": ([*RUN, "seed.more=1"], ["seed.more=1", "seed holds a value"]),
    "override that is no YAML": ([*RUN, "seed={"], ["seed={", "not a valid value"]),
    "sequence without a path": ([*RUN, "roman.pointings={source: obseq}"], ["roman.pointings.path"]),
    "sequence cut": ([*RUN, "roman.pointings={source: obseq, path: cut.fits}"], ["cut.fits", "not a complete FITS"]),
    "tiles that do not fit": (
        [*RUN, "coadds.pixels=12000", "coadds.patch_pixels=12000"],
        ["GiB", "coadds.patch_pixels", "run.memory_limit"],
    ),
    "whole sky in small cells": (["plan", "p.yaml", "region={ra: [0, 360], dec: [-90, 90]}"], ["cells", "truth.order"]),
    "tiles without number": (["plan", "p.yaml", "coadds.scale=1e-7"], ["tiles", "coadds.pixels"]),
    "pixfrac beyond one": (["plan", "p.yaml", "coadds.pixfrac=3"], ["coadds.pixfrac", "3"]),
    "limit in an unknown band": (["plan", "p.yaml", "matches.limits={h159: 25}"], ["h159", "H158, i"]),
    "limit of a band twice": (["plan", "p.yaml", "matches.limits={H158: 25, F158: 26}"], ["H158", "F158", "twice"]),
    "letter of two telescopes": (
        ["plan", "p.yaml", "differences.science=Y"],
        ["differences.science", "'Y'", "Y106", "y"],
    ),
    "filter that is not simulated": (["plan", "p.yaml", "roman.bands=[F213]"], ["roman.bands", "F213", "H158"]),
    "dithers without a database": (["plan", "p.yaml", "rubin.pointings.dither=descDithered"], ["dither", "opsim"]),
    "folder as pipeline": (["plan", "folder"], ["folder", "no such pipeline"]),
    "store in the cloud": (["run", "p.yaml", "--store", "gs://bucket/s"], ["gs://bucket/s", "folder"]),
    "store of another scheme": (["run", "p.yaml", "--store", "http://host/s"], ["http://host/s", "folder"]),
    "scheduler of another scheme": ([*RUN, "--scheduler", "http://127.0.0.1:1"], ["http://127.0.0.1:1", "tcp://"]),
    "scheduler with TLS, no certificates": (
        [*RUN, "--scheduler", "tls://127.0.0.1:1"],
        ["tls://127.0.0.1:1", "TLS"],
    ),
    "scheduler that is none": ([*RUN, "--scheduler", "somewhere"], ["somewhere", "tcp://"]),
    "unknown stage": ([*RUN, "--only", "coads"], ["coads", "coadds"]),
    "from an unknown stage": ([*RUN, "--from", "coadds/euclid"], ["coadds/euclid", "coadds"]),
    "status of a file": (["status", "p.yaml"], ["p.yaml", "not a romandask store"]),
    "verify of a folder": (["verify", "folder"], ["folder", "not a romandask store"]),
    "report of nothing": (["report", "nowhere"], ["nowhere", "not a romandask store"]),
    "store of another pipeline file": (["status", "broken"], ["broken", "pipeline.yaml"]),
    "skycatalogs that are none": (["ingest", "skycatalogs", "folder", "--store", "s"], ["folder", "skyCatalog"]),
    "instance catalog that is none": (
        ["ingest", "instance-catalog", "p.yaml", "--store", "s"],
        ["p.yaml", "instance catalog"],
    ),
    "instance catalog cut": (["ingest", "instance-catalog", "cut.txt.gz", "--store", "s"], ["cut.txt.gz"]),
    "table without a path": (["ingest", "table", "map.yaml", "--store", "s"], ["map.yaml", "galaxies", "path"]),
    "table of unknown columns": (["ingest", "table", "far.yaml", "--store", "s"], ["nowhere.parquet"]),
    "table without a column": (["ingest", "table", "short.yaml", "--store", "s"], ["rows.parquet", "declination"]),
    "cutouts of nothing": (["export", "meds", "broken", "out"], ["--id", "--cone"]),
    "calibration of nothing": (["calibration", "check", "nowhere"], ["nowhere"]),
    "calibration of no SCA": (["calibration", "make", "out", "--sca", "19"], ["19", "18"]),
}
OPSIM = {
    "no database": (None, ["o.db", "no such file"]),
    "text as database": (b"SELECT * FROM observations", ["o.db", "SQLite"]),
    "database of other tables": ({"table": "visits"}, ["o.db", "observations"]),
    "database without a column": ({"airmass": None}, ["o.db", "airmass"]),
    "missing value": ({"airmass": [1.0, None]}, ["o.db", "airmass", "missing"]),
    "text as number": ({"fieldRA": [53.0, "far"]}, ["o.db", "fieldRA", "row 1", "'far'"]),
    "text as identifier": ({"observationId": ["2024_0", "2024_1"]}, ["o.db", "observationId", "'2024_0'", "number"]),
    "visits of other filters": ({"filter": ["g", "LSST_g"]}, ["o.db", "filter", "no rows of", "LSST_g (1 rows)"]),
    "visits of unknown filters": ({"filter": ["i", "x"]}, ["o.db", "filter", "'x'", "LSST_i"]),
    "declination beyond the pole": ({"fieldDec": [-40.0, -140.0]}, ["o.db", "fieldDec", "-140"]),
    "negative exposure": ({"visitExposureTime": [30.0, -30.0]}, ["o.db", "visitExposureTime", "-30"]),
}
SEQUENCES = {
    "no sequence": (None, ["o.fits", "no such file"]),
    "text as sequence": (b"date exptime ra dec pa filter\n", ["o.fits", "FITS"]),
    "sequence without a column": ({"pa": None}, ["o.fits", "pa"]),
    "sequence with a hole": ({"ra": [53.0, np.nan]}, ["o.fits", "ra", "row 1", "nan"]),
    "sequence of text": ({"dec": ["south", "south"]}, ["o.fits", "dec"]),
    "sequence beyond the pole": ({"dec": [-40.0, -95.0]}, ["o.fits", "dec", "-95"]),
    "sequence of no time": ({"exptime": [140.0, 0.0]}, ["o.fits", "exptime", "0"]),
    "sequence of unknown filters": ({"filter": ["H159", "H159"]}, ["H159", "H158", "F158"]),
    "sequence without a filter's rows": ({"filter": ["K213", "F129"]}, ["K213 (1 rows)", "no rows of", "H158"]),
    "sequence of days": ({"date": [1.0, 2.0]}, ["o.fits", "date", "40000"]),
}


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Return a function that runs a command in a folder of invalid files and expects one error line with some words."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "pipeline.yaml").write_text("name: x\n")
    (tmp_path / "p.yaml").write_bytes(changed())
    (tmp_path / "cut.fits").write_bytes(b"SIMPLE  =                    T" + b" " * 500)
    (tmp_path / "cut.txt.gz").write_bytes(gzip.compress(b"rightascension 53\n" * 1000)[:-20])
    (tmp_path / "map.yaml").write_text("galaxies: {columns: {ra: ra}}\n")
    (tmp_path / "far.yaml").write_text("galaxies: {path: nowhere.parquet, columns: {ra: ra}}\n")
    pq.write_table(pa.table({"right_ascension": [53.0]}), tmp_path / "rows.parquet")
    columns = {"id": "right_ascension", "ra": "right_ascension", "dec": "declination", "magnorm": 20, "sed": "=x.txt"}
    stars = {"stars": {"path": "rows.parquet", "columns": columns}}
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(stars))
    monkeypatch.chdir(tmp_path)

    def check(arguments, words):
        before = sorted(os.walk(tmp_path))
        monkeypatch.setattr(sys, "argv", ["romandask", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        output = capsys.readouterr()
        lines = [line for line in output.err.splitlines() if line.strip()]
        assert ended.value.code == 2, output
        assert len(lines) == 1, output.err
        assert lines[0].startswith("error: ")
        for word in words:
            assert word in lines[0]
        assert sorted(os.walk(tmp_path)) == before

    return check


@pytest.mark.parametrize(("content", "words"), YAMLS.values(), ids=YAMLS)
def test_invalid_pipelines_are_refused(tmp_path, refused, content, words):
    (tmp_path / "p.yaml").write_bytes(content)
    refused(RUN, words)


@pytest.mark.parametrize(("arguments", "words"), COMMANDS.values(), ids=COMMANDS)
def test_invalid_arguments_are_refused(refused, arguments, words):
    refused(arguments, words)


@pytest.mark.parametrize(("content", "words"), OPSIM.values(), ids=OPSIM)
def test_invalid_rubin_visits_are_refused(tmp_path, refused, content, words):
    if isinstance(content, bytes):
        (tmp_path / "o.db").write_bytes(content)
    elif content is not None:
        database(tmp_path / "o.db", **content)
    refused((*RUN, "rubin.pointings={source: opsim, path: o.db}"), words)


@pytest.mark.parametrize(("content", "words"), SEQUENCES.values(), ids=SEQUENCES)
def test_invalid_roman_visits_are_refused(tmp_path, refused, content, words):
    if isinstance(content, bytes):
        (tmp_path / "o.fits").write_bytes(content)
    elif content is not None:
        sequence(tmp_path / "o.fits", **content)
    refused((*RUN, "roman.pointings={source: obseq, path: o.fits}"), words)


@pytest.mark.parametrize(
    "arguments",
    [["rum"], ["run", "tiny"], [*RUN, "--workers", "-1"], [*RUN, "--wrokers", "1"], ["ingest", "skycatalogs", "x"], []],
    ids=" ".join,
)
def test_unknown_commands_and_options_are_refused(tmp_path, monkeypatch, capsys, arguments):
    """A wrong command or option is reported with the usage text."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["romandask", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    output = capsys.readouterr()
    assert "Usage:" in output.err + output.out
    assert "Traceback" not in output.err
    assert not list(tmp_path.iterdir())
