"""Instance catalogs of phoSim and imSim: text files, plain or .gz, for one visit.

A file has a header of `key value` lines, `object` lines, and `includeobj` lines that name further files with objects.

These files mirror the sky. Their gamma_2 is -shear_2 (GCR: shear_2_phosim), and their position angles run from north to
west (imSim's instcat.py draws the direction 90 deg - angle from west); both signs are changed here. Axes are half-light
radii, arcsec. The DC2 writers use the identifiers galaxy_id * 1024 + a code of the component
(sims_GCRCatSimInterface); here the identifier is galaxy_id. Whether a catalog does so is decided once, over all its
files: at least nine in ten of its components have the code of their kind.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from romandask.ingest.identifiers import INTEGER, MAX_SHOWN, identifiers
from romandask.ingest.rows import DARK_MAGNORM, Batch, file_states, normal_form, with_reasons
from romandask.ingest.text_blocks import MAX_LINE_BYTES, decoded, iterate_lines, lines_of_block, open_binary, unmarked
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

BLOCK_BYTES = 16 << 20
"""Bytes of uncompressed text per batch; the lines of DC2 have 170 to 260 bytes."""
CODES = {"bulge": (97, 77), "disk": (107, 87), "knots": (127, 95)}
"""Codes that the DC2 writers (of cosmoDC2, and of its predecessor) add to 1024 galaxy_id, by component."""
CODED_SHARE = 0.9
"""Share of components with the code of their kind from which on a catalog has such codes. Other integers have it by
chance in 1 of 500 cases; a catalog with codes may have a few broken lines."""
SHAPE_PARAMETERS = {"point": 0, "sersic2d": 4, "knots": 4}
"""Number of parameters of each known shape."""
NUMBERS = (
    "ra dec magnorm redshift gamma_1 gamma_2 kappa a b angle index internal_av internal_rv galactic_av galactic_rv"
).split()
"""Numbers of an object; `index` is the Sersic index, or the number of knots."""
_COMPONENT = re.compile(
    rb"^object[ \t]+(\S+)(?:[ \t]+\S+){10}[ \t]+(sersic2d|knots)(?:[ \t]+\S+){3}[ \t]+(\S+)",
    re.MULTILINE | re.IGNORECASE,
)
"""Line of a bulge, a disk or knots, with its identifier, shape, and Sersic index or number of knots."""
_DUST_LAWS = {"internal": ("ccm",), "galactic": ("ccm", "f99", "f19")}


@dataclass(frozen=True, kw_only=True)
class TextSummary:
    """Summary of a text file, from one pass over it."""

    size: int
    """Uncompressed size, bytes."""
    lines: tuple[int, ...]
    """Number of the first line that starts in each block."""
    rows: int
    """Number of rows: lines that are objects or that are not understood."""
    objects: int
    """Number of object lines."""
    components: int = 0
    """Number of bulges, disks and knots."""
    coded: int = 0
    """Number of those whose identifier has the code of their kind."""
    header: dict[str, float | int | str] = field(default_factory=dict)
    """Header of the visit."""
    includes: tuple[str, ...] = ()
    """Paths of the included files, as they are written in this file."""


@dataclass(frozen=True)
class Source:
    """An instance catalog and the files that it includes."""

    paths: dict[str, AnyPath]
    """Files, by their path relative to the folder of the catalog."""
    texts: dict[str, TextSummary]
    """Summary of each file, by the same keys."""
    block: int
    """Bytes of uncompressed text per batch."""
    edges: tuple[float, ...] = ()
    """Always empty: instance catalogs have no top-hat spectra."""
    components: bool = True
    """Always True: the components of a galaxy are rows of their own."""

    @property
    def coded(self) -> bool:
        """Whether the identifiers of components are 1024 galaxy_id + code."""
        components = sum(text.components for text in self.texts.values())
        return components > 0 and sum(text.coded for text in self.texts.values()) >= CODED_SHARE * components

    def batches(self) -> tuple[Batch, ...]:
        """Return the batches of all files: blocks of the uncompressed text, in bytes."""
        return tuple(
            Batch(self.paths[key], start, min(start + self.block, text.size), key)
            for key, text in self.texts.items()
            for start in range(0, text.size, self.block)
        )

    def count(self) -> int:
        """Return the number of rows of all files: object lines, and lines that are not understood."""
        return sum(text.rows for text in self.texts.values())

    def state(self) -> Any:
        """Return the sizes and modification times of all files."""
        return {"files": file_states(self.paths)}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return the rows of a batch in the normal form, one per object line.

        The components of a galaxy are separate rows (see `romandask.ingest.components.merge_components`).
        """
        lines = lines_of_block(batch.path, batch.start, batch.stop)
        first = self.texts[batch.source].lines[batch.start // self.block]
        rows = [(first + number, line) for number, line in enumerate(lines) if _is_row(line)]
        return _normal_form(batch.source, rows, self.coded)


def open_source(path: AnyPath, block: int = BLOCK_BYTES) -> Source:
    """Open an instance catalog.

    One pass over the text finds the included files, counts lines and rows, and checks that the files are complete.

    Parameters
    ----------
    path : path
        The catalog; included files are relative to its folder.
    block : int
        Bytes of uncompressed text per batch.

    Raises
    ------
    UserError
        If the catalog or an included file is missing, not text or a damaged .gz, or if there is no object.
    """
    paths, texts = {path.name: path}, {path.name: _scan(path, block)}
    for name in texts[path.name].includes:
        included = path.parent / name
        if not included.is_file():
            raise UserError(f"{path}: includes {name}, which is not beside it: copy it there")
        # like imSim, read no files that are included by included files
        paths[Path(name).as_posix()], texts[Path(name).as_posix()] = included, _scan(included, block)
    source = Source(paths, texts, block)
    if not sum(text.objects for text in texts.values()):
        raise UserError(f"{path}: holds no line 'object ...' and includes no file that does: not an instance catalog")
    return source


def read_header(path: AnyPath) -> dict[str, float | int | str]:
    """Return the header of the visit: the `key value` lines before the first object."""
    header: dict[str, float | int | str] = {}
    for line in iterate_lines(path):
        tokens = line.split()
        if tokens and tokens[0] == "object":
            break
        if len(tokens) == 2 and tokens[0] != "includeobj":
            header[tokens[0]] = _parse_value(tokens[1])
    return header


def _parse_value(text: str) -> float | int | str:
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text


def _is_row(line: str) -> bool:
    """Return whether a line is an object or is not understood: not blank, a comment, or a header line `key value`."""
    tokens = line.split(None, 2)
    return bool(tokens) and (tokens[0] == "object" or (len(tokens) != 2 and not tokens[0].startswith("#")))


def _scan(path: AnyPath, block: int) -> TextSummary:
    """Return the summary of a text file, from one pass with one block in memory."""
    size, lines, rows, objects, newlines = 0, [], 0, 0, 0
    codes = np.zeros(2, int)
    includes: list[str] = []
    rest = b""
    try:
        with open_binary(path) as file:
            while data := file.read(block):
                if size == 0 and b"\0" in data[:MAX_LINE_BYTES]:
                    raise UserError(f"{path}: not text: an instance catalog is text or .gz")
                lines.append(newlines + (0 if size == 0 or rest == b"" else 1))
                if size == 0:
                    # the rest of the block keeps its offsets: `size` counts the mark
                    size, data = size + len(data) - len(unmarked(data)), unmarked(data)
                size += len(data)
                newlines += data.count(b"\n")
                complete, newline, tail = (rest + data).rpartition(b"\n")
                n_rows, n_objects, included = _count(complete + newline)
                codes += _count_codes(complete)
                rows, objects, includes = rows + n_rows, objects + n_objects, includes + included
                rest = tail[-MAX_LINE_BYTES:]
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{path}: cannot be read ({reason}): copy it again") from None
    n_rows, n_objects, included = _count(rest)
    components, coded = (codes + _count_codes(rest)).tolist()
    return TextSummary(
        size=size,
        lines=tuple(lines),
        rows=rows + n_rows,
        objects=objects + n_objects,
        components=components,
        coded=coded,
        header=read_header(path),
        includes=tuple(includes + included),
    )


def _count(text: bytes) -> tuple[int, int, list[str]]:
    """Return the number of rows and of objects in complete lines, and the files that they include."""
    objects = text.count(b"\nobject ") + text.startswith(b"object ")
    if objects == text.count(b"\n") + (not text.endswith(b"\n") and bool(text)):
        return objects, objects, []
    rows, objects, includes = 0, 0, []
    for line in decoded(text):
        tokens = line.split()
        rows += _is_row(line)
        objects += tokens[:1] == ["object"]
        if len(tokens) == 2 and tokens[0] == "includeobj":
            includes.append(tokens[1])
    return rows, objects, includes


def _count_codes(text: bytes) -> tuple[int, int]:
    """Return the number of components in complete lines, and of those that have the code of their kind."""
    found = _COMPONENT.findall(text)
    # by Sersic index; knots have their number there
    kinds = {b"4": "bulge", b"4.0": "bulge", b"1": "disk", b"1.0": "disk"}
    coded = 0
    for identifier, shape, index in found:
        codes = CODES["knots" if shape.lower() == b"knots" else kinds.get(index, "bulge")]
        coded += identifier.isdigit() and int(identifier[-20:]) % 1024 in codes
    return len(found), coded


def _normal_form(source: str, rows: list[tuple[int, str]], coded: bool) -> pd.DataFrame:
    """Return rows, given as line number and line, in the normal form; `coded` is that of the source."""
    parsed = [_parse(line) for _, line in rows]
    fields = list(zip(*parsed, strict=True)) if parsed else [()] * (len(NUMBERS) + 4)
    id_text, shape, sed, reason = (np.array(values, object) for values in fields[:4])
    value = {}
    for name, texts in zip(NUMBERS, fields[4:], strict=True):
        text = pd.Series(texts, dtype=object)
        value[name] = pd.to_numeric(text, errors="coerce").to_numpy(float)
        not_parsed = np.flatnonzero(np.isnan(value[name]) & (reason == ""))
        reason[[row for row in not_parsed if texts[row].lower().lstrip("+-") != "nan"]] = f"{name} is not a number"
    point, knots = shape == "point", shape == "knots"
    sersic = shape == "sersic2d"
    index = value["index"]
    component = {"bulge": sersic & (index == 4), "disk": sersic & (index == 1), "knots": knots}
    for row in np.flatnonzero(sersic & (reason == "") & (index != 4) & (index != 1)):
        reason[row] = f"Sersic index {index[row]:g} is neither 1 nor 4"
    reason[point & (value["redshift"] != 0) & (reason == "")] = "point source with a redshift is no star"
    reason[point & (value["internal_av"] != 0) & (reason == "")] = "point source with dust of its own is no star"
    dark = value["magnorm"] >= DARK_MAGNORM
    reason[point & dark & (reason == "")] = "magnorm of 50 or more: no light"
    magnorm = np.where(dark, np.inf, value["magnorm"])
    ids, reason = _ids(id_text, component, reason, coded)
    columns: dict[str, Any] = {
        "id": ids,
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


def _ids(
    texts: np.ndarray, component: dict[str, np.ndarray], reason: np.ndarray, coded: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return identifiers, those of components turned into the identifier of the galaxy, and reasons for quarantine.

    They may be written as 1024 galaxy_id + code (`coded`), or as galaxy_id_component as skyCatalogs does
    (translate_utils.py).
    """
    found = identifiers(texts, INTEGER + "(?:_(?:bulge|disk|knots))?")
    ids, reason = found.values, found.reason_after(reason)
    for name, rows in component.items() if coded else ():
        has_code = np.isin(ids % 1024, CODES[name])
        for row in np.flatnonzero(rows & ~has_code & (reason == "")):
            reason[row] = f"id {texts[row][:MAX_SHOWN]} lacks the code of {name}, which the catalog has elsewhere"
        ids = np.where(rows & has_code & (ids >= 0), ids // 1024, ids)
    return ids, reason


def _parse(line: str) -> tuple[str, ...]:
    """Return (id, shape, sed, reason, *NUMBERS) as texts, with a reason for quarantine if the line cannot be parsed."""
    tokens = line.split()
    if not tokens or tokens[0] != "object":
        return _rejected("", "line is neither a header, an includeobj nor an object")
    identifier = tokens[1] if len(tokens) > 1 else ""
    if len(tokens) < 13:
        return _rejected(identifier, f"too few fields ({len(tokens)})")
    shape = tokens[12].lower()
    if shape not in SHAPE_PARAMETERS:
        return _rejected(identifier, f"shape {tokens[12][:40]!r} is not known")
    dust, next_token = [], 13 + SHAPE_PARAMETERS[shape]
    for kind, laws in _DUST_LAWS.items():
        law = tokens[next_token].lower() if next_token < len(tokens) else ""
        if law == "none":
            dust += ["0", "3.1"]
            next_token += 1
        elif next_token + 2 < len(tokens):
            if law not in laws:
                return _rejected(identifier, f"law {tokens[next_token][:40]!r} of {kind} dust is not known")
            dust += tokens[next_token + 1 : next_token + 3]
            next_token += 3
        else:
            return _rejected(identifier, f"too few fields ({len(tokens)})")
    if next_token != len(tokens):
        return _rejected(identifier, f"too many fields ({len(tokens)}, expected {next_token})")
    shape_parameters = tokens[13:17] if SHAPE_PARAMETERS[shape] else ["0"] * 4
    return (identifier, shape, tokens[5], "", tokens[2], tokens[3], tokens[4], *tokens[6:10], *shape_parameters, *dust)


def _rejected(identifier: str, reason: str) -> tuple[str, ...]:
    return (identifier, "", "", reason, *["nan"] * len(NUMBERS))
