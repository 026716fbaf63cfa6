"""Spherical polygons, unit vectors and regions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romandask.model.sky import Region, cell_of, from_tangent_plane, radec, touching_pairs, unit_vectors


def square(ra: float, dec: float, half: float, angle: float) -> np.ndarray:
    """Return the corners of a square with sides of 2 `half` degrees, rotated by `angle` degrees."""
    turn = np.radians(angle + np.array([45, 135, 225, 315]))
    return np.stack(from_tangent_plane(ra, dec, half * np.sqrt(2) * np.cos(turn), half * np.sqrt(2) * np.sin(turn)), 1)


def overlap_by_points(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if any point of a fine grid over one square lies inside the other, either way."""
    steps = np.linspace(0, 1, 41)
    u, v = np.meshgrid(steps, steps)

    def grid(c):
        vectors = unit_vectors(c[:, 0], c[:, 1])
        w = [(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]
        return sum(weight[..., None] * vector for weight, vector in zip(w, vectors, strict=True)).reshape(-1, 3)

    def inside(points, c):
        vectors = unit_vectors(c[:, 0], c[:, 1])
        normals = np.cross(vectors, np.roll(vectors, -1, axis=0))
        normals *= np.sign(normals @ vectors.sum(axis=0))[:, None]
        return (points @ normals.T >= 0).all(axis=1).any()

    return inside(grid(a), b) or inside(grid(b), a)


@settings(max_examples=150, deadline=None)
@given(
    ra=st.floats(0, 360),
    dec=st.floats(-89.9, 89.9),
    east=st.floats(-0.5, 0.5),
    north=st.floats(-0.5, 0.5),
    angle=st.floats(0, 90),
    half=st.floats(0.05, 0.3),
)
def test_touching_pairs_finds_overlapping_squares_anywhere_on_the_sphere(ra, dec, east, north, angle, half):
    first = square(ra, dec, 0.1, 0)
    other_ra, other_dec = from_tangent_plane(ra, dec, east, north)
    second = square(float(other_ra), float(other_dec), half, angle)
    found = len(touching_pairs(first[None], second[None])[0]) == 1
    grown = overlap_by_points(square(ra, dec, 0.101, 0), square(float(other_ra), float(other_dec), half * 1.01, angle))
    if overlap_by_points(first, second):
        assert found
    if not grown:
        assert not found


def test_touching_pairs_are_invariant_under_rotation_in_right_ascension():
    random = np.random.default_rng(3)
    a = np.stack(
        [
            square(r, d, 0.2, t)
            for r, d, t in zip(
                random.uniform(-2, 2, 60), random.uniform(88, 89.9, 60), random.uniform(0, 90, 60), strict=True
            )
        ]
    )
    b = np.stack(
        [square(r, d, 0.3, 10) for r, d in zip(random.uniform(-180, 180, 40), random.uniform(88, 90, 40), strict=True)]
    )
    pairs = np.stack(touching_pairs(a, b))
    rotation = np.array([123.4, 0.0])
    np.testing.assert_array_equal(pairs, np.stack(touching_pairs(a + rotation, b + rotation)))
    assert pairs.shape[1] > 10


def test_radec_inverts_unit_vectors():
    ra, dec = radec(unit_vectors([0.0, 359.9, 12.0], [-89.0, 0.0, 45.0]))
    np.testing.assert_allclose(ra, [0.0, 359.9, 12.0], atol=1e-12)
    np.testing.assert_allclose(dec, [-89.0, 0.0, 45.0], atol=1e-12)


@pytest.mark.parametrize(("low", "high"), [(51.0, 56.0), (359.9, 0.2), (0.0, 360.0)])
def test_region_cells_contain_every_position_of_the_region(low, high):
    region = Region(low, high, -42.0, -38.0)
    random = np.random.default_rng(1)
    ra = (low + random.uniform(0, region.width, 5000)) % 360
    dec = random.uniform(-42, -38, 5000)
    assert region.contains(ra, dec).all()
    assert set(cell_of(ra, dec, 6)) <= set(region.cells(6))


def test_region_area_is_its_solid_angle():
    assert Region(51, 56, -42, -38).area / 3600 == pytest.approx(15.3, abs=0.05)


def test_adjacent_regions_share_no_position():
    left, right = Region(10, 11, 0, 1), Region(11, 12, 0, 1)
    ra = np.array([10.0, 10.999999999, 11.0, 11.5])
    assert (left.contains(ra, ra * 0 + 0.5).astype(int) + right.contains(ra, ra * 0 + 0.5) == 1).all()
