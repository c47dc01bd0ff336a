"""Checks of recorded samples: each trouble is found, named, and not seen where there is none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.samples import checks
from imu_fusion.samples.field_turning import check_axes
from imu_fusion.samples.flat_tops import GYRO_FLOOR, flat_tops
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog

RATE = 100
GRAVITY_WORLD = np.array([0.0, 0.0, 9.81])
FIELD_WORLD = np.array([1e-6, 20e-6, -44e-6])


def recording(n=2000, seed=0, acc_noise=0.05, gyr_noise=0.005, mag_noise=2e-7):
    """One second at rest, then rotation about a wandering axis: an exact Imu and magnetometer
    with a little noise, as (ImuLog, MagLog)."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / RATE
    envelope = np.where(time > 1, 2.0, 0.0)[:, None]
    gyr = envelope * np.column_stack([np.sin(1.1 * time), np.cos(0.7 * time), np.sin(0.4 * time)])
    rotation = [Rotation.identity()]
    for i in range(n - 1):
        rotation.append(rotation[-1] * Rotation.from_rotvec(0.5 * (gyr[i] + gyr[i + 1]) / RATE))
    rotation = Rotation.concatenate(rotation)
    acc = rotation.inv().apply(GRAVITY_WORLD) + rng.normal(0, acc_noise, (n, 3))
    mag = rotation.inv().apply(FIELD_WORLD) + rng.normal(0, mag_noise, (n, 3))
    stamp = 1_700_000_000_000_000_000 + np.arange(n) * (1_000_000_000 // RATE)
    return (ImuLog(stamp, gyr + rng.normal(0, gyr_noise, (n, 3)), acc), MagLog(stamp, mag))


def kinds(findings):
    return sorted({f.kind for f in findings})


def test_a_good_recording_has_no_findings():
    imu, mag = recording()
    assert checks.check_imu(imu) == []
    assert checks.check_mag(mag) == []
    assert check_axes(imu, mag, "imu/mag") == []


def test_timing_counts_gaps_repeats_and_steps_back():
    # 10 ms apart; one repeated, one 30 ms gap, one step back by 5 ms.
    stamp = np.array([0, 10, 20, 20, 30, 60, 70, 65, 75]) * 1_000_000
    times = checks.timing(stamp)
    assert (times.count, times.repeated, times.backwards, times.gaps) == (9, 1, 1, 1)
    assert times.longest_gap_s == pytest.approx(0.03)
    assert times.interval_s == pytest.approx(0.01)
    assert times.duration_s == pytest.approx(0.075)
    findings = checks.check_stamps(stamp, "imu/data_raw")
    assert kinds(findings) == ["gap", "stamp"]
    assert any("sample 7" in f.text and "backwards" in f.text for f in findings)
    assert all(f.text.startswith("imu/data_raw") for f in findings)


def test_one_lost_sample_is_a_gap_and_jitter_is_not():
    rng = np.random.default_rng(1)
    stamp = np.cumsum(rng.normal(10e6, 1e6, 500)).astype(np.int64)
    assert checks.timing(stamp).gaps == 0
    # Half of the central 68 % of a Gaussian is its standard deviation; 500 draws give it to 10 %.
    assert checks.timing(stamp).jitter_s == pytest.approx(1e-3, rel=0.15)
    assert checks.timing(np.arange(0, 500).repeat(1)[np.arange(500) != 250] * 10_000_000).gaps == 1


@pytest.mark.parametrize("stamp", [[], [5], [5, 5, 5]])
def test_degenerate_streams_have_no_rate(stamp):
    times = checks.timing(np.array(stamp, dtype=np.int64))
    assert times.count == len(stamp) and np.isnan(times.rate_hz)
    checks.check_stamps(np.array(stamp, dtype=np.int64), "x")


def test_stamps_below_zero_are_told():
    (finding,) = checks.check_stamps(np.arange(-3, 5) * 10_000_000, "imu/data_raw")
    assert "3 stamps below zero, the least -30000000" in finding.text


def test_unset_stamps_are_told():
    (finding,) = checks.check_stamps(np.zeros(5, np.int64), "imu/data_raw")
    assert "zero" in finding.text


@pytest.mark.parametrize("factor, unit", [(1 / 9.81, "g"), (1000 / 9.81, "mg")])
def test_acceleration_in_g_is_told_with_the_factor(factor, unit):
    imu, _ = recording()
    (finding,) = [f for f in checks.check_imu(ImuLog(imu.stamp, imu.gyr, imu.acc * factor))
                  if f.kind == "unit"]
    assert f"gravity in {unit}," in finding.text
    told = float(finding.text.split("multiply by ")[1])
    assert told * factor == pytest.approx(1, rel=1e-3)


def test_acceleration_without_gravity_and_with_a_wrong_range_is_told():
    imu, _ = recording()
    rng = np.random.default_rng(2)
    (finding,) = checks.check_acceleration(rng.normal(0, 0.02, (2000, 3)), imu.stamp, "imu")
    assert "gravity has been removed" in finding.text
    (finding,) = checks.check_acceleration(imu.acc * 2, imu.stamp, "imu")
    assert "calibration" in finding.text


@pytest.mark.parametrize("factor, unit", [
    (1e6, "microtesla"), (1e4, "gauss"), (1e7, "milligauss"), (1e9, "nanotesla")])
def test_magnetometer_units_are_told_with_the_factor(factor, unit):
    _, mag = recording()
    (finding,) = checks.check_mag(MagLog(mag.stamp, mag.mag * factor))
    assert finding.kind == "unit" and f"in {unit}," in finding.text
    assert float(finding.text.split("multiply by ")[1]) * factor == pytest.approx(1)


def test_odd_fields_are_told_apart():
    _, mag = recording()
    assert "calibrate" in checks.check_field(mag.mag * 3, "m")[0].text
    assert "zero" in checks.check_field(mag.mag * 0, "m")[0].text
    assert "not a magnetic field" in checks.check_field(mag.mag * 1e-3, "m")[0].text


def test_gyroscope_in_degrees_and_reversed_is_seen_by_the_field():
    imu, mag = recording()
    (finding,) = check_axes(ImuLog(imu.stamp, np.degrees(imu.gyr), imu.acc), mag, "imu/mag")
    assert finding.kind == "unit" and "deg/s" in finding.text
    (finding,) = check_axes(ImuLog(imu.stamp, -imu.gyr, imu.acc), mag, "imu/mag")
    assert finding.kind == "axes"


def test_axes_are_judged_in_spite_of_a_noisy_magnetometer_and_not_at_rest():
    # 1 uT of noise: more than the field turns by from sample to sample.
    imu, mag = recording(mag_noise=1e-6)
    assert check_axes(imu, mag, "m") == []
    degrees = ImuLog(imu.stamp, np.degrees(imu.gyr), imu.acc)
    assert kinds(check_axes(degrees, mag, "m")) == ["unit"]
    assert check_axes(degrees[:90], mag[:90], "m") == []  # at rest: nothing to tell by
    # An empty, a short and a stuck log have no axes to judge.
    for bad in (mag[:0], mag[:2], MagLog(np.zeros(50, np.int64), mag.mag[:50])):
        assert check_axes(imu, bad, "m") == []


def test_clipped_peaks_are_saturation_and_round_peaks_are_not():
    imu, _ = recording(gyr_noise=1e-3)
    clipped = np.clip(imu.gyr, -1.5, 1.5)
    tops = flat_tops(clipped, GYRO_FLOOR)
    assert {(t.axis, np.sign(t.limit)) for t in tops} == {(i, s) for i in range(3) for s in (1, -1)}
    assert all(abs(t.limit) == 1.5 for t in tops)
    assert sum(t.samples for t in tops if t.axis == 0) == pytest.approx(
        np.sum(np.abs(clipped[:, 0]) >= 1.5), rel=0.05)
    assert flat_tops(imu.gyr, GYRO_FLOOR) == []
    assert kinds(checks.check_imu(ImuLog(imu.stamp, clipped, imu.acc))) == ["saturation"]
    # One wild sample hides none of them.
    clipped[500] = 90.0
    assert len(flat_tops(clipped, GYRO_FLOOR)) == 6


def test_coarse_steps_and_held_samples_are_not_saturation():
    imu, mag = recording()
    step = np.round(imu.gyr / 0.05) * 0.05
    assert flat_tops(step, GYRO_FLOOR) == []
    held = MagLog(mag.stamp, mag.mag[np.arange(len(mag)) // 3 * 3])
    (finding,) = checks.check_mag(held)
    assert finding.kind == "held" and "33" in finding.text
    assert flat_tops(np.zeros((100, 3)), GYRO_FLOOR) == []


def test_values_that_are_not_finite_are_counted():
    imu, _ = recording()
    acc = imu.acc.copy()
    acc[[5, 9], 1] = np.nan, np.inf
    findings = checks.check_imu(ImuLog(imu.stamp, imu.gyr, acc))
    (finding,) = [f for f in findings if f.kind == "nan"]
    assert "2 of 2000" in finding.text and "sample 5" in finding.text and kinds(findings) == ["nan"]


def test_a_missing_gyroscope_and_halves_of_a_sensor_are_told():
    imu, _ = recording()
    (finding,) = [f for f in checks.check_imu(ImuLog(imu.stamp, 0 * imu.gyr, imu.acc))
                  if f.kind == "lacking"]
    assert "no gyroscope" in finding.text and "RealSense" in finding.text and finding.unusable
    alternate = (np.arange(len(imu)) % 2 == 0)[:, None]
    (finding,) = checks.check_parts(imu.gyr * alternate, imu.acc * ~alternate, "imu")
    assert "50% of the messages" in finding.text and finding.unusable
    # An Imu without accelerometer, and single lost samples, are neither.
    assert checks.check_parts(imu.gyr, 0 * imu.acc, "imu") == []
    lost = imu.acc.copy()
    lost[::50] = 0.0
    assert checks.check_parts(imu.gyr, lost, "imu") == []


def test_gravity_that_points_down_is_told():
    imu, _ = recording()
    still = imu[:100]
    assert checks.check_gravity_sign(still.acc, still.stamp, "imu") == []
    (finding,) = checks.check_gravity_sign(-still.acc, still.stamp, "imu")
    assert "-z is up" in finding.text and not finding.unusable


def test_two_frames_on_one_topic_are_told():
    assert checks.check_frames(["imu", "imu"], "imu") == checks.check_frames([], "imu") == []
    (finding,) = checks.check_frames({"imu": None, "other": None}, "imu/data_raw")
    assert "'imu', 'other'" in finding.text and finding.unusable


def test_no_fix_at_all_is_told():
    n = 3
    log = FixLog(stamp=np.arange(n) * 10 ** 9, latitude_deg=np.full(n, 47.0),
                 longitude_deg=np.full(n, 8.0), height=np.zeros(n),
                 cov_enu=np.zeros((n, 3, 3)), status=np.full(n, -1))
    (finding,) = checks.check_fix(log)
    assert finding.kind == "fix" and "3 of 3" in finding.text


@pytest.mark.parametrize("sd, told", [(35.0, True), (8.0, False), (0.0, False)])
def test_fixes_of_a_telephone_network_are_told(sd, told):
    n = 9
    cov = np.tile(np.eye(3) * sd ** 2, (n, 1, 1))
    cov[0] *= 400.0    # one that is still worse
    log = FixLog(stamp=np.arange(n) * 10 ** 9, latitude_deg=np.full(n, 47.0),
                 longitude_deg=np.full(n, 8.0), height=np.zeros(n), cov_enu=cov,
                 status=np.zeros(n))
    texts = [finding.text for finding in checks.check_fix(log)]
    assert [("35 to 700 m, 35 m as a rule" in text and "gnss.position_error_sd" in text)
            for text in texts] == [True] * told


def test_fixes_without_a_fix_are_told():
    n = 6
    log = FixLog(stamp=np.arange(n) * 10 ** 9, latitude_deg=[47, 47, 0, 95, 47, np.nan],
                 longitude_deg=[8, 8, 0, 8, 8, 8], height=np.zeros(n),
                 cov_enu=np.zeros((n, 3, 3)), status=[0, 0, 0, 0, -1, 0])
    findings = checks.check_fix(log)
    assert kinds(findings) == ["fix", "nan"]
    assert len(findings) == 4


def test_steady_braking_that_happens_to_be_quietest_is_no_finding():
    rng = np.random.default_rng(2)
    acc = np.tile([0.0, 0.0, 9.81], (2000, 1)) + rng.normal(0.0, 0.1, (2000, 3))
    acc[1000:1100, 0] += 7.0                            # one second of 0.7 g, and
    middle = acc[1000:1050].mean(axis=0)
    acc[1000:1050] = middle + 0.6 * (acc[1000:1050] - middle)
    norm = np.linalg.norm(acc, axis=1).reshape(-1, 50)
    assert norm.std(axis=1).argmin() == 20              # the quietest half second of all
    stamp = np.arange(2000) * 10_000_000
    assert checks.check_acceleration(acc, stamp, "imu") == []
    assert checks.check_acceleration(acc / 9.81, stamp, "imu")[0].kind == "unit"
