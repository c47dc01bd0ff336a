from glob import glob
from runpy import run_path

from setuptools import find_packages, setup

package_name = "imu_fusion"


def tree(source, target, patterns):
    """data_files entries that install the files of ``source`` below share/<package>/``target``."""
    files = sorted(path for pattern in patterns for path in glob(f"{source}/{pattern}"))
    return [(f"share/{package_name}/{target}", files)] if files else []


# PyPI builds of ROS 2 Jazzy, for machines without an apt ROS. Never mix the two.
ros = ["ros-jazzy-rclpy>=7.1,<8", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"]
report = ["plotly>=5.15", "matplotlib>=3.7"]
notebook = ["pandas>=2"]
devices = ["pyubx2>=1.2.40", "pynmeagps>=1.0.40", "pyulog>=1.0", "python-calamine>=0.2.3"]
terrain = ["rasterio>=1.3", "pyproj>=3.4"]
# Brings matplotlib and sphinx along.
calibrate = ["allantools>=2024.6"]
peers = ["vqf>=2.1", "imufusion>=1.2", "ahrs>=0.4"]
oracles = ["pyisomme>=1"]
docs = ["mkdocs>=1.6,<2", "mkdocs-material>=9.5,<10"]
test = ["ruff~=0.17.6", "mypy~=2.4.1", "types-PyYAML",
        "pytest>=7.4", "pytest-xdist>=3.5", "pytest-cov>=5",
        "hypothesis>=6", "openpyxl>=3.1", "colcon-common-extensions",
        *devices, *report, *notebook, *terrain, *calibrate, *docs]

# Read, not imported: nothing of the package is installed yet.
nodes = run_path(f"{package_name}/nodes/__init__.py")["NODES"]
version = run_path(f"{package_name}/__init__.py")["__version__"]

setup(
    name=package_name,
    version=version,
    description="Orientation, acceleration fields and trajectories from inertial sensors",
    long_description="ROS 2 Jazzy package for live and replayed inertial sensor fusion.",
    author="imu_fusion maintainers",
    maintainer="imu_fusion maintainers",
    maintainer_email="maintainers@imu-fusion.example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=["imu_fusion", "imu_fusion.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        *tree("launch", "launch", ["*.launch.py"]),
        *tree("config", "config", ["*.yaml", "*.phyphox", "*.json"]),
        *tree("config/surfaces", "config/surfaces", ["*.yaml", "*.asc"]),
        *tree("bags", "bags", ["README.md"]),
        *[entry for folder in sorted(glob("bags/*/"))
          for entry in tree(folder.rstrip("/"), folder.rstrip("/"), ["*"])],
    ],
    install_requires=[
        "numpy>=1.26", "scipy>=1.11", "numba>=0.60", "PyYAML>=6",
        "rosbags>=0.10", "mcap>=1.1", "zstandard", "lz4",
        "pymap3d>=3.1", "pygeomag>=1.1", "click>=8.1", "rich>=13",
    ],
    extras_require={"ros": ros, "report": report, "notebook": notebook, "calibrate": calibrate,
                    "devices": devices, "terrain": terrain,
                    "peers": peers,
                    "oracles": oracles, "docs": docs, "test": test},
    entry_points={"console_scripts": [
        "imu_fusion = imu_fusion.cli:main",
        *[f"{node} = imu_fusion.nodes:main" for node in nodes],
    ]},
    package_data={"imu_fusion": ["py.typed"], "imu_fusion.report": ["*.css", "*.js", "*.txt"],
                  "imu_fusion.nodes.flow": ["*.xml"]},
    zip_safe=False,
)
