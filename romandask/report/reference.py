"""Reference of the data products: every table and image of a store, as Markdown generated from the code."""

from __future__ import annotations

from typing import Any

from romandask.model.resources import resource_folder
from romandask.model.settings import read_yaml
from romandask.pipeline import load_pipeline
from romandask.products.images import ImageProduct
from romandask.stage_graph import stage_products
from romandask.survey import Survey

VARIANTS: dict[str, tuple[str, ...]] = {
    "": (),
    "with `roman.detector: sca`": ("roman.detector=sca",),
    "with `rubin.mode: visits`": ("rubin.mode=visits",),
}
"""Overrides of the pipeline `tiny` that change the set of images, by their description in the reference."""
_HEAD = """# Data products

What a store holds, table by table and image by image. `romandask reference` writes this page, from the schemas beside
it and from the products themselves; a test holds the two together. Sizes of axes are those of the pipeline `tiny`.

"""


def reference() -> str:
    """Return the reference of all data products as Markdown."""
    tables = [_table(path.stem, read_yaml(path)) for path in sorted(resource_folder("catalogs").glob("*.yaml"))]
    return _HEAD + "# Tables\n\n" + "\n".join(tables) + "\n# Images\n\n" + "\n".join(_images())


def _table(name: str, content: dict[str, Any]) -> str:
    rows = [
        (f"`{column['name']}`", column["dtype"], column.get("unit"), column.get("ucd"), column["description"])
        for column in content["columns"]
    ]
    about = f"{content['description']}. Key: `{content['key']}`. Partitions: {content['partitioning']}."
    return f"## {name}\n\n{about}\n\n" + _rows(("column", "type", "unit", "UCD", "what it is"), rows)


def _images() -> list[str]:
    """Return the sections of all image products; a product that depends on the overrides has a section for each."""
    sections: dict[str, str] = {}
    for text, overrides in VARIANTS.items():
        survey = Survey(load_pipeline("tiny", list(overrides)))
        for stage_product in stage_products(survey):
            product = survey.product(stage_product.name)
            if isinstance(product, ImageProduct):
                section = _image(product)
                if section not in sections:
                    sections[section] = f"## {product.stage}{f' ({text})' if text else ''}\n\n{section}"
        psfs = {f"psfs/{name}": survey.output(f"psfs/{name}") for name in survey.instruments} if not overrides else {}
        for name, product in psfs.items():
            sections.setdefault(_image(product), f"## {name} (made on demand, not stored)\n\n{_image(product)}")
    return sorted(sections.values())


def _image(product: ImageProduct) -> str:
    rows = []
    for variable in product.variables:
        axes = [
            *product.layout.leading(variable)[0],
            *(f"{axis} {size}" for axis, size in zip(variable.axes, variable.shape, strict=True)),
        ]
        attributes = dict(variable.attributes)
        text = str(attributes.get("long_name", ""))
        if "flag_masks" in attributes:
            names = zip(attributes["flag_masks"], str(attributes["flag_meanings"]).split(), strict=True)
            text += ": " + ", ".join(f"{mask} {name}" for mask, name in names)
        rows.append((f"`{variable.name}`", variable.dtype, ", ".join(axes), attributes.get("units"), text))
    tables = "".join(f"Beside it, a table a unit: `{name}`.\n\n" for name in product.tables)
    return tables + _rows(("variable", "type", "axes", "unit", "what it is"), rows)


def _rows(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """Return a Markdown table."""
    # an unescaped | would end the cell
    lines = [head, ("---",) * len(head), *rows]
    cells = [["" if cell is None else str(cell).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells) + "\n"
