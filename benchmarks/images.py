"""Draw the picture of the README: the demo's recording, its estimate and the reference.

    python -m benchmarks.images

Needs a Chromium (``chromium``, ``chromium-browser`` or ``google-chrome``) to draw with.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from imu_fusion import batch
from imu_fusion.evaluation.orientation_error import moving_at, orientation_errors, statistics
from imu_fusion.messages.convert import attitude_log
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.contents import moving_changes
from imu_fusion.report.figures import time_figure
from imu_fusion.report.html import Figure, scripts
from imu_fusion.report.orientation import angle_panels, error_panels

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "broad_06_fast_rotation"
TARGET = ROOT / "docs" / "images" / "orientation.png"
WINDOW_S = 5.0
WIDTH, HEIGHT = 1180, 620


def page():
    """The HTML of the picture."""
    with tempfile.TemporaryDirectory() as folder, open_bag(BAG) as reader:
        batch.process(BAG, Path(folder) / "out")
        with open_bag(Path(folder) / "out") as made:
            estimate = read_log(made, "imu/data", attitude_log)
        reference = read_log(reader, "reference/pose")
        moving = moving_at(estimate.stamp, *moving_changes(reader))
    origin = estimate.stamp[0]
    errors = orientation_errors(estimate.stamp, estimate.quat_world_imu, reference,
                                estimate.cov_attitude)
    # The window in which the sensor turns fastest.
    rate = np.linalg.norm(estimate.gyr, axis=1)
    length = np.searchsorted(estimate.stamp, origin + int(WINDOW_S * 1e9))
    mean = np.convolve(rate, np.ones(length) / length, mode="valid")
    start = int(np.argmax(mean))
    window = slice(start, start + length)
    left = time_figure(angle_panels(
        estimate[window], origin,
        reference.between(estimate.stamp[start], estimate.stamp[start + length - 1]),
        "optical reference"), panel_height=160)
    right = time_figure(error_panels(errors, origin, "error"), panel_height=160)
    for figure in (left, right):
        figure.update_layout(margin=dict(r=10), width=WIDTH // 2)
    total, heading, inclination = statistics(errors, moving)
    title = (f"{mean[start] * 180 / np.pi:.0f} °/s on average over these {WINDOW_S:.0f} s",
             f"RMS error {total.rmse_deg:.2f}°: heading {heading.rmse_deg:.2f}°, "
             f"inclination {inclination.rmse_deg:.2f}°")
    columns = "".join(f"<div><h3>{text}</h3>{Figure(figure, linked=False).render()}</div>"
                      for text, figure in zip(title, (left, right)))
    return f"""<!DOCTYPE html><meta charset="utf-8"><style>
body {{ margin: 0; display: flex; font-family: system-ui, sans-serif; background: #fff; }}
h3 {{ margin: 14px 0 0 84px; font-size: 15px; font-weight: 600; color: #1f2933; }}
figure {{ margin: 0; }}</style>{columns}{scripts()}"""


def screenshot(html, target, width, height):
    """Draw a page with Chromium into a PNG file."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next((path for path in map(shutil.which, names) if path), None)
    if browser is None:
        raise SystemExit("no Chromium found; install one to draw pictures")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "page.html"
        source.write_text(html, encoding="utf-8")
        subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
             "--disable-background-networking", "--disable-component-update", "--disable-sync",
             "--hide-scrollbars", "--virtual-time-budget=15000", f"--user-data-dir={folder}/user",
             f"--window-size={width},{height}", f"--screenshot={target}", source.as_uri()],
            check=True, capture_output=True, timeout=120)


def main():
    """Write docs/images/orientation.png."""
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    screenshot(page(), TARGET, WIDTH, HEIGHT)
    print(f"{TARGET.relative_to(ROOT)}: {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
