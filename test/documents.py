"""What the documentation says, checked against the package: commands, names, files, links."""

import importlib
import re
import shlex
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import click
import yaml

from benchmarks.reference import PER_SENSOR, node_class
from imu_fusion import cli
from imu_fusion.demos import DEMOS
from imu_fusion.errors import ImuFusionError
from imu_fusion.nodes import NODES
from imu_fusion.parameters.file import load, parameters_for
from imu_fusion.recordings.convert import convert
from imu_fusion.sources.description import Description
from imu_fusion.streams.registry import STAGES
from imu_fusion.surfaces.file import surface_from_mapping

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md",
         *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"bash", "python", "yaml", "text"}
# In a sentence, so many words behind a program are still a name, no command to be read.
NAMES_ALONE = {"imu_fusion": 0, "make": 0, "pip": 0, "python": 1, "ros2": 2}
# Programs of others: only that they exist in this world is known.
FOREIGN = {"git", "cd", "source", "rosdep", "colcon", "python3", "chromium", "sudo"}
# Not of a stage: those of the nodes' flow control, of the clock and of recordings in bags/.
TOPICS = {"clock", "diagnostics", "<node>/_flow/<instance>", "recorder/summary",
          "reference/pose", "reference/moving",
          "reference/jump", "onboard_ekf/pose", "accelerometers/<name>"}


@dataclass(frozen=True)
class Block:
    """A fenced block; ``name``: the file that it is, where the text before it ends in `name`:"""

    line: int
    language: str
    text: str
    name: str | None


def blocks(text):
    """The fenced blocks of a page."""
    found = []
    for match in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        before = text[:match.start()].rstrip().rpartition("\n")[2]
        name = re.search(r"`([\w.]+\.yaml)`[^`]*:$", before)
        found.append(Block(text.count("\n", 0, match.start()) + 1, match[1], match[2],
                           name and name[1]))
    return found


def prose(text):
    """A page without its fenced blocks and comments, line for line."""
    def blank(match):
        return "\n" * match[0].count("\n")

    text = re.sub(r"^```.*?^```$", blank, text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"<!--.*?-->", blank, text, flags=re.DOTALL)


def commands(text):
    """The commands of a bash block, as lists of words."""
    joined = text.replace("\\\n", " ")
    for line in joined.splitlines():
        words = shlex.split(line, comments=True)
        while words:
            cut = next((i for i, word in enumerate(words) if word in ("&&", "|", ";")), len(words))
            yield [word for i, word in enumerate(words[:cut])
                   if i or not re.match(r"[A-Z_]+=", word)]
            words = words[cut + 1:]


@cache
def node_parameters(node):
    """Names of a node's parameters; those of single sensors with * for the sensor's name."""
    names = {info.name for cls in node_class(node).PARAMETERS for info in cls.infos()}
    for prefix, cls in PER_SENSOR.get(node, {}).items():
        names |= {prefix.replace("<name>", "*") + info.name for info in cls.infos()}
        names |= {"accelerometers.names"}
    return names


@cache
def all_parameters():
    """Names of the parameters of all nodes."""
    return frozenset().union(*(node_parameters(node) for node in NODES))


@cache
def old_names():
    """dict of old to new name, of names that mean nothing any more."""
    return {old: new for node in NODES for cls in node_class(node).PARAMETERS
            for old, new in cls.OLD_NAMES.items() if old not in all_parameters()}


@cache
def topics():
    """Topics, without leading slash."""
    return frozenset(TOPICS).union(*({*stage.inputs, *stage.outputs} for stage in STAGES.values()))


def services():
    """Services as node/name."""
    return {f"{node}/{name}" for node, executable in NODES.items() for name in executable.services}


def is_parameter(name, known=None):
    """Whether a parameter, or a group of them, is called so; ``<name>`` stands for any sensor's."""
    name = name.replace("<name>", "any")
    known = all_parameters() if known is None else known
    groups = {pattern.rpartition(".")[0] for pattern in known}
    return any(fnmatch(name, pattern) or fnmatch(pattern, name) for pattern in known | groups)


class Checker:
    """Collects what is wrong with one page."""

    def __init__(self, path, text, folder):
        self.path, self.text, self.folder = path, text, folder
        self.problems = []
        self.line = 0

    def complain(self, words):
        self.problems.append(f"{self.path.name}:{self.line}: {words}")

    def run(self):
        """The problems, a line each."""
        for block in blocks(self.text):
            self.line = block.line
            if block.language not in LANGUAGES:
                self.complain(f"block of language '{block.language}'")
            elif block.language == "bash":
                for words in commands(block.text):
                    self.command(words)
            elif block.language == "yaml":
                self.yaml(block.text)
        for number, line in enumerate(prose(self.text).splitlines(), 1):
            self.line = number
            for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", line):
                self.inline(code)
            for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", line)):
                self.link(target)
        return self.problems

    # Commands

    def command(self, words):
        """One command of a shell."""
        program, *rest = words
        for word in rest:
            self.file(word.partition(":=")[2] or word)
        if program == "imu_fusion":
            self.cli(rest)
        elif program == "ros2":
            self.ros2(rest)
        elif program == "make":
            self.make(rest)
        elif program in ("python", ".venv/bin/python"):
            self.python(rest)
        elif program in ("pip", ".venv/bin/pip"):
            self.pip(rest)
        elif program not in FOREIGN:
            self.complain(f"program '{program}' is not known")

    def cli(self, words):
        """A command of ours, with the parser that really reads it."""
        name, *arguments = words or [""]
        if name not in cli.cli.commands:
            if name not in ("--help", "--version"):
                self.complain(f"no command 'imu_fusion {name}'")
            return
        if name == "run" and arguments[:1] == ["NODE"]:
            arguments[0] = next(iter(NODES))
        try:
            context = cli.cli.commands[name].make_context(name, arguments)
        except click.exceptions.Exit:
            return
        except click.UsageError as error:
            self.complain(f"imu_fusion {name}: {error.format_message()}")
            return
        values = context.params
        if name == "demo" and values["name"] not in DEMOS and values["name"] != "NAME":
            self.complain(f"no demo '{values['name']}'")
        for node in values.get("without", ()):
            if node not in STAGES:
                self.complain(f"no estimator '{node}'")
        for remap in values.get("remap", ()):
            self.topic(remap.partition(":=")[0])
        if name == "run":
            self.ros_arguments(values["node"], list(values["arguments"]))
        elif name == "play":
            self.ros_arguments("replayer", list(values["arguments"]))
        elif name == "record":
            for topic in values["topics"]:
                self.topic(topic)

    def ros_arguments(self, node, words):
        """What comes behind the name of a node."""
        if words and words[0] in ("--help", "-h"):
            return
        if words and words[0] != "--ros-args":
            self.complain(f"{node}: unexpected argument '{words[0]}'")
        for flag, value in zip(words[1::2], words[2::2]):
            name = value.partition(":=")[0]
            if flag == "-p":
                if not is_parameter(name, node_parameters(node)) and name != "use_sim_time":
                    self.complain(f"{node} has no parameter '{name}'")
            elif flag == "-r":
                if name not in ("__node", "__ns"):
                    self.topic(name)
            elif flag != "--params-file":
                self.complain(f"{node}: unknown argument '{flag}'")

    def ros2(self, words):
        """A command of an installed ROS."""
        verb = " ".join(words[:2])
        rest = words[2:]
        if words[:2] == ["run", "imu_fusion"]:
            if rest[0] == "imu_fusion":
                self.cli(rest[1:] or ["--help"])
            elif rest[0] not in NODES:
                self.complain(f"no node '{rest[0]}'")
            else:
                self.ros_arguments(rest[0], rest[1:])
        elif words[:2] == ["launch", "imu_fusion"]:
            file = ROOT / "launch" / rest[0]
            if not file.exists():
                self.complain(f"no launch file '{rest[0]}'")
                return
            known = re.findall(r"DeclareLaunchArgument\(\s*\"(\w+)\"", file.read_text())
            for argument in rest[1:]:
                if argument.partition(":=")[0] not in known:
                    self.complain(f"{rest[0]} has no argument '{argument}'")
        elif verb in ("topic echo", "topic hz"):
            self.topic(rest[0])
        elif verb == "service call":
            self.service(rest[0])
        elif verb == "param set":
            if not is_parameter(rest[1], node_parameters(rest[0].strip("/"))):
                self.complain(f"{rest[0]} has no parameter '{rest[1]}'")
        elif verb not in ("bag play", "bag record"):
            self.complain(f"'ros2 {verb}' is not known here")

    def make(self, words):
        known = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        for word in words:
            if "=" not in word and word not in known:
                self.complain(f"Makefile has no target '{word}'")

    def python(self, words):
        if words[:1] != ["-m"] or words[1] in ("venv", "pip", "pytest"):
            return
        base = ROOT.joinpath(*words[1].split("."))
        if not base.with_suffix(".py").exists() and not (base / "__main__.py").exists():
            self.complain(f"no module '{words[1]}'")

    def pip(self, words):
        known = set(re.findall(r"\"(\w+)\": ?\w+", (ROOT / "setup.py").read_text()))
        for extras in re.findall(r"\[([\w,]+)\]", " ".join(words)):
            for extra in set(extras.split(",")) - known:
                self.complain(f"setup.py has no extra '{extra}'")

    # Names

    def topic(self, name):
        name = name.strip("/")
        if name not in topics() and not fnmatch(name, "accelerometers/*"):
            self.complain(f"no topic '{name}'")

    def service(self, name):
        if name.strip("/") not in services():
            self.complain(f"no service '{name}'")

    def module(self, name):
        """A dotted name of ours: a module, or something in one."""
        parts = name.split(".")
        for count in range(len(parts), 0, -1):
            base = ROOT.joinpath(*parts[:count])
            if base.is_dir() or base.with_suffix(".py").exists():
                break
        else:
            self.complain(f"no module '{name}'")
            return
        if parts[count:]:
            value = importlib.import_module(".".join(parts[:count]))
            for part in parts[count:]:
                value = getattr(value, part, None)
            if value is None:
                self.complain(f"'{name}': {'.'.join(parts[:count])} has no such name")

    def file(self, name):
        """A path that begins in a folder of ours has to exist; * and <name> stand for anything, and
        what follows :: is a function in it."""
        name, _, function = name.partition("::")
        first = name.split("/")[0]
        if "/" not in name or first in ("", "..", ".venv") or not (ROOT / first).is_dir():
            return False
        pattern = re.sub(r"<\w+>", "*", name.rstrip("/"))
        if not (list(ROOT.glob(pattern)) if "*" in pattern else (ROOT / pattern).exists()):
            self.complain(f"no file '{name}'")
        elif function and f"def {function}(" not in (ROOT / name).read_text():
            self.complain(f"no function '{function}' in {name}")
        return True

    def inline(self, code):
        """Code between backticks in a sentence."""
        first, *rest = code.split() or [""]
        if first == "imu_fusion" and len(rest) == 1 and rest[0] in cli.cli.commands:
            pass  # the command's name
        elif len(rest) > NAMES_ALONE.get(first, len(rest)):
            self.command(shlex.split(code))
        elif re.fullmatch(r"imu_fusion(\.\w+)+(\(\))?", code):
            self.module(code.removesuffix("()"))
        elif self.file(code) or code.startswith("/dev/"):
            pass
        elif re.fullmatch(r"/?[a-z_]+(/[a-z_<>]{2,})+", code):
            name = code.strip("/")
            if name not in topics() | services() and not fnmatch(name, "accelerometers/*"):
                self.complain(f"no topic or service '{code}'")
        elif code in old_names() and self.path.stem != "renamed":
            self.complain(f"parameter '{code}' is called '{old_names()[code]}' now")
        else:
            self.assignment(code)

    def assignment(self, code):
        """`group.name`, and `name: value` or `name:=value` where the name has a dot."""
        match = re.fullmatch(r"([a-z_]+(?:\.[\w*<>]+)+)(?:(?:: |:=).*)?", code)
        groups = {name.split(".")[0] for name in all_parameters() if "." in name}
        if match and match[1].endswith((".yaml", ".csv", ".html", ".md")):
            return
        if match and match[1].split(".")[0] in groups and not is_parameter(match[1]):
            self.complain(f"no parameter '{match[1]}'")
        old = re.match(r"(\w+)(?:: |:=)", code)
        if old and old[1] in old_names():
            self.complain(f"parameter '{old[1]}' is called '{old_names()[old[1]]}' now")

    # Files

    def yaml(self, text):
        """A parameter file, a surface, or the description of a table."""
        try:
            content = yaml.safe_load(text)
        except yaml.YAMLError as error:
            self.complain(f"not YAML: {error}")
            return
        path = self.folder / "block.yaml"
        path.write_text(text)
        try:
            if "ros__parameters" in text:
                self.parameter_file(path)
            elif "type" in content:
                if content["type"] != "elevation_grid":  # its file: test/surfaces
                    surface_from_mapping(content)
            elif "accelerometers" in content:
                _import_zeros(content, path)
            elif "time" in content:
                Description.from_mapping(content, path.name)
            else:
                self.complain("a YAML block of no known kind")
        except ImuFusionError as error:
            self.complain(str(error))

    def parameter_file(self, path):
        for node, values in load(path).items():
            if node == "**":
                for name in values:
                    if not is_parameter(name):
                        self.complain(f"no node has a parameter '{name}'")
            elif node in STAGES:
                STAGES[node].prepare(path)
            elif node in NODES:
                parameters_for(node_class(node).PARAMETERS, node, path)
            else:
                self.complain(f"no node '{node}'")

    def link(self, target):
        """A relative link: the file, and the heading in it, exist."""
        if re.match(r"\w+:", target):
            return
        name, _, anchor = target.partition("#")
        path = (self.path.parent / name).resolve() if name else self.path
        if not path.exists():
            self.complain(f"broken link '{target}'")
        elif anchor and anchor not in anchors(path.read_text() if name else self.text):
            self.complain(f"no heading for the link '{target}'")


def anchors(text):
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", prose(text), re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", re.sub(r"[`*]", "", heading).lower()).strip()
        found.add(re.sub(r"\s+", "-", plain))
    return found


def _import_zeros(description, path):
    """Import a table of zeros that has the columns described."""
    columns = [description["time"]["column"]] if "column" in description["time"] else []
    sensors = [*description["accelerometers"].values(), description.get("gyroscope", {})]
    columns += [name for sensor in sensors for name in sensor.get("columns", ())]
    table = path.with_suffix(".csv")
    table.write_text("\n".join(",".join([str(row)] + ["0"] * (len(columns) - 1)) if row else
                               ",".join(columns) for row in range(4)))
    convert(table, path.with_name("table"), path, overwrite=True)
