"""Faults: every byte that is not as it was written is found, and the same command makes the same bytes again."""

import errno
import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from conftest import MINI, command

from romandask.cli.main import main
from romandask.engine.verify import OTHER_FILES
from romandask.model.errors import UserError
from romandask.model.seeds import rng
from romandask.run import verify_store
from romandask.storage.manifest import digest
from romandask.storage.store import Store, refuse_full
from romandask.survey import open_survey

FLIPS = 60


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("faults")
    done = command("run", "tiny", "--store", "s", "--workers", "0", *MINI, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "s"


def stored(store: Path) -> list[Path]:
    """Return every file of a store but its report, which is made from the others, and the logs of its runs."""
    files = (path for path in sorted(store.rglob("*")) if path.is_file() and path.stat().st_size)
    return [path for path in files if path.relative_to(store).parts[0] not in ("report", "log", ".lock")]


def stage_of(store: Path, path: Path) -> str:
    """Return the stage that a file belongs to."""
    parts = path.relative_to(store).parts
    if parts[0] == "manifest":
        return "/".join(parts[1:-1])
    if len(parts) == 1:
        return "store"
    second = parts[1].split(".")[0]
    if second == "seds":
        return "truth/seds"
    margin = len(parts) > 2 and parts[2] in ("margin", "collection.properties")
    tables = {"roman_sets": "roman", "roman_objects": "roman", "rubin_objects": "rubin", "rubin_residuals": "rubin"}
    return f"{parts[0]}/{tables.get(second, second)}{'_margin' if margin else ''}"


def damaged(store: Path, stage: str) -> list[str]:
    return [name for found in verify_store(open_survey(store), stage) for name, _ in found.damaged]


def test_a_store_is_as_it_was_written(store):
    done = command("verify", str(store))
    assert done.returncode == 0, done.stdout
    assert "units are as they were written" in done.stdout
    every = {stage_of(store, path) for path in stored(store)}
    known = {found.stage for found in verify_store(open_survey(store))}
    assert every <= known | set(OTHER_FILES)
    assert {"exposures/roman", "coadds/rubin", "truth/galaxies_margin", "matches/groups"} <= every


def test_every_flipped_bit_and_every_cut_is_found(store):
    """Of files of every kind, one at a time, none of them twice the same way."""
    random, files = rng(1, "flips"), stored(store)
    kinds: dict[tuple, list[Path]] = {}
    for path in files:
        kinds.setdefault((stage_of(store, path), path.suffix, path.parent.name == "0"), []).append(path)
    chosen = [members[int(random.integers(len(members)))] for members in kinds.values()]
    chosen += [files[int(k)] for k in random.integers(len(files), size=max(0, FLIPS - len(chosen)))]
    missed = []
    for number, path in enumerate(chosen):
        content = path.read_bytes()
        place = int(random.integers(len(content)))
        if number % 5 == 4:
            path.write_bytes(content[:place])
        else:
            changed = bytearray(content)
            changed[place] ^= 1 << int(random.integers(8))
            path.write_bytes(changed)
        if path.name == "pipeline.yaml":
            found = ["pipeline.yaml"] if digest(path.read_bytes()) != digest(content) else []
        else:
            found = damaged(store, stage_of(store, path))
        if not found:
            missed.append((str(path.relative_to(store)), place, len(content)))
        path.write_bytes(content)
    assert not missed
    assert len(chosen) >= FLIPS


def test_what_is_missing_is_found_and_made_again_to_the_byte(store, tmp_path):
    """A chunk, a partition, a record and the metadata of a catalog are gone; the same command brings them back."""
    copy = tmp_path / "s"
    shutil.copytree(store, copy)
    before = {path.relative_to(copy): path.read_bytes() for path in stored(copy)}
    chunk = next(
        path
        for path in sorted((copy / "coadds" / "rubin.zarr" / "image").rglob("*"))
        if path.name != "zarr.json" and path.is_file()
    )
    table = next((copy / "objects" / "roman" / "catalog" / "dataset").rglob("*.parquet"))
    record = next((copy / "manifest" / "detections" / "roman").glob("*.json"))
    record.write_text(record.read_text().replace('"rows": ', '"rows": 1'))
    for path in (chunk, table, copy / "truth" / "stars" / "catalog" / "hats.properties"):
        path.unlink()
    done = command("verify", str(copy), "--forget")
    assert done.returncode == 1
    for stage in ("coadds/rubin", "objects/roman", "detections/roman", "truth/stars"):
        assert f"damaged: {stage}/" in done.stdout
    again = command("run", "tiny", "--store", "s", "--workers", "0", *MINI, cwd=tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr
    assert int(again.stdout.split("made ")[1].split(" ")[0]) <= 8
    assert command("verify", str(copy)).returncode == 0
    after = {path.relative_to(copy): path.read_bytes() for path in stored(copy)}
    assert set(after) == set(before)
    # records tell when, and properties of catalogs too; the settings where the command was given
    skipped = {"manifest", "versions.json", "pipeline.yaml"}
    for name, content in before.items():
        if name.parts[0] not in skipped and name.name != "hats.properties":
            assert after[name] == content, name
    for name in (name for name in before if name.suffix == ".json" and name.parts[0] == "manifest"):
        assert json.loads(after[name])["output"] == json.loads(before[name])["output"]


def test_a_store_that_cannot_be_written_is_refused_by_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    done = command("run", "tiny", "--store", "file/s", *MINI, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert np.array([path.name for path in tmp_path.iterdir()]).tolist() == ["file"]


def test_a_disk_that_is_full_ends_the_run_with_one_line_and_the_same_command_resumes(tmp_path, monkeypatch, capsys):
    """No unit is blamed for it, and what was stored before stays."""
    pq.write_table(pa.table({"id": [1, 2], "ra": [53.0, 53.1], "dec": [-40.0, -40.1]}), tmp_path / "stars.parquet")
    columns = {"id": "id", "ra": "ra", "dec": "dec", "magnorm": 20, "sed": "=none.txt"}
    stars = {"path": "stars.parquet", "columns": columns}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"stars": stars}))
    (tmp_path / "seds").mkdir()
    place = os.replace

    def full(source, target):
        if "quarantine" in str(target) and str(target).endswith(".parquet"):
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        place(source, target)

    arguments = ["romandask", "ingest", "table", str(tmp_path / "map.yaml"), "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", arguments)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line]
    assert len(told) == 1
    assert "No space left on device" in told[0]
    assert "the same command resumes" in told[0]
    assert not list((tmp_path / "s" / "manifest").rglob("*.failed"))
    assert (tmp_path / "s" / "manifest" / "truth" / "ingested").is_dir()
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert "rows in 2 = rows out 0 + quarantined 2" in capsys.readouterr().out


def test_an_error_of_the_disk_is_known_through_what_came_of_it(tmp_path):
    refuse_full(None, Store(tmp_path))
    refuse_full(OSError(errno.ENOENT, "No such file"), Store(tmp_path))
    wrapped = RuntimeError("could not be written")
    wrapped.__cause__ = OSError(errno.EROFS, "Read-only file system")
    with pytest.raises(UserError, match="Read-only file system"):
        refuse_full(wrapped, Store(tmp_path))
