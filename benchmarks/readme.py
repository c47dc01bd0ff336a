"""Write the table of results of README.md from what the benchmarks wrote.

    python -m benchmarks.readme

Every figure is looked up in benchmarks/results by the row and column of its table: a benchmark that
calls them otherwise ends this with a message, so that no figure is left behind.
"""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Figure:
    """A cell of a table in benchmarks/results.

    ``row`` is the beginning of its line, cells separated by ' | '; ``column`` its heading;
    ``pattern`` picks part of the cell (its first group).
    """

    table: str
    row: str
    column: str
    pattern: str = "(.*)"

    def __str__(self):
        lines = (RESULTS / f"{self.table}.md").read_text().splitlines()
        rows = [[cell.strip() for cell in line.strip("|").split("|")]
                for line in lines if line.startswith("|")]
        wanted = self.row.split(" | ")
        columns = next((row for row in rows if self.column in row), [])
        found = [row for row in rows if row[:len(wanted)] == wanted]
        if len(found) != 1 or not columns:
            raise SystemExit(f"{self.table}.md: {len(found)} rows '{self.row}', "
                             f"{'a' if columns else 'no'} column '{self.column}'")
        match = re.match(self.pattern, found[0][columns.index(self.column)])
        if match is None:
            raise SystemExit(f"{self.table}.md: '{self.row}' does not match {self.pattern}")
        return match[1].strip()


_FIRST = r"([\d.]+)"
_BROAD = ("as recorded: total / heading / inclination, deg", _FIRST)
_CLIPPED = ("total / heading / inclination, deg", _FIRST)


def _broad(estimator):
    return Figure("orientation_broad", f"{estimator} | defaults", *_BROAD)


def _clipped(estimator):
    return Figure("orientation_clipping", f"BROAD 06 08 21 28, 300 deg/s | 24.3 % | {estimator}",
                  *_CLIPPED)


def _car(estimator, column="tilt RMS, deg"):
    return Figure("orientation_vehicles",
                  f"car, 549 s, no magnetometer | 0.2 | {estimator}", column)


def _car_with_share(estimator):
    return f"{_car(estimator)} ({_car(estimator, 'within 3 sigma')})"


def _set(name, mode, column="ours"):
    return Figure("orientation_sets", f"{name} | {_trials(name)} | {mode}", column, _FIRST)


def _trials(name):
    lines = (RESULTS / "orientation_sets.md").read_text().splitlines()
    return next(line.split(" | ")[1] for line in lines if line.startswith(f"| {name} |"))


def _impact(method):
    return Figure("acceleration_field_independent", "10", method, _FIRST)


def _board(method):
    return Figure("acceleration_field_clipped", f"run 1 | {method}", "rms error, rad/s")


def rows():
    """List of (what was measured, ours, others, name of the table that holds all of it)."""
    return [
        ("Orientation of a hand-turned sensor, 9 trials of BROAD on which the defaults were chosen, against an optical reference: "
         "RMS, deg",
         f"{_broad('fusion, causal')} live, {_broad('fusion, smoothed')} smoothed",
         f"VQF {_broad('VQF')}, OfflineVQF {_broad('OfflineVQF')}, "
         f"Madgwick {_broad('Madgwick (ahrs)')}, "
         f"Winkler 2025 as printed {_broad('gyro_mag as printed (Winkler 2025)')}",
         "orientation_broad"),
        ("The same, gyroscopes cut off at 300 deg/s (24.3 % of the samples): RMS, deg",
         f"{_clipped('fusion, causal')} live, {_clipped('fusion, smoothed')} smoothed",
         f"OfflineVQF {_clipped('OfflineVQF')}", "orientation_clipping"),
        *((f"The same defaults, chosen with a look at this set, too, on {what}: RMS, deg",
           f"{_set(name, 'causal')} live, {_set(name, 'smoothed')} smoothed",
           "VQF {}, OfflineVQF {}".format(*(
               _set(name, mode, "peer: total / inclination / heading, deg")
               for mode in ("causal", "smoothed"))), "orientation_sets")
          for what, name in (("a kinematic chain in a building (DIODEM)", "DIODEM"),
                             ("phones that are carried", "phones, no magnets"),
                             ("a robot arm, no magnetometer", "OpenAXES, no magnetometer"))),
        ("Tilt of a car without GNSS: RMS, deg (share within 3 stated sigma)",
         f"vehicle preset, live {_car_with_share('fusion, orientation_vehicle.yaml, causal')}; "
         f"defaults {_car_with_share('fusion, causal')}",
         f"VQF {_car('VQF')}", "orientation_vehicles"),
        ("Acceleration field, SIMULATED head impact, noise 10: relative error x1e-3",
         f"{_impact('causal filter')} live, {_impact('smoother')} smoothed",
         f"AO, Rahaman 2019 {_impact('AO (paper)')}", "acceleration_field_independent"),
        ("Gyroscope cut off at 1000 deg/s, filled in by 8 accelerometers: RMS on the cut-off "
         "axes, rad/s",
         f"{_board('rigid_body, causal')} live, {_board('rigid_body, smoothed')} smoothed",
         f"spline {_board('cubic spline through the rest')}", "acceleration_field_clipped"),
        ("SIMULATED ski jumps, 300: position RMS forward/right/down, m",
         str(Figure("smoother_jump", "iterated, 300 seeds", "position x/y/z m")),
         "Fang 2020 in this package, median of 30: "
         + str(Figure("smoother_jump", "the same, median over seeds", "position x/y/z m")),
         "smoother_jump"),
        ("Car, 11 x 15 s without GNSS, against RTK: position RMS, m",
         str(Figure("smoother_drive", "withheld 11 x 15 s, 3D", "RMS m")), "", "smoother_drive"),
        ("One orientation step (magnetometer and Imu): us of one core",
         f"{Figure('orientation_speed', 'fusion, causal', 'batch, us/sample')} in batch, "
         f"{Figure('orientation_speed', 'fusion, causal', 'single call, us')} alone",
         f"VQF {Figure('orientation_speed', 'VQF', 'batch, us/sample')}", "orientation_speed"),
    ]


def results():
    """The table of :func:`rows`."""
    lines = ["| what | this package | others, same data | all of it |", "|---|---|---|---|"]
    lines += [f"| {what} | {ours} | {others} | [table](benchmarks/results/{table}.md) |"
              for what, ours, others, table in rows()]
    return "\n".join(lines) + "\n"


def fill(text, name, content):
    """``text`` with the block of this name replaced.

    Raises:
        SystemExit: there is no such block, or more than one.
    """
    pattern = re.compile(rf"(<!-- generated: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    filled, count = pattern.subn(lambda m: m[1] + content + m[2], text)
    if count != 1:
        raise SystemExit(f"there are {count} blocks 'generated: {name}'")
    return filled


def main():
    """Rewrite README.md."""
    readme = ROOT / "README.md"
    readme.write_text(fill(readme.read_text(), "results", results()))


if __name__ == "__main__":
    main()
