"""The memory that stages state, at the full size of their units: detectors of 4088 and 4096 pixels, patches of 2208.

Planes decide it, hardly the sources: these skies are thin, and a tile has 2 x 2 of the survey's 4 x 4 patches. A run at
the true density and size is in the figures of `one_tile`.
"""

import json
from pathlib import Path

import pytest
from conftest import command

from romandask.products.memory import INTERPRETER
from romandask.stage_graph import stage_products
from romandask.storage.manifest import read_records
from romandask.survey import open_survey

pytestmark = pytest.mark.slow

THIN = ("truth.galaxies=1", "truth.nside=64", "run.memory_limit=2.0")
CASES = {
    "tile": (
        "one_tile",
        "roman.bands=[H158]",
        "roman.pointings.dithers={H158: [2]}",
        "coadds.pixels=4415",
        "region.ra=[53.05, 53.06]",
        "region.dec=[-39.95, -39.94]",
        "truth.margin=15",
    ),
    "detectors": (
        "tiny",
        "roman.detector=sca",
        "roman.cosmic_rays=true",
        "roman.bands=[Y106]",
        "roman.pointings.dithers={Y106: [2]}",
        "rubin.mode=visits",
        "rubin.bands=[y]",
        "rubin.pointings.visits={y: 3}",
        "rubin.cosmic_rays=true",
        "coadds.pixels=600",
        "coadds.overlap=60",
        "region.ra=[53.0151, 53.0161]",
        "region.dec=[-40.008, -40.007]",
    ),
}


def made(case: str, store: Path) -> list[dict]:
    """Run a case with one worker of 2 GiB; return the events of its log."""
    pipeline, *overrides = CASES[case]
    done = command("run", pipeline, "--store", store.name, "--workers", "1", *overrides, *THIN, cwd=store.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    log = next((store / "log").glob("*.jsonl"))
    return [json.loads(line) for line in log.read_text().splitlines()]


@pytest.mark.parametrize("case", CASES)
def test_no_unit_takes_more_than_its_stage_states(case, tmp_path):
    """A worker of 2 GiB makes them all, one after another, with what stays in its heap; none is lost.

    A unit does not take more than it states on top of what the worker held before (there is no warning), and no unit
    brings the worker above the largest statement of all stages, which the plan compares with the limit. This holds for
    compiled kernels: the worker that compiles them, on the first run of an installation, needs more and may be lost.
    """
    store = tmp_path / "first"
    events = made(case, store)
    if any(event["event"] == "lost" for event in events):
        store = tmp_path / "second"
        events = made(case, store)
    assert not [event for event in events if event["event"] == "lost"]
    survey, peaks, states = open_survey(store), {}, []
    for stage in stage_products(survey):
        for name, record in read_records(survey.store, stage.name):
            states.append(survey.product(stage.name).bytes_per_unit + INTERPRETER)
            peaks[f"{stage.name}/{name}"] = record.peak_bytes
            assert not [text for text in record.warnings if "memory" in text], (stage.name, name)
    largest = max(peaks, key=peaks.get)
    assert peaks[largest] <= max(states), (largest, peaks[largest] / 2**30, max(states) / 2**30)
    units = [event for event in events if event["event"] == "unit"]
    assert len({(event["stage"], event["unit"]) for event in units}) == len(units), "made once each: no worker was lost"
