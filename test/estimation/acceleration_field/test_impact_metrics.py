"""Injury metrics against hand-worked cases and, where installed, pyisomme."""

import json

import numpy as np
import pytest

from imu_fusion.errors import SampleError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.impact_metrics import (
    STANDARD_GRAVITY,
    UNITS,
    ImpactParams,
    bric,
    channel_filter,
    damage,
    find_events,
    find_peaks,
    gambit,
    hic,
    measure_impacts,
    sustained_level,
)
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
)
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

T = np.arange(2001) * 1e-4
HALF_SINE = np.where(T < 0.012, 100 * STANDARD_GRAVITY * np.sin(np.pi * T / 0.012), 0.0)


def test_hic_of_a_rectangle():
    # 100 g for 10 ms: 0.01 * 100^2.5 = 1000, whatever the limit beyond 10 ms.
    pulse = np.where((T >= 0.02) & (T <= 0.03), 100 * STANDARD_GRAVITY, 0.0)
    value, begin, end = hic(T, pulse, 0.015)
    assert value == pytest.approx(1000, rel=0.015)  # edges: one sample of a hundred
    assert (begin, end) == (pytest.approx(0.02, abs=2e-4), pytest.approx(0.03, abs=2e-4))
    # Only 5 ms may be taken of it.
    assert hic(T, pulse, 0.005)[0] == pytest.approx(500, rel=1e-6)


def test_hic_of_a_half_sine():
    # Chou & Nyquist 1974 (SAE 740082): 0.4146 A^2.5 T for an unrestricted interval.
    assert hic(T, HALF_SINE, 0.036)[0] == pytest.approx(0.4146 * 100 ** 2.5 * 0.012, rel=1e-3)


def test_sustained_level_of_a_triangle():
    # Peak 60 over 12 ms: above the level y for 12 ms (1 - y / 60), so 3 ms lie above 45.
    triangle = np.interp(T, [0, 0.006, 0.012], [0, 60, 0])
    assert sustained_level(T, triangle) == pytest.approx(45, abs=1e-6)
    # Two such peaks: one interval still says 45, both together 3 ms above 52.5.
    twice = np.interp(T, [0, 0.006, 0.012, 0.05, 0.056, 0.062], [0, 60, 0, 0, 60, 0])
    assert sustained_level(T, twice) == pytest.approx(45, abs=1e-6)
    assert sustained_level(T, twice, cumulative=True) == pytest.approx(52.5, abs=1e-6)


def test_bric_and_gambit_by_hand():
    omega = np.array([[66.25, 0, 0], [0, -56.45, 0], [0, 0, 42.87]])
    assert bric(omega) == pytest.approx(np.sqrt(3))
    # Both at their limits, but only together count: 2^(1/2.5).
    assert gambit([250 * STANDARD_GRAVITY], [25000.0]) == pytest.approx(2 ** 0.4)
    assert gambit([250 * STANDARD_GRAVITY, 0], [0, 25000.0]) == pytest.approx(1.0)


def test_damage_of_a_long_push_is_static():
    # A constant angular acceleration deflects by K^-1 alpha in the end; y is uncoupled and damped
    # at 0.45 of critical, so its largest deflection overshoots by exp(-pi z / sqrt(1 - z^2)).
    t = np.arange(5000) * 1e-4
    push = np.tile([0, 1000.0, 0], (len(t), 1))
    ratio = 0.5 * 5.9148e-3 * np.sqrt(23493)
    overshoot = 1 + np.exp(-np.pi * ratio / np.sqrt(1 - ratio ** 2))
    assert damage(t, push) == pytest.approx(2.9903 * 1000 / 23493 * overshoot, rel=1e-4)


@pytest.mark.parametrize("channel_class", [60, 180, 600, 1000])
def test_channel_filter_has_the_gain_of_its_class(channel_class):
    # SAE J211: about -3 dB at 1.65 times the class, no phase; flat far below.
    rate = 20_000.0
    t = np.arange(20_000) / rate
    for frequency, low, high in ((0.1, 0.99, 1.01), (1.65, 0.66, 0.75), (4.0, 0.0, 0.1)):
        wave = np.cos(2 * np.pi * frequency * channel_class * t)
        middle = slice(5000, 15000)
        filtered = channel_filter(wave, rate, channel_class)[middle]
        gain = filtered @ wave[middle] / (wave[middle] @ wave[middle])
        assert low < gain < high
    step = channel_filter(np.ones(100), rate, channel_class)
    assert np.allclose(step, 1.0, atol=1e-9)  # ends are padded


def test_impossible_channel_classes_are_refused():
    with pytest.raises(SampleError, match="CFC"):
        channel_filter(np.ones(100), 1000.0, 100)
    with pytest.raises(SampleError, match="10000 Hz"):
        channel_filter(np.ones(100), 1000.0, 1000)


def test_pyisomme_agrees():
    pyisomme = pytest.importorskip("pyisomme", reason="pyisomme is only an oracle")
    import pandas
    from pyisomme.calculate.damage import calculate_damage
    from pyisomme.calculate.hic import calculate_hic
    from pyisomme.calculate.xms import calculate_xms

    def channel(code, values, unit):
        return pyisomme.Channel(code, pandas.DataFrame({"v": values}, index=T), unit=unit)

    magnitude = np.abs(HALF_SINE + 200 * np.sin(900 * T) * np.exp(-60 * T))
    head = channel("11HEAD0000H3ACRA", magnitude, "m/s^2")
    # Its HIC always takes the longest interval, which is right for long pulses only, and stops
    # one sample short of it.
    long = 100 * STANDARD_GRAVITY * np.sin(np.pi * T / 0.2)
    assert hic(T, long, 0.015)[0] == pytest.approx(float(calculate_hic(
        channel("11HEAD0000H3ACRA", long, "m/s^2"), 15).get_data()[0]), rel=0.01)
    assert sustained_level(T, magnitude) == pytest.approx(
        float(calculate_xms(head, 3, "S").get_data()[0]), rel=1e-6)
    assert sustained_level(T, magnitude, cumulative=True) == pytest.approx(
        float(calculate_xms(head, 3, "C").get_data()[0]), rel=1e-6)
    alpha = 3000 * np.column_stack([np.sin(200 * T), np.cos(150 * T), np.sin(90 * T)])
    alpha *= np.exp(-40 * T)[:, None]
    found = calculate_damage(*(channel(f"11HEAD0000H3AA{a}A", alpha[:, i], "rad/s^2")
                               for i, a in enumerate("XYZ")))
    values = [float(np.max(np.abs(c.get_data()))) for c in found if "R" in str(c.code)[14:15]]
    # Its integrator is adaptive with a tolerance of about 1e-3.
    assert damage(T, alpha) == pytest.approx(values[0], rel=5e-3)


def test_events_have_pretrigger_and_do_not_overlap():
    magnitude = np.zeros_like(T)
    for at in (0.05, 0.08, 0.15):
        magnitude[(at - 1e-9 <= T) & (at + 0.002 > T)] = 200.0
    events = find_events(T, magnitude, ImpactParams(before=0.01, duration=0.06))
    assert [(T[e][0], T[e][-1]) for e in events] == [
        (pytest.approx(0.04, abs=2e-4), pytest.approx(0.10, abs=2e-4)),
        (pytest.approx(0.14, abs=2e-4), pytest.approx(0.20, abs=2e-4))]


@pytest.fixture(scope="module")
def impact():
    motion = simulate(duration=1.0)
    sensors = [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()), noise_density=1e-6,
                                   bias_sd=0.0) for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]
    params = AccelerationFieldParams(
        method="ao", initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0)), gravity=9.8)
    rows = AccelerationFieldEstimator(params, sensors).run(
        motion.stamp, motion.readings(PAPER_POSITIONS, PAPER_AXES))
    return motion, rows


def test_metrics_of_the_simulated_impact(impact):
    motion, rows = impact
    center = (0.0, 0.0, 0.75)
    found = measure_impacts(rows, [center, (0.1, 0, 0.75)], 9.8, ImpactParams(trigger=20.0))
    assert [f["point"][0] for f in found] == [0.0, 0.1]
    first = found[0]
    event = (motion.t >= first["begin_s"]) & (motion.t <= first["begin_s"] + 0.2)
    truth = motion.acceleration_world(center)[event]
    assert first["peak_linear_acceleration"] == pytest.approx(
        np.linalg.norm(truth, axis=1).max(), rel=1e-3)
    change = np.linalg.norm(motion.velocity[event] - motion.velocity[event][0], axis=1).max()
    assert first["peak_velocity_change"] == pytest.approx(change, rel=1e-3)
    assert first["peak_angular_velocity"] == pytest.approx(
        np.linalg.norm(motion.omega[event], axis=1).max(), rel=1e-3)
    assert first["hic15"] <= first["hic36"]
    assert first["clip_3ms"] < first["peak_linear_acceleration"]
    assert first["saturated_samples"] == 0 and first["complete"]
    json.dumps(found)


def test_peaks_need_no_impact_and_all_numbers_have_units(impact):
    motion, rows = impact
    center = (0.0, 0.0, 0.75)
    peaks = find_peaks(rows, [center], 9.8)
    assert peaks["peak_linear_acceleration"][0] == pytest.approx(
        np.linalg.norm(motion.acceleration_world(center), axis=1).max(), rel=1e-3)
    assert peaks["peak_angular_velocity"] == pytest.approx(
        np.linalg.norm(motion.omega, axis=1).max(), rel=1e-3)
    (event, *_) = measure_impacts(rows, [center], 9.8, ImpactParams(trigger=20.0))
    numbers = {k for k, v in {**event, **peaks}.items() if isinstance(v, (float, list))}
    assert numbers <= set(UNITS)


def test_axes_matter_for_damage_only(impact):
    _, rows = impact
    plain, j211 = (measure_impacts(rows, [(0, 0, 0.75)], 9.8,
                                   ImpactParams(trigger=20.0, axes=a))[0]
                   for a in ("rep103", "j211"))
    assert plain["damage"] != pytest.approx(j211["damage"], rel=1e-3)
    for name in ("hic15", "bric", "gambit", "peak_velocity_change"):
        assert plain[name] == pytest.approx(j211[name], rel=1e-12)


def test_channel_class_is_recorded_and_uneven_records_are_refused(impact):
    _, rows = impact
    found = measure_impacts(rows, [], 9.8, ImpactParams(trigger=20.0, linear_class=60))
    assert found[0]["linear_class"] == 60 and found[0]["angular_class"] is None
    inside = np.searchsorted(rows["stamp"], found[0]["stamp"]) + 50
    (uneven,) = measure_impacts(np.delete(rows, inside), [], 9.8, ImpactParams(
        trigger=20.0))[:1]
    assert "not even" in uneven["refused"] and "hic15" not in uneven
    assert measure_impacts(rows[:2], [], 9.8) == []


def test_impacts_that_are_not_looked_for_are_not_found(impact):
    assert measure_impacts(impact[1], [], 9.8, ImpactParams(trigger=20.0))
    assert measure_impacts(impact[1], [], 9.8, ImpactParams(trigger=20.0, detect=False)) == []
