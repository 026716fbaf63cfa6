"""Instance catalogs of phoSim and imSim: text (or .gz) of a visit's header, `object` lines and `includeobj` files.

Signs: these files mirror the sky. Their gamma_2 is -shear_2 (GCR: shear_2_phosim) and their position angles run from
north to west (imSim's instcat.py draws the direction 90 deg - angle from west); both are turned here.
Axes are half-light radii, arcsec. Ids of the DC2 writers are galaxy_id * 1024 + a code of the component
(sims_GCRCatSimInterface); the ids here are galaxy_id.
"""

from __future__ import annotations

import gzip
import os
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from romandask.ingest.rows import DARK, Batch, file_states, identifiers, normal_form, with_reasons
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

BLOCK = 16 << 20
"""Bytes of text a batch; lines of DC2 have 170 to 260."""
LONGEST = 1 << 16
"""Bytes of a line that are looked at."""
CODES = {"bulge": (97, 77), "disk": (107, 87), "knots": (127, 95)}
"""What the DC2 writers (of cosmoDC2, and of its predecessor) add to 1024 galaxy_id."""
SHAPES = {"point": 0, "sersic2d": 4, "knots": 4}
"""Numbers that follow a shape."""
NUMBERS = (
    "ra dec magnorm redshift gamma_1 gamma_2 kappa a b angle index internal_av internal_rv galactic_av galactic_rv"
).split()
_LAWS = {"internal": ("ccm",), "galactic": ("ccm", "f99", "f19")}


@dataclass(frozen=True)
class Text:
    """What one pass over a text found."""

    size: int
    """Bytes, unpacked."""
    lines: tuple[int, ...]
    """Number of the first line that starts in each block."""
    rows: int
    """Lines that are objects, or nothing that is known."""
    objects: int
    header: dict[str, float | int | str] = field(default_factory=dict)
    includes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """An instance catalog with the files that it includes."""

    paths: dict[str, AnyPath]
    """By path relative to the catalog's folder."""
    texts: dict[str, Text]
    block: int
    """Bytes of a batch."""
    edges: tuple[float, ...] = ()

    def batches(self) -> tuple[Batch, ...]:
        """Return the blocks of the texts, in bytes of the unpacked text."""
        return tuple(
            Batch(self.paths[key], start, min(start + self.block, text.size), key)
            for key, text in self.texts.items()
            for start in range(0, text.size, self.block)
        )

    def count(self) -> int:
        """Return the rows of all files: their object lines, and lines that are nothing known."""
        return sum(text.rows for text in self.texts.values())

    def state(self) -> Any:
        """Return bytes and times of all files."""
        return {"files": file_states(self.paths)}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return the rows of a batch in the normal form, one an object line; `merge_components` makes galaxies."""
        data = _block(batch.path, batch.start, batch.stop)
        first = self.texts[batch.source].lines[batch.start // self.block]
        rows = [(first + number, line) for number, line in enumerate(data) if _is_row(line)]
        return _normal(batch.source, rows)


def open_source(path: AnyPath, block: int = BLOCK) -> Source:
    """Return an instance catalog; one pass over its text finds the included files, the lines and whether it is whole.

    Parameters
    ----------
    block : bytes of a batch

    Raises
    ------
    UserError
        If it or an included file is missing, is not text, or is a damaged .gz; or if it holds no object.
    """
    paths, texts = {path.name: path}, {path.name: _scan(path, block)}
    for name in texts[path.name].includes:
        included = path.parent / name
        if not included.is_file():
            raise UserError(f"{path}: includes {name}, which is not beside it: copy it there")
        # as imSim does, files that these include in turn are not read
        paths[Path(name).as_posix()], texts[Path(name).as_posix()] = included, _scan(included, block)
    source = Source(paths, texts, block)
    if not sum(text.objects for text in texts.values()):
        raise UserError(f"{path}: holds no line 'object ...' and includes no file that does: not an instance catalog")
    return source


def read_header(path: AnyPath) -> dict[str, float | int | str]:
    """Return the header of a visit: its `key value` lines before the first object."""
    header: dict[str, float | int | str] = {}
    for line in _lines(path):
        tokens = line.split()
        if tokens and tokens[0] == "object":
            break
        if len(tokens) == 2 and tokens[0] != "includeobj":
            header[tokens[0]] = _value(tokens[1])
    return header


def _value(text: str) -> float | int | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _is_row(line: str) -> bool:
    """Whether a line is an object, or nothing else that is known: header lines are `key value`."""
    tokens = line.split(None, 2)
    return bool(tokens) and (tokens[0] == "object" or (len(tokens) != 2 and not tokens[0].startswith("#")))


def _scan(path: AnyPath, block: int) -> Text:
    """Return what a text holds, from one pass with a block in memory."""
    size, lines, rows, objects, number = 0, [], 0, 0, 0
    includes: list[str] = []
    rest = b""
    try:
        with _binary(path) as file:
            while data := file.read(block):
                if size == 0 and b"\0" in data[:LONGEST]:
                    raise UserError(f"{path}: not text: an instance catalog is text or .gz")
                starts = number + (0 if size == 0 or rest == b"" else 1)
                lines.append(starts)
                size += len(data)
                number += data.count(b"\n")
                whole, newline, tail = (rest + data).rpartition(b"\n")
                found, known, named = _count(whole + newline)
                rows, objects, includes, rest = rows + found, objects + known, includes + named, tail[-LONGEST:]
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{path}: cannot be read ({reason}): copy it again") from None
    found, known, named = _count(rest)
    return Text(size, tuple(lines), rows + found, objects + known, read_header(path), tuple(includes + named))


def _count(text: bytes) -> tuple[int, int, list[str]]:
    """Return the rows of whole lines, how many are objects, and the files that they include."""
    objects = text.count(b"\nobject ") + text.startswith(b"object ")
    if objects == text.count(b"\n") + (not text.endswith(b"\n") and bool(text)):
        return objects, objects, []
    rows, objects, includes = 0, 0, []
    for line in _decoded(text):
        tokens = line.split()
        rows += _is_row(line)
        objects += tokens[:1] == ["object"]
        if len(tokens) == 2 and tokens[0] == "includeobj":
            includes.append(tokens[1])
    return rows, objects, includes


def _decoded(data: bytes) -> list[str]:
    """Return the lines of a text; only newlines end lines, whatever else it holds."""
    lines = data.decode("utf-8", "replace").split("\n")
    return lines if lines[-1] else lines[:-1]


def _binary(path: AnyPath) -> Any:
    if not path.is_file():
        raise UserError(f"{path}: no such file; truth.path must name an instance catalog below data")
    here = local_copy(path)
    with open(here, "rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    return gzip.open(here, "rb") if packed else open(here, "rb")


def _lines(path: AnyPath) -> Iterator[str]:
    with _binary(path) as file:
        while line := file.readline(LONGEST):
            yield line.decode("utf-8", "replace")


def _block(path: AnyPath, start: int, stop: int) -> list[str]:
    """Return the lines that start within bytes start..stop."""
    before = max(start - 1, 0)
    # all of the line that runs out of the block, unless it is no line
    data = _bytes(path, before, stop - before + LONGEST)
    if start > 0:
        # the line that runs into the block belongs to the one before
        end = data.find(b"\n", 0, stop - before)
        if end < 0:
            return []
        before, data = before + end + 1, data[end + 1 :]
    inside = stop - before
    if inside <= 0:
        return []
    if not data[:inside].endswith(b"\n"):
        end = data.find(b"\n", inside)
        inside = end + 1 if end >= 0 else len(data)
    return _decoded(data[:inside])


@dataclass
class _Unpacker:
    """A .gz that is read onwards, with the end of what was read."""

    key: tuple[AnyPath, int, int]
    file: BinaryIO
    position: int = 0
    tail: bytes = b""

    def read(self, start: int, length: int) -> bytes:
        held = self.position - len(self.tail)
        if not held <= start <= self.position:
            self.file.seek(start)
            self.position, self.tail, held = start, b"", start
        kept = self.tail[start - held :]
        data = kept + self.file.read(max(length - len(kept), 0))
        self.position, self.tail = start + len(data), data[-2 * LONGEST :]
        return data[:length]


_LOCK = threading.Lock()
_HELD: list[_Unpacker] = []


def _bytes(path: AnyPath, start: int, length: int) -> bytes:
    """Return bytes of the unpacked text."""
    with _binary(path) as file:
        if not isinstance(file, gzip.GzipFile):
            file.seek(start)
            return file.read(length)
    key = (path, file_state(path)[1], os.getpid())
    with _LOCK:
        # one .gz stays open in a process: the next block then needs no unpacking from the beginning
        if not _HELD or _HELD[0].key != key:
            for held in _HELD:
                held.file.close()
            _HELD[:] = [_Unpacker(key, _binary(path))]
        return _HELD[0].read(start, length)


def _normal(source: str, rows: list[tuple[int, str]]) -> pd.DataFrame:
    parsed = [_parse(line) for _, line in rows]
    fields = list(zip(*parsed, strict=True)) if parsed else [()] * (len(NUMBERS) + 4)
    id_text, shape, sed, reason = (np.array(values, object) for values in fields[:4])
    value = {}
    for name, texts in zip(NUMBERS, fields[4:], strict=True):
        text = pd.Series(texts, dtype=object)
        value[name] = pd.to_numeric(text, errors="coerce").to_numpy(float)
        unread = np.flatnonzero(np.isnan(value[name]) & (reason == ""))
        reason[[row for row in unread if texts[row].lower().lstrip("+-") != "nan"]] = f"{name} is not a number"
    point, knots = shape == "point", shape == "knots"
    sersic = shape == "sersic2d"
    index = value["index"]
    component = {"bulge": sersic & (index == 4), "disk": sersic & (index == 1), "knots": knots}
    for row in np.flatnonzero(sersic & (reason == "") & (index != 4) & (index != 1)):
        reason[row] = f"Sersic index {index[row]:g} is neither 1 nor 4"
    reason[point & (value["redshift"] != 0) & (reason == "")] = "point source with a redshift is no star"
    reason[point & (value["internal_av"] != 0) & (reason == "")] = "point source with dust of its own is no star"
    dark = value["magnorm"] >= DARK
    reason[point & dark & (reason == "")] = "magnorm of 50 or more: no light"
    magnorm = np.where(dark, np.inf, value["magnorm"])
    columns: dict[str, Any] = {
        "id": _ids(id_text, component),
        "reason": reason,
        "ra": value["ra"],
        "dec": value["dec"],
        "MW_av": value["galactic_av"],
        "MW_rv": value["galactic_rv"],
        "magnorm": np.where(point, magnorm, np.nan),
        "sed": np.where(point, sed, ""),
        "n_knots": np.where(knots, index, 0),
    }
    extended = {
        "redshift": value["redshift"],
        "shear_1": value["gamma_1"],
        "shear_2": -value["gamma_2"],
        "convergence": value["kappa"],
        "position_angle_unlensed": -value["angle"] % 180,
    }
    columns |= {name: np.where(point, np.nan, values) for name, values in extended.items()}
    for name, own in (("bulge", component["bulge"]), ("disk", component["disk"] | knots)):
        columns[f"size_{name}_true"] = np.where(own, value["a"], np.where(point, np.nan, 0))
        columns[f"size_minor_{name}_true"] = np.where(own, value["b"], np.where(point, np.nan, 0))
        columns[f"{name}_av"] = np.where(own, value["internal_av"], np.where(point, np.nan, 0))
        columns[f"{name}_rv"] = np.where(own, value["internal_rv"], np.where(point, np.nan, 3.1))
    for name, own in component.items():
        columns[f"{name}_magnorm"] = np.where(own, magnorm, np.where(point, np.nan, np.inf))
        columns[f"{name}_sed"] = np.where(own, sed, "")
    numbers = np.array([number for number, _ in rows], np.int64)
    return with_reasons(normal_form(source, numbers, np.where(point, "star", "galaxy").astype(object), columns))


def _ids(texts: np.ndarray, component: dict[str, np.ndarray]) -> np.ndarray:
    """Return identifiers; the components of a galaxy get that of the galaxy.

    They may be written 1024 galaxy_id + code, or galaxy_id_component as skyCatalogs does (translate_utils.py).
    """
    ids = identifiers(texts, r"(-?\d{1,18})(?:_(?:bulge|disk|knots))?")
    for name, rows in component.items():
        coded = rows & (ids >= 0) & np.isin(ids % 1024, CODES[name])
        ids = np.where(coded, ids // 1024, ids)
    return ids


def _parse(line: str) -> tuple[str, ...]:
    """Return (id, shape, sed, reason, *NUMBERS) as texts; a reason where the line is not what it should be."""
    tokens = line.split()
    if not tokens or tokens[0] != "object":
        return _bad("", "line is neither a header, an includeobj nor an object")
    identifier = tokens[1] if len(tokens) > 1 else ""
    if len(tokens) < 13:
        return _bad(identifier, f"too few fields ({len(tokens)})")
    shape = tokens[12].lower()
    if shape not in SHAPES:
        return _bad(identifier, f"shape {tokens[12][:40]!r} is not known")
    dust, place = [], 13 + SHAPES[shape]
    for kind, laws in _LAWS.items():
        law = tokens[place].lower() if place < len(tokens) else ""
        if law == "none":
            dust += ["0", "3.1"]
            place += 1
        elif place + 2 < len(tokens):
            if law not in laws:
                return _bad(identifier, f"law {tokens[place][:40]!r} of {kind} dust is not known")
            dust += tokens[place + 1 : place + 3]
            place += 3
        else:
            return _bad(identifier, f"too few fields ({len(tokens)})")
    if place != len(tokens):
        return _bad(identifier, f"too many fields ({len(tokens)}, expected {place})")
    form = tokens[13:17] if SHAPES[shape] else ["0"] * 4
    return (identifier, shape, tokens[5], "", tokens[2], tokens[3], tokens[4], *tokens[6:10], *form, *dust)


def _bad(identifier: str, reason: str) -> tuple[str, ...]:
    return (identifier, "", "", reason, *["nan"] * len(NUMBERS))
