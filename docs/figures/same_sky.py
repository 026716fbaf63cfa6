"""Draw `_static/same_sky.png`: a part of the survey `tiny` as both telescopes see it.

Run it in a folder that holds the finished store `runs/tiny`.
"""

import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from astropy.visualization import make_lupton_rgb
from PIL import Image

import romandask as rd

STORE = "runs/tiny"
TILE = "53.0401_-40.0069"
BANDS = {"roman": ("F184", "J129", "Y106"), "rubin": ("z", "r", "g")}
"""Bands shown as red, green and blue."""
TITLES = {
    "roman": "Roman: Y106, J129, F184; 0.0575 arcsec pixels",
    "rubin": "Rubin: g, r, z; 0.2 arcsec pixels",
}
CENTRE = (6.5, -8.0)
"""Centre of the field, arcsec from the centre of the tile."""
HALF = 17.5
"""Half the side of the field, arcsec."""
OUTPUT = Path(__file__).resolve().parent.parent / "_static" / "same_sky.png"


def colour_image(survey: rd.Survey, name: str) -> np.ndarray:
    """Return the field as a colour image (ny, nx, 3), each band in units of its noise."""
    coadds = survey.coadds(name).sel(tile=TILE)
    scale = coadds.attrs["pixel_scale"]
    middle = coadds.sizes["x"] / 2
    x, y = (slice(round(middle + (c - HALF) / scale), round(middle + (c + HALF) / scale)) for c in CENTRE)
    planes = []
    for band in BANDS[name]:
        image = coadds["image"].sel(band=band).compute().to_numpy()
        noise = 1.4826 * np.median(np.abs(image - np.median(image)))
        planes.append(image[y, x] / noise)
    return make_lupton_rgb(*planes, minimum=0.2, stretch=12.0, Q=8.0)


def main() -> None:
    """Draw both panels and write them with 64 levels a colour, which keeps the file small."""
    survey = rd.open(STORE)
    figure, panels = plt.subplots(1, 2, figsize=(12.3, 6.4), layout="constrained", dpi=100)
    for axes, name in zip(panels, BANDS, strict=True):
        image = colour_image(survey, name)
        axes.imshow(image, origin="lower", extent=(-HALF, HALF, -HALF, HALF), interpolation="nearest")
        axes.plot([-HALF + 2, -HALF + 7], [-HALF + 2, -HALF + 2], color="white", linewidth=2)
        axes.text(-HALF + 4.5, -HALF + 2.6, "5 arcsec", color="white", ha="center")
        axes.set(xticks=[], yticks=[], title=TITLES[name])
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    levels = np.asarray(Image.open(buffer).convert("RGB")) // 4 * 4
    Image.fromarray(levels).save(OUTPUT, optimize=True)


if __name__ == "__main__":
    main()
