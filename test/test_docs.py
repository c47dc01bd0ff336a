"""Commands, code, names, links and generated parts of README.md and docs/."""

import ast
import re
import subprocess
import sys

import pytest
from click.testing import CliRunner

from benchmarks import architecture, readme, reference
from imu_fusion import cli
from test.documents import PAGES, ROOT, Checker, blocks, commands

TUTORIALS = [page for page in PAGES if page.parent.name == "tutorials"]
CARRIED_OUT = [ROOT / "README.md", *TUTORIALS]
ids = dict(ids=lambda page: str(page.relative_to(ROOT)))
# Shown here, run by the tests of the demos and of the pipeline: they start nodes.
STARTS_NODES = ("demo", "pipeline", "run", "play", "record")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A directory to run in that looks like the checkout to a command."""
    for name in ("bags", "config", "launch"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, **ids)
def test_what_a_page_names_exists(page, tmp_path):
    problems = Checker(page, page.read_text(), tmp_path).run()
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("text, words", [
    ("```bash\nimu_fusion process BAG OUT --param-file x.yaml\n```", "No such option"),
    ("```bash\nimu_fusion proces BAG OUT\n```", "no command 'imu_fusion proces'"),
    ("```bash\nimu_fusion process BAG\n```", "Missing argument"),
    ("```bash\nimu_fusion demo acceleration_field\n```", "no demo 'acceleration_field'"),
    ("```bash\nimu_fusion info bags/broad_07\n```", "no file 'bags/broad_07'"),
    ("```bash\nimu_fusion process BAG OUT --params-file config/none.yaml\n```", "no file"),
    ("```bash\nimu_fusion process BAG OUT --without orientation\n```", "no estimator"),
    ("```bash\nimu_fusion process BAG OUT --remap imu/raw:=/x\n```", "no topic 'imu/raw'"),
    ("```bash\nimu_fusion run orientation_estimatr\n```", "orientation_estimatr"),
    ("```bash\nros2 run imu_fusion smoother --ros-args -p sensor.nothing:=1\n```", "no parameter"),
    ("```bash\nros2 run imu_fusion player\n```", "no node 'player'"),
    ("```bash\nros2 launch imu_fusion replay.launch.py baag:=x\n```", "no argument 'baag:=x'"),
    ("```bash\nros2 launch imu_fusion play.launch.py\n```", "no launch file"),
    ("```bash\nros2 service call /smoother/smoothe std_srvs/srv/Trigger\n```", "no service"),
    ("```bash\nros2 topic echo /imu/dta\n```", "no topic 'imu/dta'"),
    ("```bash\nmake demos\n```", "no target 'demos'"),
    ("```bash\npython -m benchmarks.nothing\n```", "no module 'benchmarks.nothing'"),
    ("```bash\npip install 'imu_fusion[maps]'\n```", "no extra 'maps'"),
    ("```bash\nimufusion info BAG\n```", "program 'imufusion' is not known"),
    ("```yaml\nsmoother:\n  ros__parameters: {surfaces: x}\n```", "unknown parameter 'surfaces'"),
    ("```yaml\nsmother:\n  ros__parameters: {method: iterated}\n```", "no node 'smother'"),
    ("```yaml\n/**:\n  ros__parameters: {nothing: 1}\n```", "no node has a parameter 'nothing'"),
    ("```yaml\ntype: plane\nslope: 3\n```", "plane"),
    ("```yaml\nkey: value\n```", "no known kind"),
    ("```\nx\n```", "language ''"),
    ("`imu_fusion demo nothing`", "no demo 'nothing'"),
    ("`config/none.yaml`", "no file"),
    ("`test/test_docs.py::test_nothing`", "no function 'test_nothing'"),
    ("`imu_fusion.batch.proces`", "no such name"),
    ("`smoother/odometri`", "no topic or service"),
    ("`impact.trigggger`", "no parameter"),
    ("[x](none.md)", "broken link"),
    ("# Title\n[x](#titel)", "no heading"),
    ("[x](docs/surfaces.md#no-such)", "no heading"),
])
def test_a_wrong_option_name_path_or_link_is_found(text, words, tmp_path):
    problems = Checker(ROOT / "README.md", text, tmp_path).run()
    assert len(problems) == 1 and words in problems[0], problems


def commented(path):
    """The commands in the comments of a file, a line each."""
    return re.findall(r"^#\s+((?:imu_fusion|ros2) .*)$", path.read_text(), re.MULTILINE)


@pytest.mark.parametrize("path", sorted((ROOT / "config").rglob("*.yaml")),
                         ids=lambda path: path.stem)
def test_commands_in_comments_of_presets_are_read(path, tmp_path):
    checker = Checker(path, "", tmp_path)
    for line in commented(path):
        for words in commands(line):
            checker.command(words)
            assert "--params-file" not in words or words[words.index("--params-file") + 1] == str(
                path.relative_to(ROOT)), f"{line}: another file"
    assert not checker.problems, "\n".join(checker.problems)


def only_in_presets():
    """Commands in comments of presets, on recordings that are here, that no page carries out."""
    pages = "".join(page.read_text() for page in CARRIED_OUT)
    return [line for path in sorted((ROOT / "config").rglob("*.yaml")) for line in commented(path)
            if " bags/" in line and f"process {line.split()[2]} " not in pages]


@pytest.mark.slow
@pytest.mark.parametrize("line", only_in_presets())
def test_commands_in_comments_of_presets_do_what_they_say(line, folder):
    """With process for pipeline, which writes the same through nodes."""
    words = line.replace("imu_fusion pipeline", "imu_fusion process").split()[1:]
    result = CliRunner().invoke(cli.cli, words, catch_exceptions=False)
    assert result.exit_code == 0 and f"written: {words[2]}" in result.output, result.output


def test_a_wrong_command_in_a_comment_is_found(tmp_path):
    (tmp_path / "preset.yaml").write_text("# For a bag:\n#   imu_fusion proces BAG OUT\na: 1\n")
    (line,) = commented(tmp_path / "preset.yaml")
    checker = Checker(tmp_path / "preset.yaml", "", tmp_path)
    checker.command(line.split())
    assert "no command 'imu_fusion proces'" in checker.problems[0]


def test_an_old_name_of_a_parameter_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr("test.documents.old_names", lambda: {"mag_sd": "fusion.mag_sd"})
    for text in ("`mag_sd`", "`mag_sd: 0.1`"):
        (problem,) = Checker(ROOT / "README.md", text, tmp_path).run()
        assert "called 'fusion.mag_sd' now" in problem


def python_of(page):
    """The Python blocks of a page, one program after the other: they share their names."""
    return [block for block in blocks(page.read_text()) if block.language == "python"]


@pytest.mark.parametrize("page", [p for p in PAGES if python_of(p) and p not in TUTORIALS], **ids)
def test_python_of_a_page_runs(page, folder):
    names = {}
    for block in python_of(page):
        exec(compile(block.text, f"{page.name}:{block.line}", "exec"), names)


def test_python_that_fails_is_found(folder, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nfrom imu_fusion.samples import NoLog\n```")
    (block,) = python_of(page)
    with pytest.raises(ImportError, match="NoLog"):
        exec(compile(block.text, page.name, "exec"), {})


@pytest.mark.slow
@pytest.mark.parametrize("page", CARRIED_OUT, **ids)
def test_a_page_does_what_it_says(page, folder):
    """README and tutorials: their files, Python and commands, in order, but for commands that start
    nodes."""
    names = {}
    for block in blocks(page.read_text()):
        if block.name:
            (folder / block.name).write_text(block.text)
        elif block.language == "python":
            exec(compile(block.text, f"{page.name}:{block.line}", "exec"), names)
        elif block.language == "bash":
            for program, *words in commands(block.text):
                if program == "imu_fusion" and words[0] not in STARTS_NODES:
                    result = CliRunner().invoke(cli.cli, words, catch_exceptions=False)
                    assert result.exit_code == 0, result.output


# What is generated is what the code says.

def test_generated_pages_are_current():
    written = reference.pages()
    for path, text in written.items():
        assert path.read_text() == text, f"{path.name}: run python -m benchmarks.reference"
    assert {p for p in (ROOT / "docs" / "parameters").iterdir()} <= set(written)


def test_the_table_of_results_is_current_and_the_readme_short():
    text = (ROOT / "README.md").read_text()
    assert readme.fill(text, "results", readme.results()) == text, "run python -m benchmarks.readme"
    assert len(text.encode()) <= 12_000


def test_a_figure_that_no_benchmark_wrote_is_refused():
    with pytest.raises(SystemExit, match="0 rows 'fusion, magic'"):
        str(readme.Figure("orientation_broad", "fusion, magic", "within 3 sigma"))
    with pytest.raises(SystemExit, match="no column 'beauty'"):
        str(readme.Figure("orientation_broad", "fusion, causal | leave one out", "beauty"))


def test_the_picture_of_the_rooms_refuses_a_circle():
    with pytest.raises(ValueError, match="circle: a -> b -> a"):
        architecture.heights({"a": {"b"}, "b": {"a"}})
    assert architecture.reduced({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == {
        "a": {"b"}, "b": {"c"}, "c": set()}


def equations():
    """(numbers, file) of the rows of docs/equations.md."""
    rows = re.findall(r"^\| (\(.*?\)) \|[^|]*\|[^|]*\| `(imu_fusion/[^`]+)` \|$",
                      (ROOT / "docs" / "equations.md").read_text(), re.MULTILINE)
    assert len(rows) > 25
    return [(re.findall(r"\(([AB]?[.\d]+)\)", numbers), file) for numbers, file in rows]


@pytest.mark.parametrize("numbers, file", equations(), ids=str)
def test_an_equation_stands_where_the_page_says(numbers, file):
    """The module names the number: (12), (12)-(14) or eq. 12."""
    text = (ROOT / file).read_text()
    for number in numbers:
        assert re.search(rf"(\(|eqs?\. ){re.escape(number)}\b", text), f"{file}: ({number})"


def test_messages_of_the_troubleshooting_are_ours():
    """What stands between '...' is in a text of the package; placeholders of f-strings are not."""
    spoken = "\n".join(texts(ROOT / "imu_fusion"))
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    tables = re.findall(r"\| message \|[^\n]*\n\|[-|]+\n((?:\|[^\n]*\n)+)", page)
    messages = [code for row in "".join(tables).splitlines()
                for code in re.findall(r"`([^`]+)`", row.split(" | ")[0])]
    assert len(messages) > 20
    for message in messages:
        for part in re.split(r"'?\.\.\.'?", message):
            assert part.strip() in spoken, f"nothing says '{part}' of '{message}'"


def texts(folder):
    """The strings in the sources of a folder; in f-strings, placeholders are line breaks."""
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value
            elif isinstance(node, ast.JoinedStr):
                yield "".join(v.value if isinstance(v, ast.Constant) else "\n" for v in node.values)


# The site.

@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; any warning of MkDocs (a broken link, a page in no menu) is an error."""
    target = tmp_path_factory.mktemp("site")
    result = subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir",
                             str(target)], cwd=ROOT, check=False, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return target


def test_the_site_has_every_page(site):
    for page in PAGES:
        if page.parent != ROOT:
            name = page.relative_to(ROOT / "docs").with_suffix(".html")
            assert (site / name).exists(), name


def test_the_site_loads_nothing_from_elsewhere(site):
    """Scripts, styles, fonts and pictures: all of them are in the folder."""
    loaded = re.compile(r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?(https?:)?//|"
                        r"<link[^>]*\shref=\"?(https?:)?//(?![^>]*canonical)")
    for file in site.rglob("*.html"):
        assert not loaded.search(file.read_text()), file.name
    for file in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import ['\"]?http", file.read_text()), file
