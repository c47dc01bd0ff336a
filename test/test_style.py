"""What no linter checks: types of what is public, functions that one can take in at a glance."""

import ast
from pathlib import Path

import pytest

import imu_fusion

PACKAGE = Path(imu_fusion.__file__).parent
LONGEST = 60
FILES = sorted(PACKAGE.rglob("*.py"))


def functions(node, names=()):
    """(dotted name, function) of all functions of a module or class, not of nested ones."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield ".".join((*names, child.name)), child
        elif isinstance(child, ast.ClassDef):
            yield from functions(child, (*names, child.name))


def is_kernel(function):
    """numba finds the types by itself."""
    return any(isinstance(d, ast.Name) and d.id == "njit" for d in function.decorator_list)


def untyped(source):
    """Names of public functions that lack the type of an argument or of the result."""
    found = []
    for name, function in functions(ast.parse(source)):
        last = name.rpartition(".")[2]
        private = any(part.startswith("_") for part in name.split(".")[:-1])
        if is_kernel(function) or private or (last.startswith("_") and last != "__init__"):
            continue
        arguments = function.args
        every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
        missing = [a.arg for a in every if a.annotation is None and a.arg not in ("self", "cls")]
        if missing or (function.returns is None and last != "__init__"):
            found.append(f"{name}({', '.join(missing)})")
    return found


def too_long(source):
    """Functions over LONGEST lines without a reason, ``# long: ...``, in the line above."""
    lines = source.splitlines()
    return [name for name, function in functions(ast.parse(source))
            if function.end_lineno - function.lineno >= LONGEST
            and "# long: " not in lines[min(
                [function.lineno, *(d.lineno for d in function.decorator_list)]) - 2]]


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_public_functions_say_their_types(file):
    assert not untyped(file.read_text())


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_functions_are_short(file):
    assert not too_long(file.read_text())


def test_the_checks_find_what_they_look_for():
    assert untyped("def f(a, b: int) -> int: ...\nclass A:\n    def g(self): ...") == [
        "f(a)", "A.g()"]
    assert not untyped("def _f(a): ...\n@njit\ndef g(a): ...\ndef h(*a) -> None: ...")
    body = "    x = 1\n" * LONGEST
    assert too_long(f"def f():\n{body}") == ["f"]
    assert not too_long(f"# long: a table\n@cache\ndef f():\n{body}")


def loose_records(source):
    """Kernels that keep one record in an array of their own: numba frees the array after its last
    use, though the record is still in use. It comes from the caller, or is part of a state."""
    found = []
    for name, function in functions(ast.parse(source)):
        for node in ast.walk(function) if is_kernel(function) else ():
            made = node.value if isinstance(node, ast.Assign) else None
            if (isinstance(made, ast.Call) and isinstance(made.func, ast.Attribute)
                    and made.func.attr in ("zeros", "empty") and len(made.args) == 2
                    and ast.unparse(made.args[0]) in ("1", "(1,)")):
                found.append(f"{name}: {ast.unparse(made)}")
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_no_kernel_makes_records_of_its_own(file):
    assert not loose_records(file.read_text())


def test_loose_records_are_found():
    assert loose_records("@njit\ndef f():\n    rows = np.empty(1, es.ROW)\n    r = rows[0]") == [
        "f: np.empty(1, es.ROW)"]
    assert not loose_records("@njit\ndef f(n):\n    return np.empty(1, ROW), np.zeros(n, ROW)")
    assert not loose_records("def f():\n    rows = np.empty(1, ROW)")
