"""Draw `_static/architecture.svg`: the rooms of the package from the top, and what runs where."""

from pathlib import Path
from xml.sax.saxutils import escape

OUTPUT = Path(__file__).resolve().parent.parent / "_static" / "architecture.svg"
WIDTH, HEIGHT = 980, 700
FILL = {"entry": "#e8f1fa", "survey": "#e3f3e6", "work": "#fdf2dc", "base": "#f1ecf8", "run": "#ffffff"}
STROKE = {"entry": "#3b78b5", "survey": "#3d8b4d", "work": "#b8862b", "base": "#7a5aa6", "run": "#5a6675"}
LAYERS = (
    ("entry", (("cli", "commands"), ("report", "pages"), ("export", "other formats"))),
    ("entry", (("run", "drive a run, status"),)),
    ("survey", (("survey", "products by name"), ("survey_repr", "text and HTML"))),
    ("survey", (("stage_graph", "all stages in order"),)),
    ("survey", (("stages", "truth, exposures, coadds, detections, analysis"),)),
    ("work", (("pipeline", "settings"), ("ingest", "source catalogs"), ("instruments", "Roman, Rubin"))),
    ("work", (("engine", "what is stale, submission"), ("products", "lazy images and tables"))),
    ("base", (("storage", "files, records, checksums"),)),
    ("base", (("kernels", "NumPy, Numba, GalSim; no dask, no files"),)),
    ("base", (("model", "sky, tiles, settings, seeds"),)),
)
"""From the top: kind, then (room, what it holds) from left to right."""
LEFT, TOP, COLUMN, BOX, STEP = 30, 62, 500, 48, 62
"""Left and upper edge of the layers, their width, the height of a box, the distance of layers."""


def box(x: float, y: float, width: float, height: float, kind: str, title: str, *lines: str) -> str:
    """Return a box with a title and lines of text below it."""
    middle, first = x + width / 2, y + height / 2 + 5 - 8 * len(lines)
    parts = [
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6" fill="{FILL[kind]}" '
        f'stroke="{STROKE[kind]}" stroke-width="1.5"/>',
        f'<text x="{middle:g}" y="{first:g}" class="title">{escape(title)}</text>',
    ]
    for number, line in enumerate(lines):
        parts.append(f'<text x="{middle:g}" y="{first + 17 * (number + 1):g}" class="line">{escape(line)}</text>')
    return "\n".join(parts)


def arrow(x1: float, y1: float, x2: float, y2: float, text: str = "", side: int = 1) -> str:
    """Return an arrow with a text beside its middle, to the right (1) or to the left (-1)."""
    anchor = "start" if side > 0 else "end"
    label = (
        f'<text x="{(x1 + x2) / 2 + 8 * side:g}" y="{(y1 + y2) / 2 + 4:g}" class="note" '
        f'text-anchor="{anchor}">{escape(text)}</text>'
    )
    line = f'<line x1="{x1:g}" y1="{y1:g}" x2="{x2:g}" y2="{y2:g}" class="arrow" marker-end="url(#head)"/>'
    return line + "\n" + (label if text else "")


def layers() -> list[str]:
    """Return the boxes of the rooms."""
    parts = [
        f'<text x="{LEFT:g}" y="40" class="head">Rooms of the package: imports point down</text>',
    ]
    for number, (kind, rooms) in enumerate(LAYERS):
        width = (COLUMN - 10 * (len(rooms) - 1)) / len(rooms)
        for place, (room, text) in enumerate(rooms):
            parts.append(box(LEFT + place * (width + 10), TOP + number * STEP, width, BOX, kind, room, text))
    return parts


def processes() -> list[str]:
    """Return the boxes of a run: who asks, who computes, where the data lie."""
    x, width = 600, 350
    return [
        f'<text x="{x}" y="40" class="head">A run: processes and data</text>',
        box(
            x,
            62,
            width,
            66,
            "run",
            "pipeline file and overrides",
            "one YAML file a survey,",
            "key=value on the command line",
        ),
        arrow(x + width / 2, 128, x + width / 2, 172, "validated, planned"),
        box(x, 174, width, 66, "run", "driver", "finds stale units, sends them out,", "keeps the lock and the log"),
        arrow(x + width / 2 - 70, 240, x + width / 2 - 70, 298, "units", -1),
        arrow(x + width / 2 + 50, 298, x + width / 2 + 50, 242, "hash, seconds, peak"),
        box(
            x,
            300,
            width,
            82,
            "run",
            "dask workers",
            "one thread and run.memory_limit each;",
            "local processes, or any dask cluster;",
            "one unit at a time",
        ),
        arrow(x + width / 2 - 70, 382, x + width / 2 - 70, 440, "data, then record", -1),
        arrow(x + width / 2 + 50, 440, x + width / 2 + 50, 384, "inputs"),
        box(
            x,
            442,
            width,
            82,
            "run",
            "store",
            "folder or s3:// bucket: Zarr images,",
            "HATS and Parquet tables,",
            "manifest with a record for each unit",
        ),
        arrow(x + width / 2, 524, x + width / 2, 558, "lazy reads"),
        box(x, 560, width, 50, "run", "rd.open, report, export", "missing units are computed on request"),
    ]


def main() -> None:
    """Write the picture."""
    style = (
        "text{font-family:system-ui,-apple-system,'Segoe UI',Helvetica,Arial,sans-serif;fill:#1c2430}"
        ".title{font-size:15px;font-weight:600;text-anchor:middle}.line{font-size:12.5px;text-anchor:middle}"
        ".note{font-size:12px;fill:#46505c}.head{font-size:16px;font-weight:600}"
        ".arrow{stroke:#46505c;stroke-width:1.5}"
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">',
        "<title>Rooms of romandask and the processes of a run</title>",
        f"<style>{style}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" fill="#46505c"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
        *layers(),
        *processes(),
        "</svg>",
    ]
    OUTPUT.write_text("\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
