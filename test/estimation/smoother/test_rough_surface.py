"""A surface that bends within what the position is unsure by."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother.measurements.rough_surface import WIDEST, linearise
from imu_fusion.surfaces.constraint import height_constraint

PLACES = np.column_stack([np.linspace(0.0, 100.0, 50), np.linspace(-30.0, 40.0, 50), np.zeros(50)])


def waves(height, length):
    """A slope of 1:2 to the east with waves across it."""
    k = 2.0 * np.pi / length

    def elevation(east, north):
        return (-0.5 * east + height * np.sin(k * east), -0.5 + height * k * np.cos(k * east),
                np.zeros_like(east))
    return height_constraint("waves", "always", 0.3, elevation).evaluate


def spread(sd):
    """Covariances of positions that are unsure by sd in some directions, and less in others."""
    axes = np.linalg.qr(np.random.default_rng(1).standard_normal((50, 3, 3)))[0]
    return np.einsum("nij,j,nkj->nik", axes, np.square([sd, 0.5 * sd, 0.1 * sd]), axes)


@pytest.mark.parametrize("cov", [spread(8.0), None])
def test_a_plane_is_linear_however_unsure_the_place_is(cov):
    plane = waves(0.0, 30.0)
    residual, gradient, bend = linearise(plane, PLACES, cov)
    assert residual == pytest.approx(plane(PLACES)[0])
    assert gradient == pytest.approx(plane(PLACES)[1])
    assert bend == pytest.approx(np.zeros(50), abs=1e-12)


def test_a_place_that_is_known_has_the_tangent():
    rough = waves(0.8, 40.0)
    residual, gradient, bend = linearise(rough, PLACES, spread(0.05))
    assert residual == pytest.approx(rough(PLACES)[0], abs=1e-4)
    assert gradient == pytest.approx(rough(PLACES)[1], abs=1e-4)
    assert bend.max() < 1e-7


def test_beyond_a_wave_the_slope_of_all_counts_and_the_waves_are_noise():
    """The tangent is 25 % steeper or flatter; over 30 m of waves of 40 m it is the slope, and what
    five places see of the waves' scatter is noise."""
    rough = waves(0.8, 40.0)
    residual, gradient, bend = linearise(rough, PLACES, None)
    assert np.ptp(rough(PLACES)[1][:, 0]) > 0.2
    assert gradient[:, 0] == pytest.approx(0.5, abs=0.04)
    assert 0.3 < np.mean(bend) / (0.5 * 0.8 ** 2) < 1.5
    assert np.std(residual - 0.5 * PLACES[:, 0]) < np.std(0.8 * np.sin(0.157 * PLACES[:, 0]))
    assert WIDEST > 0.5 * 40.0


def test_where_the_surface_ends_it_goes_on_as_it_is():
    def ends(position):
        residual, gradient = waves(0.0, 30.0)(position)
        return np.where(position[:, 0] > 101.0, np.nan, residual), gradient

    residual, gradient, bend = linearise(ends, PLACES, spread(8.0))
    assert np.isfinite(residual).all()
    assert gradient == pytest.approx(waves(0.0, 30.0)(PLACES)[1])
    assert bend == pytest.approx(np.zeros(50), abs=1e-12)
