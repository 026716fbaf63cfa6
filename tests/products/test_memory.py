"""The peak memory that stages declare, for units of full size: detectors of 4088 and 4096 pixels, tiles of 8825.

The memory depends on the image planes and hardly on the sources, so these surveys have few sources. The figures of the
pipeline `one_tile` are from a run at the true density.
"""

import json
from pathlib import Path

import pytest
from conftest import command

from romandask.products.memory import INTERPRETER
from romandask.stage_graph import stages
from romandask.storage.manifest import read_records
from romandask.survey import open_survey

FEW_SOURCES = ("truth.galaxies=1", "truth.nside=64", "run.memory_limit=2.0")
CASES = {
    "tile": (
        "one_tile",
        "roman.bands=[H158]",
        "roman.pointings.dithers={H158: [2]}",
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


@pytest.mark.parametrize("case", CASES)
def test_no_unit_exceeds_the_memory_that_its_stage_declares(case, tmp_path):
    """One worker of 2 GiB makes all units one after another, with the memory that stays on its heap, and survives."""
    pipeline, *overrides = CASES[case]
    done = command("run", pipeline, "--store", "s", "--workers", "1", *overrides, *FEW_SOURCES, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    survey, exceeded = open_survey(tmp_path / "s"), {}
    for stage in stages(survey):
        declared = stage.product(survey).bytes_per_unit + INTERPRETER
        for name, record in read_records(survey.store, stage.name):
            if record.peak_bytes > declared:
                exceeded[f"{stage.name}/{name}"] = (record.peak_bytes / 2**30, declared / 2**30)
            assert not [text for text in record.warnings if "memory" in text], (stage.name, name)
    assert not exceeded
    log = next((tmp_path / "s" / "log").glob("*.jsonl"))
    units = [event for event in map(json.loads, Path(log).read_text().splitlines()) if event["event"] == "unit"]
    assert len({(event["stage"], event["unit"]) for event in units}) == len(units), (
        "each unit was made once: no worker was lost"
    )
