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
from conftest import MINI, MINI_RUN, command

from romandask.cli.main import main
from romandask.engine.staleness import StoredOutputs, find_stale, write_failure
from romandask.engine.verify import OTHER_FILES
from romandask.model.errors import UserError
from romandask.model.seeds import rng
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.run import verify_store
from romandask.storage.checksums import damaged_files
from romandask.storage.manifest import digest
from romandask.storage.store import Store, refuse_full
from romandask.survey import open_survey

pytestmark = pytest.mark.slow

DAMAGED_FILES = 60
"""Minimum number of files that are damaged, one at a time."""


@pytest.fixture(scope="module")
def store(mini_store, tmp_path_factory) -> Path:
    """A copy: damage is done to files of it."""
    return shutil.copytree(mini_store, tmp_path_factory.mktemp("faults") / "s")


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


def test_every_damage_is_found(store):
    """At least one file of each kind is changed, truncated, emptied or removed, one at a time.

    A unit without a record is not stored, and a stage without checksums is not finished: these are no damage.
    """
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
        elif number % 5 == 3:
            path.write_bytes(b"")
        elif number % 5 == 2 and path.relative_to(store).parts[0] != "manifest":
            path.unlink()
        else:
            changed = bytearray(content)
            changed[position] ^= 1 << int(random.integers(8))
            path.write_bytes(changed)
        if path.name == "pipeline.yaml":
            found = damaged_files(Store(store), "store")
        else:
            found = damaged(store, stage_of(store, path))
        if not found:
            missed.append((str(path.relative_to(store)), position, len(content)))
        path.write_bytes(content)
    assert not missed
    assert len(chosen) >= DAMAGED_FILES


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


DAMAGES = (truncate, empty, flip, Path.unlink)
KINDS = {
    "shards": ["coadds/roman.zarr/*/c/*/0/0/0"] * 4,
    "tables beside images": ["coadds/roman_sets/*.parquet"] * 3,
    "partitions": ["objects/rubin/catalog/**/Npix*.parquet", *["truth_match/rubin/*.parquet"] * 3],
    "tables": [
        f"{name}/all.parquet" for name in ("pointings/rubin", "limits/roman", "shear/roman", "zero_points/rubin")
    ],
    "records": [*["manifest/detections/rubin/*.json"] * 3, "manifest/statistics/blends/*.json"],
    "metadata of arrays": [f"coadds/rubin.zarr/{name}/zarr.json" for name in ("dq", "image", "noise", "weight")],
    "metadata of groups": [f"{name}.zarr/zarr.json" for name in ("coadds/rubin", "truth/structure", "truth/seds")],
    "coordinates": [f"coadds/rubin.zarr/{name}/c/0" for name in ("band", "dec", "header", "ra")],
    "catalogs": [
        "truth/galaxies/catalog/hats.properties",
        "objects/roman/catalog/partition_info.csv",
        "matches/groups/catalog/dataset/_metadata",
        "objects/rubin/catalog/properties",
    ],
    "collections": [
        f"{name}/collection.properties"
        for name in ("truth/galaxies", "objects/roman", "samples/roman", "matches/groups")
    ],
    "checksums": [
        f"manifest/{name}/files.seal" for name in ("samples/roman", "samples/rubin", "truth/stars", "objects/rubin")
    ],
    "spectra": [f"truth/seds.zarr/{name}" for name in ("wave/c/0", "sed/c/0", "photons/c/0/0", "wave/zarr.json")],
}
"""Patterns of files, each damaged in another way: the first that matches, and is not damaged yet."""
NO_DAMAGE = {"manifest/statistics/blends/all.json", "manifest/objects/rubin/files.seal"}
"""What is removed here without being damage (see above)."""


def run_again(folder: Path) -> str:
    done = command(*MINI_RUN, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def assert_same_bytes(store: Path, before: dict[Path, bytes]) -> None:
    after = {path.relative_to(store): path.read_bytes() for path in stored(store)}
    assert set(after) == set(before)
    # records and catalog properties hold times, and the settings hold the working directory
    skipped = {"manifest", "pipeline.yaml"}
    for name, content in before.items():
        if name.parts[0] not in skipped and name.name != "hats.properties":
            assert after[name] == content, name
    for name in (name for name in before if name.suffix == ".json" and name.parts[0] == "manifest"):
        assert json.loads(after[name])["output"] == json.loads(before[name])["output"], name
    assert command("verify", str(store)).returncode == 0


def test_files_of_every_kind_are_made_again_with_the_same_bytes(store, tmp_path):
    copy = tmp_path / "s"
    shutil.copytree(store, copy)
    before = {path.relative_to(copy): path.read_bytes() for path in stored(copy)}
    harmed: set[str] = set()
    for patterns in KINDS.values():
        for harm, pattern in zip(DAMAGES, patterns, strict=False):
            files = (path for path in sorted(copy.glob(pattern)) if path.is_file())
            path = next(path for path in files if str(path.relative_to(copy)) not in harmed)
            harm(path)
            harmed.add(str(path.relative_to(copy)))
    found = command("verify", str(copy))
    assert found.returncode == 1, found.stderr
    assert "damaged: coadds/rubin/*: cannot be verified before" in found.stdout
    forgotten = command("verify", str(copy), "--forget")
    assert forgotten.returncode == 1, forgotten.stderr
    reported = {line.split(": ")[1] for line in forgotten.stdout.splitlines() if line.startswith("damaged: ")}
    for name in harmed - NO_DAMAGE:
        stage, path = stage_of(copy, copy / name), copy / name
        own = {text.removeprefix(f"{stage}/") for text in reported if text.startswith(f"{stage}/")}
        assert own & {path.stem, name, path.name, "*"} or own and path.suffix != ".json", name
    # the settings are written by every run, and read by all commands but this one
    truncate(copy / "pipeline.yaml")
    made = int(run_again(tmp_path).split("made ")[1].split(" ")[0])
    assert made <= 30, "what is intact is kept"
    assert_same_bytes(copy, before)


def test_units_that_have_read_damaged_data_are_made_when_it_is_forgotten(store, tmp_path):
    """They fail, and data made again has the hash with which they have failed."""
    copy = tmp_path / "s"
    shutil.copytree(store, copy)
    before = {path.relative_to(copy): path.read_bytes() for path in stored(copy)}
    truncate(
        next(path for path in sorted((copy / "coadds" / "roman.zarr" / "image" / "c").rglob("*")) if path.is_file())
    )
    for record in (copy / "manifest" / "detections" / "roman").glob("*.json"):
        record.unlink()
    failing = command(*MINI_RUN, cwd=tmp_path)
    assert failing.returncode == 1
    assert [*(copy / "manifest" / "detections" / "roman").glob("*.failed")]
    assert command("verify", str(copy), "--forget").returncode == 1
    run_again(tmp_path)
    assert_same_bytes(copy, before)


@pytest.mark.parametrize("harm", [empty, Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:12])])
def test_a_unit_with_a_damaged_failure_is_tried_again(harm, tmp_path):
    product = TableProduct(
        stage="t/x", units=(Unit("u", 0),), make=lambda k: None, schema=pa.schema([pa.field("a", pa.int64())])
    )
    store = Store(tmp_path)
    task = find_stale(product, StoredOutputs(store)).tasks["u"]
    write_failure(store, "t/x", "u", digest("t/x", task.parts), "reason")
    assert find_stale(product, StoredOutputs(store)).failed == ["u"]
    harm(store.records("t/x") / "u.failed")
    assert "u" in find_stale(product, StoredOutputs(store)).tasks


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
