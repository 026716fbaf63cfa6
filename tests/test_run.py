"""Runs: the same bytes for any number of workers and after a kill; only stale units are made again."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import MINI, MINI_RUN, ROOT, command
from output_hashes import output_hashes

pytestmark = pytest.mark.slow

STAGES = (
    "truth/galaxies",
    "exposures/roman",
    "coadds/roman",
    "coadds/rubin",
    "objects/roman",
    "matches/groups",
    "statistics/blends",
)


def products(store: Path) -> dict[str, bytes]:
    """Return the bytes of every file of the products; manifest, logs, report and stored settings are left out."""
    skipped = ("manifest", "report", "log", "pipeline.yaml", "versions.json", ".lock")
    paths = [path for path in store.rglob("*") if path.is_file() and path.relative_to(store).parts[0] not in skipped]
    texts = {"zarr.json", "hats.properties"}
    return {str(path.relative_to(store)): path.read_bytes() for path in paths if path.name not in texts}


@pytest.fixture(scope="module")
def one_worker(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("one")
    done = command("run", "tiny", "--store", "s", "--workers", "1", *MINI, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "dashboard http://127.0.0.1:" in done.stdout
    found = output_hashes(folder / "s")
    assert all(any(name.startswith(stage) for name in found) for stage in STAGES)
    return folder / "s"


def test_a_run_leaves_a_log_of_its_units_and_what_the_cluster_did(one_worker):
    (path,) = (one_worker / "log").glob("*.jsonl")
    found = [json.loads(line) for line in path.read_text().splitlines()]
    units = {f"{one['stage']}/{one['unit']}" for one in found if one["event"] == "unit"}
    assert units == set(output_hashes(one_worker))
    assert found[0]["event"] == "run"
    assert found[0]["versions"]["romandask"]
    assert found[-1] == {
        "time": found[-1]["time"],
        "event": "end",
        "how": "done",
        "made": len(units),
        "kept": 0,
        "failed": 0,
    }
    page = path.with_suffix(".html").read_text()
    assert "coadds/roman" in page
    for line in re.findall(r"<(?:script|link)[^>]*>", page):
        assert "http" not in line


def test_two_workers_and_a_killed_driver_give_the_same_bytes(one_worker, tmp_path):
    """Started with two workers, killed with SIGKILL once exposures exist, then the same command again."""
    arguments = [sys.executable, "-m", "romandask", *MINI_RUN, "--workers", "2"]
    driver = subprocess.Popen(arguments, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    manifest = tmp_path / "s" / "manifest" / "exposures" / "roman"
    deadline = time.monotonic() + 240
    while not list(manifest.glob("*.json")):
        assert time.monotonic() < deadline
        assert driver.poll() is None
        time.sleep(0.1)
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    before = {name for name in output_hashes(tmp_path / "s") if name.startswith(("truth", "pointings"))}
    done = command(*MINI_RUN, "--workers", "2", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert before
    assert int(done.stdout.split("kept ")[1].split(",")[0]) >= len(before)
    assert output_hashes(tmp_path / "s") == output_hashes(one_worker)
    assert products(tmp_path / "s") == products(one_worker)


def test_a_rerun_has_nothing_to_do_and_a_changed_setting_makes_only_what_depends_on_it(one_worker):
    again = command(*MINI_RUN, cwd=one_worker.parent)
    assert again.returncode == 0, again.stderr
    assert "nothing to do" in again.stdout
    kept = {path: path.stat().st_mtime_ns for path in (one_worker / "manifest" / "coadds").rglob("*.json")}
    before = output_hashes(one_worker)
    changed = command(*MINI_RUN, "detections.min_snr=8", cwd=one_worker.parent)
    assert changed.returncode == 0, changed.stdout + changed.stderr
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items()), "coadds do not depend on detection"
    after = output_hashes(one_worker)
    assert any(after[name] != value for name, value in before.items() if name.startswith("detections"))
    back = command(*MINI_RUN, cwd=one_worker.parent)
    assert back.returncode == 0
    assert output_hashes(one_worker) == before


def test_an_interrupt_leaves_a_store_that_the_same_command_resumes(tmp_path, one_worker):
    arguments = [sys.executable, "-m", "romandask", *MINI_RUN, "--workers", "1"]
    driver = subprocess.Popen(
        arguments,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a process in the background ignores interrupts, and its children inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 240
    while not (tmp_path / "s" / "manifest" / "pointings").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(driver.pid, signal.SIGINT)
    _, errors = driver.communicate(timeout=60)
    assert driver.returncode == 130
    assert "the same command resumes" in errors
    assert "Traceback" not in errors
    assert not (tmp_path / "s" / ".lock").exists()
    done = command(*MINI_RUN, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert output_hashes(tmp_path / "s") == output_hashes(one_worker)


def test_a_damaged_unit_fails_by_name_and_the_rest_goes_on(mini_store, tmp_path):
    """If an exposure cannot be read, the units that need it fail with a traceback, and the exit code is 1.

    They are skipped after failure until --retry-failed; once the exposure is repaired, the output is as before, also
    where the files of the units themselves are torn.
    """
    shutil.copytree(mini_store, tmp_path / "s")
    shard = next((tmp_path / "s" / "exposures" / "roman.zarr" / "image" / "c").rglob("0"))
    record = next((tmp_path / "s" / "manifest" / "coadds" / "roman").glob("*.json"))
    before = output_hashes(tmp_path / "s")
    record.unlink()
    for path in shard.parent.rglob("*"):
        if path.is_file():
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 0x40
            path.write_bytes(content)
    for path in (tmp_path / "s" / "coadds" / "roman.zarr" / "image" / "c").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    failed = command(*MINI_RUN, cwd=tmp_path)
    assert failed.returncode == 1, failed.stdout
    assert "failed: coadds/roman/" in failed.stdout
    (reason,) = (tmp_path / "s" / "manifest" / "coadds" / "roman").glob("*.failed")
    written = reason.stat().st_mtime_ns
    assert "Traceback" in reason.read_text()
    again = command(*MINI_RUN, cwd=tmp_path)
    assert again.returncode == 1
    assert f"failed: coadds/roman/{reason.stem} (skipped, it failed before)" in again.stdout
    assert "--retry-failed" in again.stdout
    assert reason.stat().st_mtime_ns == written
    assert command("verify", str(tmp_path / "s"), "--forget").returncode == 1
    mended = command(*MINI_RUN, "--retry-failed", cwd=tmp_path)
    assert mended.returncode == 0, mended.stdout
    assert not reason.exists()
    assert output_hashes(tmp_path / "s") == before


def test_a_dry_run_explains_which_units_are_stale(one_worker):
    def dry_run(*arguments: str) -> str:
        done = command("run", "tiny", "--store", "s", *MINI, "--dry-run", *arguments, cwd=one_worker.parent)
        assert done.returncode == 0, done.stderr
        return done.stdout

    before = output_hashes(one_worker)
    command(*MINI_RUN, cwd=one_worker.parent)
    assert dry_run().strip() == "every other unit is kept"
    lines = {line.split()[0]: line for line in dry_run("detections.min_snr=8").splitlines() if " make " in line}
    assert "changed: settings" in lines["detections/roman"]
    assert "changed: detections/roman" in lines["zero_points/roman"]
    assert not any(name.startswith(("truth/", "exposures", "coadds")) for name in lines)
    # a change of any setting of the rendering makes exposures stale
    for setting in ("roman.psf_degree=1", "roman.charge_diffusion=0.3", "render.truncation=0.1", "seed=4"):
        assert any(line.startswith("exposures/roman ") for line in dry_run(setting).splitlines()), setting
    assert any(line.startswith("coadds/rubin ") for line in dry_run("rubin.atmosphere=von_karman").splitlines())
    only = dry_run("detections.min_snr=8", "--only", "detections/roman").splitlines()
    assert len([line for line in only if " make " in line]) == 1
    assert not any(
        line.startswith("coadds") for line in dry_run("coadds.pixfrac=0.8", "--from", "detections").splitlines()
    )
    assert output_hashes(one_worker) == before
    wrong = command("run", "tiny", "--store", "s", *MINI, "--only", "coads", cwd=one_worker.parent)
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: stage 'coads': this survey has truth")


def test_a_stage_alone_makes_what_its_inputs_allow(tmp_path):
    done = command(*MINI_RUN, "--only", "pointings", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(name.split("/")[0] for name in output_hashes(tmp_path / "s")) == ["pointings", "pointings"]
    early = command(*MINI_RUN, "--only", "coadds/rubin", cwd=tmp_path)
    assert early.returncode == 1
    assert "an input is missing" in early.stdout


def test_workers_of_a_cluster_elsewhere_make_the_same(one_worker, tmp_path):
    """Scheduler and worker are separate processes in separate folders; a run that does not fit them is refused."""
    arguments = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(tmp_path / "s.json")]
    environment = os.environ | {"DASK_CONFIG": str(ROOT / "pipelines" / "cluster" / "workers.yaml")}

    def process(*words: str) -> subprocess.Popen:
        folder = tmp_path / words[0]
        folder.mkdir()
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *words],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    scheduler = process("scheduler", *arguments)
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "s.json").exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        address = json.loads((tmp_path / "s.json").read_text())["address"]
        assert address.startswith("tcp://127.0.0.1:")
        worker = process("worker", address, "--nthreads", "1", "--memory-limit", "2GiB", "--no-dashboard")
        try:
            some = ["--only", "truth", "--only", "pointings"]
            on = ["--scheduler", address, *MINI, *some]
            done = command("run", "tiny", "--store", "s", *on, cwd=tmp_path)
            assert done.returncode == 0, done.stdout + done.stderr
            made = output_hashes(tmp_path / "s")
            assert made
            assert made == {name: hash_ for name, hash_ in output_hashes(one_worker).items() if name in made}
            wrong = command("run", "tiny", "--store", "t", *on, "run.memory_limit=3", cwd=tmp_path)
            assert wrong.returncode == 2
            assert "a worker has 2.00 GiB, run.memory_limit is 3" in wrong.stderr
            assert not (tmp_path / "t").exists()
        finally:
            worker.terminate()
            worker.wait()
    finally:
        scheduler.terminate()
        scheduler.wait()


def test_status_and_report_of_a_store(one_worker):
    shown = command("status", str(one_worker))
    assert shown.returncode == 0
    assert "exposures/roman" in shown.stdout
    assert "newest run, " in shown.stdout
    watched = command("status", str(one_worker), "--watch")
    assert watched.returncode == 0, watched.stderr
    assert "exposures/roman" in watched.stdout
    made = command("report", str(one_worker))
    assert made.returncode == 0, made.stderr
    page = (one_worker / "report" / "index.html").read_text()
    assert page.count("data:image/png;base64,") >= 6
    assert "http://" not in page
    assert "https://" not in page


def test_a_survey_that_finds_nothing_still_ends_with_a_report(tmp_path):
    """An empty universe: no galaxies, no stars, no objects, no groups."""
    empty = ("truth.galaxies=0", "truth.stars=0", "detections.min_snr=100")
    done = command("run", "tiny", "--store", "s", "--workers", "0", *MINI, *empty, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "data:image/png" in (tmp_path / "s" / "report" / "index.html").read_text()
    assert "Warning" not in done.stderr
