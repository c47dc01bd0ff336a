"""Run every benchmark (hours on two cores) and write README.md's tables: ``make bench``.

    python -m benchmarks [NAME ...]    # only these, such as smoother_drive
"""

import subprocess
import sys
from pathlib import Path

NOT_RUN = {"__init__", "__main__", "table", "data", "jumps", "acceleration_field_cases",
           "readme", "images", "reference", "architecture", "recording_of_all", "fuzz_devices",
           "smoother_misfits", "misfits_field", "misfits_inputs", "scenarios"}    # misfits runs them


def main(names):
    """Each in a process of its own, so that none warms up or burdens another."""
    known = sorted(f.stem for f in Path(__file__).parent.glob("*.py") if f.stem not in NOT_RUN)
    unknown = set(names) - set(known)
    if unknown:
        raise SystemExit(f"no benchmark {', '.join(sorted(unknown))}; there are: {', '.join(known)}")
    for name in names or known:
        print(f"== {name}", flush=True)
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=True)
    subprocess.run([sys.executable, "-m", "benchmarks.readme"], check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
