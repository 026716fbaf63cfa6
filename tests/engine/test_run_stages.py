"""Running stages: each begins when what it reads is there, side by side, units of the first ones first."""

import io
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from conftest import MINI
from rich.console import Console

from romandask import run as running
from romandask.engine.clients import InProcess, runner
from romandask.engine.event_log import Log, events
from romandask.engine.progress import Reporter
from romandask.engine.run_stages import Run, RunnableStage, run_stages
from romandask.engine.submission import IN_FLIGHT_PER_THREAD, Submission, submit_units
from romandask.engine.task import Batch, Task
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
class Waits:
    """Makes a row of each unit, once a file is there."""

    wanted: Path | None = None
    made: Path | None = None
    bad: tuple[int, ...] = ()

    def __call__(self, index: int) -> pd.DataFrame:
        deadline = time.monotonic() + 60
        while self.wanted is not None and not self.wanted.exists():
            assert time.monotonic() < deadline, f"{self.wanted} was not made in a minute"
            time.sleep(0.02)
        if index in self.bad:
            raise ArithmeticError(f"unit {index} cannot be made")
        if self.made is not None:
            self.made.touch()
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


def happened_in(stages_, folder, execution=None):
    """Run some stages; return what happened, in order, as (event, stage, unit), and the summary."""
    store = Store(folder / "store")
    this = Run(store, execution or InProcess(), Reporter(Console(file=io.StringIO())), Log(store.log), False)
    with this.ends:
        run_stages(stages_, this)
    found = [(one["event"], one["stage"], one.get("unit")) for one in events(store.log, this.log.name)]
    return found, this.summary


def test_a_stage_that_reads_nothing_of_another_is_made_beside_it(tmp_path):
    """The one coadd ends only when a unit of the index, the last stage of all, has been made."""
    flag = tmp_path / "flag"
    found = [
        stage_of("coadds/x", 1, Waits(wanted=flag), seconds=60.0),
        stage_of("detections/x", 2, Waits(), (("coadds/x", "u0"),)),
        stage_of("truth_index/x", 3, Waits(made=flag)),
    ]
    with runner(2, 1.5) as execution:
        happened, summary = happened_in(found, tmp_path, execution)
    assert summary.made == {"coadds/x": 1, "detections/x": 2, "truth_index/x": 3}
    assert not summary.failed
    assert happened[:2] == [("stage", "coadds/x", None), ("stage", "truth_index/x", None)]
    at = {event: k for k, event in enumerate(happened)}
    assert at["stage", "detections/x", None] > at["unit", "coadds/x", "u0"], "what reads another waits for it"


def test_in_one_process_stages_go_in_order(tmp_path):
    found = [
        stage_of("coadds/x", 2, Waits()),
        stage_of("detections/x", 2, Waits(), (("coadds/x", "u0"), ("coadds/x", "u1"))),
        stage_of("truth_index/x", 1, Waits()),
    ]
    happened, _ = happened_in(found, tmp_path)
    units = [stage for event, stage, _ in happened if event == "unit"]
    assert units == ["coadds/x", "coadds/x", "detections/x", "detections/x", "truth_index/x"]


def test_units_are_not_known_before_truth_and_pointings_are_there(tmp_path):
    """Though it reads nothing, a stage is not even put together before them."""
    asked, store = [], Store(tmp_path / "store")

    def put_together():
        asked.append([*store.recorded("truth/stars"), *store.recorded("pointings/x")])
        return TableProduct(stage="exposures/x", units=(Unit("u0", 0),), make=Waits(), schema=SCHEMA)

    found = [
        stage_of("truth/stars", 1, Waits()),
        stage_of("pointings/x", 1, Waits()),
        RunnableStage(name="exposures/x", product=put_together, known_after=frozenset({"truth/stars", "pointings/x"})),
    ]
    happened_in(found, tmp_path)
    assert asked
    assert all(names == ["u0", "u0"] for names in asked), asked


def test_what_fails_holds_up_only_what_needs_it(tmp_path):
    found = [
        stage_of("coadds/x", 2, Waits(bad=(1,))),
        stage_of("detections/x", 1, Waits(), (("coadds/x", "u1"),)),
        stage_of("shear/x", 1, Waits(), (("coadds/x", "u0"),)),
    ]
    _, summary = happened_in(found, tmp_path)
    assert summary.failed == ["coadds/x/u1", "detections/x/u0 (an input is missing)"]
    assert summary.made == {"coadds/x": 1, "detections/x": 0, "shear/x": 1}


def test_stages_that_wait_for_one_another_are_no_quiet_end(tmp_path):
    found = [stage_of("a/x", 1, Waits(), (("b/x", "u0"),)), stage_of("b/x", 1, Waits(), (("a/x", "u0"),))]
    with pytest.raises(RuntimeError, match="wait for one another: a/x, b/x"):
        happened_in(found, tmp_path)


class Future(SimpleNamespace):
    """What becomes of a task."""

    __hash__ = object.__hash__


class Client:
    """Takes tasks, and ends one when it is told to."""

    def __init__(self):
        self.sent = []

    def submit(self, _function, *arguments, key, workers=(None,), **_):
        future = Future(status="finished", result=lambda: None, release=lambda: None, key=key)
        future.add_done_callback = lambda call: None
        if len(arguments) > 1:
            self.sent.append((key.split("-")[0], workers[0], future))
        return future


def test_of_a_later_stage_nothing_is_handed_out_while_an_earlier_one_has_units_that_wait(tmp_path):
    client, threads = Client(), {"one": 1, "two": 1}

    def wave(name, units, seconds, rank):
        product = TableProduct(
            stage=name,
            units=tuple(Unit(f"u{k}", k) for k in range(units)),
            make=Waits(),
            schema=SCHEMA,
            seconds_per_unit=seconds,
        )
        tasks = [Task(k, "inputs", 1.0) for k in range(units)]
        return Submission(client, Batch(product, tasks, Store(tmp_path), rank), lambda future: None)

    waves = [wave("coadds/x", 3, 60.0, 0), wave("truth_index/x", 100, 1.0, 1)]
    submit_units(waves, threads)
    assert [sent[:2] for sent in client.sent] == [("coadds", "one"), ("coadds", "two")], "long ones one a thread"
    assert waves[0].settle(client.sent[0][2])[0].index == 0
    submit_units(waves, threads)
    assert client.sent[2][:2] == ("coadds", "one"), "to the one that is free"
    assert [name for name, *_ in client.sent[3:]] == ["truth_index"] * (IN_FLIGHT_PER_THREAD * 2 - 2)


def test_units_that_wait_for_others_of_their_stage_do_not_keep_those_of_a_later_one_from_free_workers(tmp_path):
    """Twenty exposures of one detector, each after the one before it: the other worker has the index."""
    client, threads = Client(), {"one": 1, "two": 1}
    first, second = (
        TableProduct(
            stage=name,
            units=tuple(Unit(f"u{k}", k) for k in range(20)),
            make=Waits(),
            schema=SCHEMA,
            seconds_per_unit=seconds,
        )
        for name, seconds in (("exposures/x", 60.0), ("truth_index/x", 1.0))
    )
    chain = [Task(k, "inputs", 20.0 - k, "", (k - 1,) if k else ()) for k in range(20)]
    alone = [Task(k, "inputs", 1.0) for k in range(20)]
    waves = [
        Submission(client, Batch(product, tasks, Store(tmp_path), rank), lambda future: None)
        for rank, (product, tasks) in enumerate([(first, chain), (second, alone)])
    ]
    submit_units(waves, threads)
    sent = [name for name, *_ in client.sent]
    assert sent == ["exposures"] * (1 + IN_FLIGHT_PER_THREAD * 2) + ["truth_index"] * (IN_FLIGHT_PER_THREAD * 2 - 1)


def test_nothing_goes_on_when_the_store_can_take_no_more(tmp_path, monkeypatch):
    def full(error, store):
        raise UserError(f"{store.root}: no space left")

    monkeypatch.setattr("romandask.engine.run_stages.refuse_full", full)
    found = [stage_of("coadds/x", 1, Waits(bad=(0,))), stage_of("truth_index/x", 40, Waits(wanted=tmp_path / "never"))]
    with runner(1, 1.5) as execution:
        with pytest.raises(UserError, match="no space left"):
            happened_in(found, tmp_path, execution)
        deadline = time.monotonic() + 30
        while execution._client.futures and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not execution._client.futures, "what was handed out is taken back"
        (tmp_path / "never").touch()


def test_what_a_run_was_stopped_before_it_could_seal_is_written_again(tmp_path, monkeypatch):
    """All units of a catalog were made anew, but its files are still those of the run before."""
    written = []
    monkeypatch.setattr(
        "romandask.engine.run_stages.write_catalog_files", lambda product, *_: written.append(product.stage)
    )
    monkeypatch.setattr("romandask.engine.run_stages.catalog_metadata_files", lambda *_: [])
    (one,) = [replace(stage_of("objects/x", 1, Waits()), sky=("ra", "dec"))]
    happened_in([one], tmp_path)
    assert written == ["objects/x"]
    store = Store(tmp_path / "store")
    (store.catalog("objects/x")).mkdir(parents=True, exist_ok=True)
    (store.catalog("objects/x") / "hats.properties").touch()
    happened_in([one], tmp_path)
    assert written == ["objects/x"], "nothing was made, nothing is written"
    remove_checksums(store, "objects/x")
    happened_in([one], tmp_path)
    assert written == ["objects/x"] * 2


def test_what_units_read_is_there_when_they_are_made(tmp_path, monkeypatch):
    """A stage that began too early would make what it reads by itself: slowly, and in memory that nobody planned."""
    pipeline = load_pipeline("tiny", [*MINI, "roman.detector=sca"])
    known = {one.name for one in stage_products(Survey(pipeline))}

    def checked(kind, name):
        method = getattr(kind, name)

        def call(product, index, *arguments, **others):
            there = product.store is None or product.stage not in known or product.has(index)
            assert there, f"{product.stage}/{product.names[index]} is read and is not there"
            return method(product, index, *arguments, **others)

        monkeypatch.setattr(kind, name, call)

    for kind, name in ((TableProduct, "load"), (TableProduct, "select"), (ImageProduct, "load")):
        checked(kind, name)
    survey = Survey(pipeline, Store(tmp_path / "store"))
    survey.store.prepare()
    summary = running.run(survey, InProcess(), Reporter(Console(file=io.StringIO())))
    assert not summary.failed
    assert set(summary.made) == known


EVERY_OPTION = [
    ("tiny",),
    ("tiny", "roman.detector=sca"),
    ("tiny", "roman.detector=sca", "rubin.mode=visits"),
    ("one_tile",),
    ("joint_tile",),
]


@pytest.mark.parametrize("settings", EVERY_OPTION, ids=" ".join)
def test_units_read_what_their_stage_declares(settings):
    """The declarations decide when a stage begins: a unit that read anything else might be made before it is there."""
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


def test_the_order_of_the_stages_is_one_in_which_they_can_run():
    for settings in EVERY_OPTION:
        before = set()
        for one in stage_products(Survey(load_pipeline(settings[0], list(settings[1:])))):
            assert one.reads | one.known_after <= before, one.name
            before.add(one.name)
    assert len({stage.name for stage in STAGES}) == len(STAGES)


def test_the_picture_of_the_stages_is_what_they_read():
    arrows = _reduced(kinds_read(stage_products(Survey(load_pipeline("tiny")))))
    assert arrows["exposures"] == {"truth", "pointings"}
    assert arrows["coadds"] == {"exposures"}, "what exposures read need not be drawn again"
    assert arrows["differences"] == arrows["truth_match"] == {"detections"}
    assert arrows["truth_index"] == {"truth", "pointings"}
    assert arrows["statistics"] == {"matches", "chance"}
    assert not arrows["truth"]
    assert not arrows["pointings"]
    arrows = _reduced(kinds_read(stage_products(Survey(load_pipeline("tiny", ["roman.detector=sca"])))))
    assert arrows["exposures"] == {"truth", "calibration"}
    assert arrows["calibration"] == {"pointings"}
    assert arrows["coadds"] == {"exposures"}
