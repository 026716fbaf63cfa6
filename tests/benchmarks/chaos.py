"""Faults at random: after each, the same command makes the same bytes as a clean run, and little of it twice.

python tests/benchmarks/chaos.py [kills of the driver, 20] [kills of workers, 20] [damaged bytes and cuts, 200]

A small survey of two telescopes on two workers. Needs the right to mount a tmpfs for the full and the read-only disk;
without it these two are left out, and it says so.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from conftest import MINI
from output_hashes import output_hashes

from romandask.engine.event_log import events, runs
from romandask.export import sha256sums
from romandask.export.asdf import export_asdf
from romandask.export.fits import export_fits
from romandask.export.meds import export_meds
from romandask.export.moc import export_moc
from romandask.export.psf import export_psf
from romandask.export.truth import export_truth
from romandask.model.seeds import rng
from romandask.model.sky import Cone
from romandask.run import verify_store
from romandask.survey import open_survey

WORKERS = 2
RUN = (sys.executable, "-m", "romandask", "run", "tiny", "--workers", str(WORKERS), *MINI)


def start(store: Path) -> subprocess.Popen:
    return subprocess.Popen([*RUN, "--store", str(store)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(store: Path, *more: str) -> tuple[int, str]:
    done = subprocess.run([*RUN, "--store", str(store), *more], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def made(store: Path) -> Counter[str]:
    """How often each unit was made, from the logs of all runs."""
    return Counter(
        f"{event['stage']}/{event['unit']}"
        for run in runs(store / "log")
        for event in events(store / "log", run)
        if event["event"] == "unit"
    )


def twice(store: Path) -> int:
    """How many units the logs of all runs have more than once."""
    return sum(count - 1 for count in made(store).values())


def children(pid: int) -> list[int]:
    """The processes that a process has started, and theirs."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(path.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
        if parent == pid:
            found += [int(path.parent.name), *children(int(path.parent.name))]
    return found


def workers_of(pid: int) -> list[int]:
    """The worker processes of a driver: what it spawned to run units."""
    found = []
    for child in children(pid):
        try:
            line = Path(f"/proc/{child}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in line and b"resource_tracker" not in line:
            found.append(child)
    return found


def kill_drivers(folder: Path, clean: dict[str, str], length: float, count: int, random: np.random.Generator) -> None:
    """Kill the driver again and again on its way through one store, until it has been killed so often."""
    killed, stores, lost, repeated = 0, 0, 0, 0
    while killed < count:
        store, stores = folder / f"driver-{stores}", stores + 1
        here = 0
        while killed < count:
            driver = start(store)
            try:
                driver.communicate(timeout=float(random.uniform(6, length)))
            except subprocess.TimeoutExpired:
                os.kill(driver.pid, signal.SIGKILL)
                driver.communicate()
                killed, here = killed + 1, here + 1
                continue
            break
        code, text = finish(store)
        lost += code != 0 or output_hashes(store) != clean
        if code:
            print(text[-2000:])
        repeated += twice(store)
        shutil.rmtree(store)
    print(
        f"driver killed {killed} times in {stores} stores: {stores - lost} of {stores} as the clean run; "
        f"{repeated} units made twice, {repeated / killed:.2f} a kill, {WORKERS} allowed"
    )


def kill_workers(folder: Path, clean: dict[str, str], count: int, random: np.random.Generator) -> None:
    """Kill a worker now and then; the run goes on by itself."""
    killed, stores, lost, repeated = 0, 0, 0, 0
    while killed < count:
        store, stores = folder / f"worker-{stores}", stores + 1
        driver = start(store)
        # the start of the cluster has its own test: here units are in flight
        while driver.poll() is None and not made(store):
            time.sleep(0.5)
        while driver.poll() is None and killed < count:
            time.sleep(float(random.uniform(1, 5)))
            chosen = workers_of(driver.pid)
            if chosen and driver.poll() is None:
                os.kill(int(random.choice(chosen)), signal.SIGKILL)
                killed += 1
        text, _ = driver.communicate()
        code = driver.returncode
        if code:
            print(text[-1500:])
            code, _ = finish(store, "--retry-failed")
        lost += code != 0 or output_hashes(store) != clean
        repeated += twice(store)
        shutil.rmtree(store)
    print(
        f"workers killed {killed} times in {stores} runs, units in flight: {stores - lost} of {stores} as the clean "
        f"run; {repeated} units in the logs twice"
    )


@contextmanager
def harmed(path: Path, cut: bool, random: np.random.Generator) -> Iterator[None]:
    """Change a bit of a file, or cut it; afterwards it is as it was."""
    content = path.read_bytes()
    place = int(random.integers(len(content)))
    changed = bytearray(content)
    changed[place] ^= 1 << int(random.integers(8))
    path.write_bytes(content[:place] if cut else changed)
    try:
        yield
    finally:
        path.write_bytes(content)


def damage(store: Path, count: int, random: np.random.Generator) -> None:
    """Harm files of a store, one at a time, and look whether it is found."""
    files = [path for path in sorted(store.rglob("*")) if path.is_file() and path.stat().st_size]
    files = [path for path in files if path.relative_to(store).parts[0] not in ("report", "log", ".lock")]

    def found(path: Path) -> bool:
        try:
            return any(one.damaged for one in verify_store(open_survey(store)))
        except Exception:
            # at reading
            return True

    harm_and_look("the store", files, found, count, random)


def damage_exports(store: Path, folder: Path, count: int, random: np.random.Generator) -> None:
    """The same of exported files, an exposure and a tile in every format."""
    survey = open_survey(store)
    roman, tile = survey.output("exposures/roman").names[0], survey.tiles[0]
    written = export_fits(survey, folder, "roman", [roman], [tile.name], [])
    written += export_asdf(survey, folder, [roman], [tile.name], [])
    written += export_truth(survey, folder) + export_psf(survey, folder, [roman]) + export_moc(survey, folder)
    written += export_meds(survey, folder, Cone(tile.ra, tile.dec, 8.0), [], 32, "truth")
    for path in written:
        sha256sums.note(path)
    harm_and_look("exports", written, lambda path: bool(dict(sha256sums.check(folder))[path.name]), count, random)
    assert not any(why for _, why in sha256sums.check(folder))


def harm_and_look(
    what: str, files: list[Path], found: Callable[[Path], bool], count: int, random: np.random.Generator
) -> None:
    """Harm some of the files at random, every fourth time by a cut, and say how often that was found."""
    kinds: Counter[str] = Counter()
    missed = []
    for number in range(count):
        path = files[int(random.integers(len(files)))]
        with harmed(path, number % 4 == 3, random):
            if not found(path):
                missed.append(path.name)
        kinds[path.suffix or "chunk"] += 1
    print(f"{count} flips and cuts over {what} {dict(kinds)}: {count - len(missed)} found; missed: {missed or 'none'}")


def full_disk(folder: Path, clean: dict[str, str]) -> None:
    """A disk of too few bytes, then one that may not be written, then room."""
    disk = folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=40m", "tmpfs", disk], check=False).returncode:
        print("full disk: left out, a tmpfs cannot be mounted here")
        return
    try:
        code, text = finish(disk / "s")
        print(f"full disk: exit code {code}: {text.strip().splitlines()[-1]}")
        assert "Traceback" not in text
        kept = len(output_hashes(disk / "s"))
        subprocess.run(["mount", "-o", "remount,ro,size=40m", disk], check=True)
        code, text = finish(disk / "s")
        print(f"read-only disk: exit code {code}: {text.strip().splitlines()[-1]}")
        assert "Traceback" not in text
        subprocess.run(["mount", "-o", "remount,rw,size=2g", disk], check=True)
        code, text = finish(disk / "s")
        same = output_hashes(disk / "s") == clean
        print(f"room again: exit code {code}, {kept} units were kept, as the clean run: {same}")
    finally:
        subprocess.run(["umount", disk], check=False)


def main(drivers: int, workers: int, flips: int) -> None:
    random = rng(7, "chaos")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.perf_counter()
        code, text = finish(folder / "clean")
        length = time.perf_counter() - began
        assert code == 0, text
        clean = output_hashes(folder / "clean")
        print(f"clean run: {len(clean)} units in {length:.0f} s\n  {shlex.join(RUN[3:])}")
        full_disk(folder, clean)
        damage(folder / "clean", flips, random)
        (folder / "exports").mkdir()
        damage_exports(folder / "clean", folder / "exports", flips, random)
        kill_workers(folder, clean, workers, random)
        kill_drivers(folder, clean, length, drivers, random)


if __name__ == "__main__":
    main(*(int(value) for value in (sys.argv[1:] + ["20", "20", "200"][len(sys.argv) - 1 :])))
