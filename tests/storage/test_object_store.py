"""Stores and sources in an object store, tested with a local S3 server (moto)."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import s3fs
from conftest import command
from test_store import image_product

import romandask
from romandask.engine.event_log import Log, events, newest_event, runs
from romandask.ingest import instance_catalog, obseq, opsim
from romandask.model.errors import UserError
from romandask.storage import lock
from romandask.storage.lock import in_use, locked
from romandask.storage.manifest import read_records
from romandask.storage.paths import (
    file_state,
    files_below,
    local_copy,
    modification_time,
    parse_path,
    read_files,
    remove_folder,
    resolve_below,
    write_new,
)
from romandask.storage.store import Store

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bucket(tmp_path_factory):
    """URL of a bucket of an S3 server that runs during the tests of this module, with the environment set for it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = open(tmp_path_factory.mktemp("s3") / "log", "wb")
    server = subprocess.Popen([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stderr=log)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "a key",
            "AWS_SECRET_ACCESS_KEY": "a secret",
            "AWS_DEFAULT_REGION": "us-east-1",
            "XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache")),
        }.items():
            patch.setenv(name, value)
        for _ in range(120):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.5)
        s3fs.S3FileSystem().mkdir("surveys")
        yield "s3://surveys"
    os.kill(server.pid, signal.SIGTERM)
    server.wait()
    log.close()


@pytest.fixture
def folder(bucket):
    """Path of a folder in the bucket that no other test uses."""
    return parse_path(f"{bucket}/{uuid.uuid4().hex}")


def upload(source: Path, to: str) -> None:
    s3fs.S3FileSystem(use_listings_cache=False).put(f"{source}/", f"{to}/", recursive=True)


@pytest.fixture(scope="module")
def survey(bucket, tiny_store):
    """URL of a copy of the tiny survey in the bucket."""
    upload(tiny_store, f"{bucket}/tiny")
    return f"{bucket}/tiny"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("gs://surveys/a", "gs:// is not known"),
        ("https://host/a", "https:// is not known"),
        ("s3://", "without empty parts"),
        ("s3://surveys//a", "without empty parts"),
        ("s3://surveys/../a", "without empty parts"),
        ("s3://surveys/a?versionId=1", "without empty parts"),
    ],
)
def test_invalid_urls_are_rejected(text, what):
    with pytest.raises(UserError, match=what):
        parse_path(text)


def test_an_existing_file_is_not_overwritten_by_write_new(folder):
    write_new(folder / "a", b"1")
    with pytest.raises(FileExistsError):
        write_new(folder / "a", b"2")
    assert (folder / "a").read_bytes() == b"1"


def test_files_of_a_folder_are_read_by_their_suffix(folder):
    for k in range(3):
        write_new(folder / f"u{k}.json", str(k).encode())
    write_new(folder / "u1.failed", b"why")
    assert dict(read_files(folder, ".json")) == {"u0": b"0", "u1": b"1", "u2": b"2"}
    assert dict(read_files(folder / "none", ".json")) == {}
    assert [path.name for path in files_below(folder)] == ["u0.json", "u1.failed", "u1.json", "u2.json"]
    remove_folder(folder)
    assert files_below(folder) == []


def test_a_source_is_downloaded_once_and_again_after_a_change(folder):
    path = resolve_below(folder, "catalog.txt")
    path.write_bytes(b"old")
    first = local_copy(path)
    assert first.read_bytes() == b"old"
    assert local_copy(path) == first
    before = file_state(path)
    time.sleep(1.1)
    path.write_bytes(b"new")
    assert local_copy(path).read_bytes() == b"new"
    assert file_state(path) != before


def test_a_second_driver_is_refused_and_a_stale_lock_taken_over(folder):
    with locked(folder):
        assert in_use(folder)
        holder = json.loads((folder / ".lock").read_bytes())
        with pytest.raises(UserError, match="in use by another driver"), locked(folder):
            pass
        (folder / ".lock").write_text(json.dumps(holder | {"started": 1, "id": "before"}))
        with locked(folder):
            assert in_use(folder)
    assert not in_use(folder)


def test_a_lock_in_a_bucket_is_renewed_and_lost_to_a_driver_elsewhere(folder, monkeypatch):
    monkeypatch.setattr(lock, "RENEW_INTERVAL", 0.5)
    path = folder / ".lock"
    with locked(folder) as own:
        written = modification_time(path)
        until(lambda: modification_time(path) > written)
        own.check()
        path.write_text(json.dumps({"host": "elsewhere", "machine": "b", "pid": 7, "id": "x"}))
        until(lambda: own._lost_to)
        with pytest.raises(UserError, match=r"a driver on elsewhere \(process 7\) has taken the store"):
            own.check()
    assert json.loads(path.read_bytes())["id"] == "x", "a lock of another driver stays"
    with pytest.raises(UserError, match=r"in use by a driver on elsewhere .* takes over in \d+ s"), locked(folder):
        pass
    monkeypatch.setattr(lock, "LEASE", 1.0)
    time.sleep(2.1)
    lines = []
    with locked(folder, lines.append):
        assert in_use(folder)
    assert len(lines) == 1
    assert "taking over from a driver on elsewhere (process 7)" in lines[0]
    assert files_below(folder) == []


def until(condition) -> None:
    for _ in range(100):
        if condition():
            return
        time.sleep(0.1)
    raise AssertionError("not in ten seconds")


def test_a_log_is_uploaded_in_parts(folder):
    log = Log(folder / "log")
    log.write("run", pipeline="x")
    for k in range(5):
        log.write("unit", unit=f"u{k}")
    assert [event["event"] for event in events(folder / "log", log.name)] == ["run"]
    log.write("end", how="done")
    assert runs(folder / "log") == [log.name]
    assert [event["event"] for event in events(folder / "log", log.name)] == ["run", *["unit"] * 5, "end"]
    assert newest_event(folder / "log")["how"] == "done"


@pytest.mark.parametrize("location", ["bucket", "disk"])
def test_images_are_read_back_and_a_missing_chunk_is_an_error(location, folder, tmp_path):
    store = Store(folder if location == "bucket" else tmp_path)
    product = image_product(3).stored(store)
    product.prepare(store)
    made = product.write(1, store)
    assert product.verify(1, store) == made.output
    np.testing.assert_array_equal(product.reader(1)("image"), image_product(3).make(1)["image"])
    with pytest.raises(UserError, match=r"image is damaged \(.*the chunk is gone\): romandask verify --forget"):
        product.reader(2)("image")


def test_a_survey_in_a_bucket_is_read_and_verified_like_a_local_one(survey, tiny_store):
    local, remote = romandask.open(tiny_store), romandask.open(survey)
    assert repr(remote).replace(survey, str(tiny_store)) == repr(local)
    window = {"tile": 0, "y": slice(100, 140), "x": slice(100, 140)}
    for instrument in ("roman", "rubin"):
        first, second = (s.coadds(instrument)["image"].isel(window).compute() for s in (local, remote))
        np.testing.assert_array_equal(first, second)
    pd.testing.assert_frame_equal(local.objects("roman").compute(), remote.objects("roman").compute())
    catalog = pd.read_parquet(f"{survey}/objects/roman/catalog/dataset", columns=["objectId"])
    assert len(catalog) == len(local.objects("roman"))
    done = command("verify", survey)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "units are as they were written" in done.stdout


def test_damaged_units_in_a_bucket_are_found_and_made_again_identically(survey, tiny_store, tmp_path):
    root = parse_path(survey)
    chunk = next(path for path in files_below(root / "coadds/rubin.zarr/image") if path.name != "zarr.json")
    table = next(path for path in files_below(root / "objects/roman/catalog/dataset") if path.name.startswith("Npix"))
    content = table.read_bytes()
    table.write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
    chunk.unlink()
    done = command("verify", survey, "--forget")
    assert done.returncode == 1
    assert "damaged: coadds/rubin/" in done.stdout
    assert "damaged: objects/roman/" in done.stdout
    again = command("run", "tiny", "--store", survey, "--workers", "1", cwd=tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr
    assert table.read_bytes() == content
    outputs, expected = (
        {(stage, name): record.output for stage in store.stages() for name, record in read_records(store, stage)}
        for store in (Store(root), Store(tiny_store))
    )
    assert outputs == expected
    assert (root / "report/index.html").read_bytes().startswith(b"<!doctype html>")
    assert "it ended (done)" in command("status", survey).stdout


def test_a_pipeline_and_its_sources_can_be_in_a_bucket(bucket, shared, tmp_path):
    source = shared / "skycatalogs_sample"
    upload(source, f"{bucket}/sky")
    counts = []
    for path, store in ((str(source), tmp_path / "local"), (f"{bucket}/sky", tmp_path / "remote")):
        done = command("ingest", "skycatalogs", path, "--store", str(store), "--seds", str(shared / "seds"))
        assert done.returncode == 0, done.stdout + done.stderr
        counts.append(done.stdout.splitlines()[-1])
    assert counts[0] == counts[1]
    assert "rows in" in counts[0]
    (parse_path(bucket) / "p.yaml").write_text(
        "name: p\nseed: 1\nregion: {ra: [53, 53.01], dec: [-40, -39.99]}\nroman: {}\n"
    )
    assert command("plan", f"{bucket}/p.yaml").returncode == 0


def test_every_source_format_reads_the_same_from_a_bucket(bucket, shared):
    upload(shared / "dc2_instance_catalog", f"{bucket}/dc2")
    for name in ("opsim", "roman_obseq"):
        upload(shared / name, f"{bucket}/{name}")
    for read, name in (
        (opsim.read, sorted((shared / "opsim").glob("*.db"))[0]),
        (obseq.read, sorted((shared / "roman_obseq").glob("*.fits"))[0]),
    ):
        pd.testing.assert_frame_equal(read(parse_path(f"{bucket}/{name.relative_to(shared)}")), read(name))
    name = next(
        path.name for path in sorted((shared / "dc2_instance_catalog").iterdir()) if path.name.startswith("example")
    )
    local, remote = (
        instance_catalog.open_source(folder / name)
        for folder in (shared / "dc2_instance_catalog", parse_path(f"{bucket}/dc2"))
    )
    assert [batch.name for batch in local.batches()] == [batch.name for batch in remote.batches()]
    for first, second in zip(local.batches(), remote.batches(), strict=True):
        pd.testing.assert_frame_equal(local.read(first), remote.read(second))


def test_an_unreachable_store_is_reported_in_one_line(bucket, monkeypatch):
    commands = [
        ("status", "s3://nobucket/tiny"),
        ("run", "tiny", "--store", "s3://nobucket/tiny"),
        ("plan", "s3://no/p.yaml"),
    ]
    for arguments in commands:
        done = command(*arguments)
        assert done.returncode == 2, done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert done.stderr.startswith("error: s3://no")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    done = command("status", f"{bucket}/tiny")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
