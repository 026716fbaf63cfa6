"""Verification and repair of a store: every changed byte is found, and a new run makes the same bytes again."""

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

pytestmark = pytest.mark.slow

DAMAGED_FILES = 60
"""Minimum number of files that are damaged, one at a time."""


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("faults")
    done = command("run", "tiny", "--store", "s", "--workers", "0", *MINI, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "s"


def stored(store: Path) -> list[Path]:
    """Return every file of a store except its report, its logs and its lock."""
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
    return [name for result in verify_store(open_survey(store), stage) for name, _ in result.damaged]


def test_an_undamaged_store_is_verified(store):
    done = command("verify", str(store))
    assert done.returncode == 0, done.stdout
    assert "units are as they were written" in done.stdout
    stages = {stage_of(store, path) for path in stored(store)}
    verified = {result.stage for result in verify_store(open_survey(store))}
    assert stages <= verified | set(OTHER_FILES)
    assert {"exposures/roman", "coadds/rubin", "truth/galaxies_margin", "matches/groups"} <= stages


def test_every_flipped_bit_and_every_truncation_is_found(store):
    """At least one file of each kind is damaged, one at a time, at a random position."""
    random, files = rng(1, "flips"), stored(store)
    kinds: dict[tuple, list[Path]] = {}
    for path in files:
        kinds.setdefault((stage_of(store, path), path.suffix, path.parent.name == "0"), []).append(path)
    chosen = [members[int(random.integers(len(members)))] for members in kinds.values()]
    chosen += [files[int(k)] for k in random.integers(len(files), size=max(0, DAMAGED_FILES - len(chosen)))]
    missed = []
    for number, path in enumerate(chosen):
        content = path.read_bytes()
        position = int(random.integers(len(content)))
        if number % 5 == 4:
            path.write_bytes(content[:position])
        else:
            changed = bytearray(content)
            changed[position] ^= 1 << int(random.integers(8))
            path.write_bytes(changed)
        if path.name == "pipeline.yaml":
            found = ["pipeline.yaml"] if digest(path.read_bytes()) != digest(content) else []
        else:
            found = damaged(store, stage_of(store, path))
        if not found:
            missed.append((str(path.relative_to(store)), position, len(content)))
        path.write_bytes(content)
    assert not missed
    assert len(chosen) >= DAMAGED_FILES


def test_missing_files_are_found_and_made_again_with_the_same_bytes(store, tmp_path):
    """A chunk, a partition and the metadata of a catalog are removed and a record is changed; a new run makes them."""
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
    # records and catalog properties hold times, and the settings hold the working directory
    skipped = {"manifest", "versions.json", "pipeline.yaml"}
    for name, content in before.items():
        if name.parts[0] not in skipped and name.name != "hats.properties":
            assert after[name] == content, name
    for name in (name for name in before if name.suffix == ".json" and name.parts[0] == "manifest"):
        assert json.loads(after[name])["output"] == json.loads(before[name])["output"]


def test_a_store_that_cannot_be_written_is_refused_with_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    done = command("run", "tiny", "--store", "file/s", *MINI, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert np.array([path.name for path in tmp_path.iterdir()]).tolist() == ["file"]


def test_a_full_disk_ends_the_run_with_one_line_and_the_same_command_resumes(tmp_path, monkeypatch, capsys):
    """No unit is recorded as failed, and the stored units stay."""
    pq.write_table(pa.table({"id": [1, 2], "ra": [53.0, 53.1], "dec": [-40.0, -40.1]}), tmp_path / "stars.parquet")
    columns = {"id": "id", "ra": "ra", "dec": "dec", "magnorm": 20, "sed": "=none.txt"}
    stars = {"path": "stars.parquet", "columns": columns}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"stars": stars}))
    (tmp_path / "seds").mkdir()
    replace = os.replace

    def full(source, target):
        if "quarantine" in str(target) and str(target).endswith(".parquet"):
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        replace(source, target)

    arguments = ["romandask", "ingest", "table", str(tmp_path / "map.yaml"), "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", arguments)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line]
    assert len(lines) == 1
    assert "No space left on device" in lines[0]
    assert "the same command resumes" in lines[0]
    assert not list((tmp_path / "s" / "manifest").rglob("*.failed"))
    assert (tmp_path / "s" / "manifest" / "truth" / "ingested").is_dir()
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert "rows in 2 = rows out 0 + quarantined 2" in capsys.readouterr().out


def test_a_disk_error_is_recognised_as_the_cause_of_another_error(tmp_path):
    refuse_full(None, Store(tmp_path))
    refuse_full(OSError(errno.ENOENT, "No such file"), Store(tmp_path))
    wrapped = RuntimeError("could not be written")
    wrapped.__cause__ = OSError(errno.EROFS, "Read-only file system")
    with pytest.raises(UserError, match="Read-only file system"):
        refuse_full(wrapped, Store(tmp_path))
