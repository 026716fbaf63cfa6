"""Schedule of stages: when each starts, which run at the same time, and which units are submitted first."""

import io
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from conftest import MINI
from rich.console import Console

from romandask import run as running
from romandask.engine.clients import runner
from romandask.engine.event_log import Log, events
from romandask.engine.progress import Reporter
from romandask.engine.run_stages import Run, RunnableStage, run_stages
from romandask.engine.runners import InProcess
from romandask.model.errors import UserError
from romandask.pipeline import load_pipeline
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.report.stage_diagram import _reduced, kinds_read
from romandask.stage_graph import STAGES, stage_products
from romandask.storage.checksums import remove_checksums
from romandask.storage.store import Store
from romandask.survey import Survey

SCHEMA = pa.schema([("number", pa.int64())])


@dataclass(frozen=True)
class WaitingMaker:
    """Makes one row per unit, after a file exists."""

    wait_for: Path | None = None
    """File to wait for."""
    creates: Path | None = None
    """File that is created with each unit."""
    failing: tuple[int, ...] = ()
    """Units that raise an error."""
    patience: float = 60.0
    """Time after which waiting is an error, s."""

    def __call__(self, index: int) -> pd.DataFrame:
        deadline = time.monotonic() + self.patience
        while self.wait_for is not None and not self.wait_for.exists():
            assert time.monotonic() < deadline, f"{self.wait_for} was not made in {self.patience} s"
            time.sleep(0.02)
        if index in self.failing:
            raise ArithmeticError(f"unit {index} cannot be made")
        if self.creates is not None:
            self.creates.touch()
        return pd.DataFrame({"number": np.array([index], np.int64)})


def stage_of(name, units, maker, inputs=(), seconds=0.0):
    product = TableProduct(
        stage=name,
        units=tuple(Unit(f"u{k}", k, inputs) for k in range(units)),
        make=maker,
        schema=SCHEMA,
        seconds_per_unit=seconds,
    )
    reads = frozenset(stage for stage, _ in inputs)
    return RunnableStage(name=name, product=lambda: product, reads=reads)


def logged_events(stages, folder, execution=None):
    """Run some stages; return the logged events, in order, as (event, stage, unit), and the summary."""
    store = Store(folder / "store")
    this = Run(store, execution or InProcess(), Reporter(Console(file=io.StringIO())), Log(store.log), False)
    with this.ends:
        run_stages(stages, this)
    logged = [(event["event"], event["stage"], event.get("unit")) for event in events(store.log, this.log.name)]
    return logged, this.summary


@pytest.mark.slow
def test_independent_stages_run_at_the_same_time(tmp_path):
    """The only coadd waits for a file that is created by a unit of the last stage."""
    flag = tmp_path / "flag"
    stages = [
        stage_of("coadds/x", 1, WaitingMaker(wait_for=flag), seconds=60.0),
        stage_of("detections/x", 2, WaitingMaker(), (("coadds/x", "u0"),)),
        stage_of("truth_index/x", 3, WaitingMaker(creates=flag)),
    ]
    with runner(2, 1.5) as execution:
        logged, summary = logged_events(stages, tmp_path, execution)
    assert summary.made == {"coadds/x": 1, "detections/x": 2, "truth_index/x": 3}
    assert not summary.failed
    assert [stage for event, stage, _ in logged if event == "stage"] == ["coadds/x", "detections/x", "truth_index/x"]
    position = {event: k for k, event in enumerate(logged)}
    assert position["unit", "detections/x", "u0"] > position["unit", "coadds/x", "u0"], "a reader is made later"


def test_in_one_process_stages_run_in_order(tmp_path):
    stages = [
        stage_of("coadds/x", 2, WaitingMaker()),
        stage_of("detections/x", 2, WaitingMaker(), (("coadds/x", "u0"), ("coadds/x", "u1"))),
        stage_of("truth_index/x", 1, WaitingMaker()),
    ]
    logged, _ = logged_events(stages, tmp_path)
    units = [stage for event, stage, _ in logged if event == "unit"]
    assert units == ["coadds/x", "coadds/x", "detections/x", "detections/x", "truth_index/x"]


def test_a_product_is_built_after_the_stages_that_determine_its_units(tmp_path):
    """The stage reads no units of them, and still waits."""
    recorded, store = [], Store(tmp_path / "store")

    def build():
        recorded.append([*store.recorded("truth/stars"), *store.recorded("pointings/x")])
        return TableProduct(stage="exposures/x", units=(Unit("u0", 0),), make=WaitingMaker(), schema=SCHEMA)

    stages = [
        stage_of("truth/stars", 1, WaitingMaker()),
        stage_of("pointings/x", 1, WaitingMaker()),
        RunnableStage(name="exposures/x", product=build, known_after=frozenset({"truth/stars", "pointings/x"})),
    ]
    logged_events(stages, tmp_path)
    assert recorded
    assert all(names == ["u0", "u0"] for names in recorded), recorded


def test_a_failed_unit_blocks_only_the_units_that_need_it(tmp_path):
    stages = [
        stage_of("coadds/x", 2, WaitingMaker(failing=(1,))),
        stage_of("detections/x", 1, WaitingMaker(), (("coadds/x", "u1"),)),
        stage_of("shear/x", 1, WaitingMaker(), (("coadds/x", "u0"),)),
    ]
    _, summary = logged_events(stages, tmp_path)
    assert summary.failed == ["coadds/x/u1", "detections/x/u0 (an input is missing)"]
    assert summary.made == {"coadds/x": 1, "detections/x": 0, "shear/x": 1}


def test_stages_that_wait_for_one_another_raise_an_error(tmp_path):
    stages = [
        stage_of("a/x", 1, WaitingMaker(), (("b/x", "u0"),)),
        stage_of("b/x", 1, WaitingMaker(), (("a/x", "u0"),)),
    ]
    with pytest.raises(RuntimeError, match="wait for one another: a/x, b/x"):
        logged_events(stages, tmp_path)


@dataclass(frozen=True)
class NamingMaker:
    """Makes one row per unit, and appends the name of the stage and the unit to a file."""

    path: Path
    stage: str
    value: int = 0

    def __call__(self, index: int) -> pd.DataFrame:
        with self.path.open("a") as file:
            file.write(f"{self.stage}/u{index} ")
        return pd.DataFrame({"number": np.array([index + self.value], np.int64)})


def chain(folder, value=0, settings=0):
    """Return three stages: two coadds of one exposure each, and a detection of both coadds."""
    path = folder / "made"

    def stage(name, inputs_of, units, value=0, settings=0):
        made = tuple(Unit(f"u{k}", settings, inputs_of(k)) for k in range(units))
        maker = NamingMaker(path, name, value)
        product = TableProduct(stage=name, units=made, make=maker, schema=SCHEMA)
        reads = frozenset(source for unit in made for source, _ in unit.inputs)
        return RunnableStage(name=name, product=lambda: product, reads=reads)

    return [
        stage("exposures/x", lambda k: (), 2, value, settings),
        stage("coadds/x", lambda k: (("exposures/x", f"u{k}"),), 2),
        stage("detections/x", lambda k: (("coadds/x", "u0"), ("coadds/x", "u1")), 1),
    ]


def made_in(folder):
    path = folder / "made"
    names = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return names


def test_units_whose_inputs_are_made_again_without_a_change_are_kept(tmp_path):
    """Only the setting of the exposures changes, and then their content."""
    _, summary = logged_events(chain(tmp_path), tmp_path)
    assert summary.made == {"exposures/x": 2, "coadds/x": 2, "detections/x": 1}
    assert len(made_in(tmp_path)) == 5
    _, summary = logged_events(chain(tmp_path, settings=1), tmp_path)
    assert made_in(tmp_path) == ["exposures/x/u0", "exposures/x/u1"]
    assert summary.made == {"exposures/x": 2, "coadds/x": 0, "detections/x": 0}
    assert summary.kept == {"exposures/x": 0, "coadds/x": 2, "detections/x": 1}
    _, summary = logged_events(chain(tmp_path, settings=1, value=5), tmp_path)
    assert not made_in(tmp_path), "the code of a maker is not part of the input hash, its settings are"
    logged, summary = logged_events(chain(tmp_path, settings=2, value=5), tmp_path)
    assert summary.made == {"exposures/x": 2, "coadds/x": 2, "detections/x": 0}, "the rows of coadds are as before"
    assert [event for event in logged if event[0] == "unit"][-1][1] == "coadds/x"


def test_a_unit_is_made_without_an_optional_input_that_failed(tmp_path):
    """Zero points use the detections that are there; a unit that needs a failed one is skipped."""
    zero = TableProduct(
        stage="zero_points/x",
        units=(Unit("all", 0, optional=(("detections/x", "u0"), ("detections/x", "u1"))),),
        make=WaitingMaker(),
        schema=SCHEMA,
    )
    stages = [
        stage_of("detections/x", 2, WaitingMaker(failing=(1,))),
        RunnableStage(name="zero_points/x", product=lambda: zero, reads=frozenset({"detections/x"})),
        stage_of("objects/x", 1, WaitingMaker(), (("zero_points/x", "all"), ("detections/x", "u0"))),
        stage_of("matches/x", 1, WaitingMaker(), (("zero_points/x", "all"), ("detections/x", "u1"))),
    ]
    _, summary = logged_events(stages, tmp_path)
    assert summary.made == {"detections/x": 1, "zero_points/x": 1, "objects/x": 1, "matches/x": 0}
    assert summary.failed == ["detections/x/u1", "matches/x/u0 (an input is missing)"]
    _, again = logged_events(stages, tmp_path)
    assert not any(again.made.values())
    assert again.failed == ["detections/x/u1 (skipped, it failed before)", "matches/x/u0 (an input is missing)"]


@pytest.mark.slow
def test_a_full_store_ends_the_run(tmp_path, monkeypatch):
    def full(error, store):
        raise UserError(f"{store.root}: no space left")

    monkeypatch.setattr("romandask.engine.run_stages.refuse_full", full)
    stages = [
        stage_of("coadds/x", 1, WaitingMaker(failing=(0,))),
        stage_of("truth_index/x", 40, WaitingMaker(wait_for=tmp_path / "never", patience=1.0)),
    ]
    with runner(1, 1.5) as execution:
        # the coadd is tried three times, and other units have their turn between
        with pytest.raises(UserError, match="no space left"):
            logged_events(stages, tmp_path, execution)
        deadline = time.monotonic() + 30
        while execution._client.futures and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not execution._client.futures, "submitted tasks are cancelled"
        (tmp_path / "never").touch()


def test_catalog_metadata_without_checksums_is_written_again(tmp_path, monkeypatch):
    """All units of a catalog were made again, but the run was interrupted before it wrote the metadata."""
    written = []
    monkeypatch.setattr(
        "romandask.engine.run_stages.write_catalog_files", lambda product, *_: written.append(product.stage)
    )
    monkeypatch.setattr("romandask.engine.run_stages.catalog_metadata_files", lambda *_: [])
    stage = replace(stage_of("objects/x", 1, WaitingMaker()), sky=("ra", "dec"))
    logged_events([stage], tmp_path)
    assert written == ["objects/x"]
    store = Store(tmp_path / "store")
    (store.catalog("objects/x")).mkdir(parents=True, exist_ok=True)
    (store.catalog("objects/x") / "hats.properties").touch()
    logged_events([stage], tmp_path)
    assert written == ["objects/x"], "not written if no unit was made"
    remove_checksums(store, "objects/x")
    logged_events([stage], tmp_path)
    assert written == ["objects/x"] * 2


@pytest.mark.slow
def test_units_that_are_read_are_stored(tmp_path, monkeypatch):
    """A stage that starts too early would compute the units it reads itself, slowly and with unplanned memory."""
    pipeline = load_pipeline("tiny", [*MINI, "roman.detector=sca"])
    stage_names = {product.name for product in stage_products(Survey(pipeline))}

    def check_reads(product_class, name):
        method = getattr(product_class, name)

        def call(product, index, *arguments, **others):
            stored = product.store is None or product.stage not in stage_names or product.has(index)
            assert stored, f"{product.stage}/{product.names[index]} is read and is not stored"
            return method(product, index, *arguments, **others)

        monkeypatch.setattr(product_class, name, call)

    for product_class, name in ((TableProduct, "load"), (TableProduct, "select"), (ImageProduct, "load")):
        check_reads(product_class, name)
    survey = Survey(pipeline, Store(tmp_path / "store"))
    survey.store.prepare()
    summary = running.run(survey, InProcess(), Reporter(Console(file=io.StringIO())))
    assert not summary.failed
    assert set(summary.made) == stage_names


EVERY_OPTION = [
    ("tiny",),
    ("tiny", "roman.detector=sca"),
    ("tiny", "roman.detector=sca", "rubin.mode=visits"),
    ("one_tile",),
    ("joint_tile",),
]


@pytest.mark.parametrize("settings", EVERY_OPTION, ids=" ".join)
def test_units_read_what_their_stage_declares(settings):
    """The declarations determine when a stage starts: a unit must not read anything else."""
    survey = Survey(load_pipeline(settings[0], list(settings[1:])))
    for one in stage_products(survey):
        product = survey.product(one.name)
        assert product.stage == one.name
        units = product.units[:: max(1, len(product.units) // 50)]
        read = {stage for unit in units for stage, _ in (*unit.inputs, *unit.optional)}
        assert read <= one.reads, one.name


def test_units_of_source_catalogs_read_what_their_stage_declares(shared):
    survey = Survey(load_pipeline("dc2_sample", [f"data={shared}"]))
    for one in stage_products(survey):
        read = {stage for unit in survey.product(one.name).units for stage, _ in (*unit.inputs, *unit.optional)}
        assert read <= one.reads, one.name


def test_every_stage_is_after_the_stages_that_it_reads():
    for settings in EVERY_OPTION:
        before = set()
        for one in stage_products(Survey(load_pipeline(settings[0], list(settings[1:])))):
            assert one.reads | one.known_after <= before, one.name
            before.add(one.name)
    assert len({stage.name for stage in STAGES}) == len(STAGES)


def test_the_stage_diagram_has_an_arrow_for_each_direct_read():
    arrows = _reduced(kinds_read(stage_products(Survey(load_pipeline("tiny")))))
    assert arrows["exposures"] == {"truth", "psf_models"}
    assert arrows["psf_models"] == {"pointings"}
    assert arrows["coadds"] == {"exposures"}, "indirect reads are not drawn"
    assert arrows["differences"] == arrows["truth_match"] == {"detections"}
    assert arrows["truth_index"] == {"truth", "psf_models"}
    assert arrows["statistics"] == {"matches", "chance"}
    assert not arrows["truth"]
    assert not arrows["pointings"]
    arrows = _reduced(kinds_read(stage_products(Survey(load_pipeline("tiny", ["roman.detector=sca"])))))
    assert arrows["exposures"] == {"truth", "psf_models"}
    assert arrows["psf_models"] == {"calibration"}
    assert arrows["calibration"] == {"pointings"}
    assert arrows["coadds"] == {"exposures"}
