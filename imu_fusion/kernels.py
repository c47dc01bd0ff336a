"""The one ``njit`` of the package, whose cache knows the source of everything it compiled.

numba's own cache looks at the file of the outermost function alone: code that it calls, and
constants that were built in, could change without being compiled again. Here the compiled code of
a function lies under a digest of its file and of every file of this package that it imports, and
so on down; another source, numba, Python or processor is another place. ``git pull`` is safe.

The cache is the first of these that can be written: NUMBA_CACHE_DIR, ``__pycache__/kernels`` of
the package, ``imu_fusion`` in the user's cache directory. If none can, kernels are compiled anew
in each process.
"""

import hashlib
import os
import pickle
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path

import numba
import numpy as np
from numba.core import compiler, event, serialize
from numba.core.caching import _Cache
from numba.core.registry import cpu_target

NOTICE = "compiling for this machine: one to four minutes, once after an installation"

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(rb"^[ \t]*(?:from[ \t]+(imu_fusion[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)"
                     rb"|import[ \t]+(imu_fusion[\w.]*))", re.MULTILINE)
_COMMENT = re.compile(rb"#[^\n]*")
_INTERPRETED = bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]
_KEPT = 30 * 86400.0       # s, that compiled code of another source is kept without being written


def njit(function: Callable) -> Callable:
    """Compile a function with numba, strict floating point, cached as this module says.

    With NUMBA_DISABLE_JIT it is interpreted, for debuggers and for coverage.
    """
    if _INTERPRETED:
        return _interpreted(function)
    dispatcher = numba.njit(fastmath=False)(function)
    directory = _directory(Path(function.__code__.co_filename))
    if directory is not None:
        dispatcher._cache = _KernelCache(function, directory)  # type: ignore[attr-defined]
    return dispatcher


def _interpreted(function: Callable) -> Callable:
    """The function in plain Python, where fields of records are attributes, as in numba."""
    names = function.__globals__
    names |= {name: np.dtype((_Record, value)) for name, value in names.items()
              if isinstance(value, np.dtype) and value.names}

    @wraps(function)
    def call(*arguments):
        return function(*(a.view(np.dtype((_Record, a.dtype)))
                          if isinstance(a, np.ndarray | np.void) and a.dtype.names else a
                          for a in arguments))
    return call


class _Record(np.void):     # type: ignore[misc]
    """An element of a structured array. numpy's own would give its methods (max, cov) first."""

    def __getattribute__(self, name):
        dtype = super().__getattribute__("dtype")
        if name not in (dtype.names or ()):
            return super().__getattribute__(name)
        value, kind = self[name], dtype[name].base
        return value.view(np.dtype((_Record, kind))) if kind.names else value

    def __setattr__(self, name, value):
        self[name] = value


def entry_point(kernel: Callable, *arguments: object) -> Callable:
    """The compiled function itself, for arguments of the types of these.

    A call of a kernel looks its arguments' types up, which costs 3 us where some are structured
    arrays; a call of what this returns does not. It takes arguments of just these types.
    """
    if _INTERPRETED:
        return kernel
    return kernel.compile(  # type: ignore[attr-defined]
        tuple(numba.typeof(argument) for argument in arguments))


@contextmanager
def announced_compiling(say: Callable[[str], object]) -> Iterator[None]:
    """Within, the first kernel that has to be compiled calls ``say`` with one line of text; kernels
    from the cache do not."""
    with event.install_listener("numba:compile", _Listener(lambda: say(NOTICE))):
        yield


class _Listener(event.Listener):
    """Calls ``first`` once, at the first compilation."""

    def __init__(self, first):
        self._first = first

    def on_start(self, event):
        first, self._first = self._first, None
        if first is not None:
            first()

    def on_end(self, event):
        pass


class _Nesting(event.Listener):
    """How many compilations, one within the other, are going on in this process."""

    depth = 0

    def on_start(self, event):
        self.depth += 1

    def on_end(self, event):
        self.depth -= 1


_nesting = _Nesting()
event.register("numba:compile", _nesting)


def is_compiling() -> bool:
    """Whether numba is at work: a handler of signals that waits for its end would seem deaf."""
    return _nesting.depth > 0


class _KernelCache(_Cache):
    """One file per function and signature, written whole or not at all.

    Interrupted or concurrent processes cannot mix up files: the name is made from all that the
    content depends on.
    """

    def __init__(self, function, directory):
        self._directory = directory
        self._name = f"{function.__qualname__}-{function.__code__.co_firstlineno}"

    @property
    def cache_path(self):
        return str(self._directory)

    def enable(self):
        """Always on."""

    disable = flush = enable

    def load_overload(self, sig, target_context):
        """The compiled function, or None if it is not there or not readable."""
        target_context.refresh()
        path = self._path(sig, target_context.codegen())
        try:
            content = path.read_bytes()
        except OSError:
            return None
        digest, data = content[:32], content[32:]
        if hashlib.sha256(data).digest() != digest:    # cut by a full disk or a power failure
            return None
        return compiler.CompileResult._rebuild(target_context, *pickle.loads(data))

    def save_overload(self, sig, data):
        """Keep a compiled function, unless there is no room for it."""
        if data.lifted or data.library.has_dynamic_globals:
            raise RuntimeError(f"kernel {self._name} cannot be cached: it holds addresses")
        content = serialize.dumps(data._reduce())
        path = self._path(sig, data.codegen)
        try:
            if not self._directory.exists():
                self._directory.mkdir(parents=True, exist_ok=True)
                _drop_old(self._directory)
            with tempfile.NamedTemporaryFile(dir=self._directory, delete=False) as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(file.name, path)
        except OSError:
            pass    # it runs all the same, and is compiled again next time

    def _path(self, sig, codegen):
        key = repr((self._name, sig, codegen.magic_tuple()))
        return self._directory / f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.nbc"


def _directory(file: Path) -> Path | None:
    """Where the compiled functions of a file are, None if nowhere."""
    if not (file.exists() and file.is_relative_to(_PACKAGE)):
        return None    # typed in, or somebody else's
    return cache_file(f"{file.stem}-{_version_of(file)[:24]}")


@cache
def _version_of(file: Path) -> str:
    """A digest of all that the machine code of a file's kernels depends on."""
    sources = b"".join(str(f.relative_to(_PACKAGE.parent)).encode() + _digest(f)
                       for f in sorted(sources_of(file)))
    return hashlib.sha256(versions().encode() + sources).hexdigest()


def versions() -> str:
    """What compiled code depends on beside sources and processor."""
    return f"{numba.__version__} {sys.version} "


def processor() -> str:
    """The processor that numba compiles for."""
    return repr(cpu_target.target_context.codegen().magic_tuple())


def cache_file(name: str) -> Path | None:
    """A path in the cache, None where there is none."""
    root = _root(os.environ.get("NUMBA_CACHE_DIR"))
    return None if root is None else root / name


@cache
def _root(given: str | None) -> Path | None:
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    for root in ([Path(given, "imu_fusion")] if given else []) + [
            _PACKAGE / "__pycache__" / "kernels", Path(home, "imu_fusion", "kernels")]:
        try:
            root.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=root).close()
            return root
        except OSError:
            continue
    return None


def _drop_old(directory: Path) -> None:
    """Remove what other versions of the same file left long ago."""
    for other in directory.parent.glob(f"{directory.name.rpartition('-')[0]}-*"):
        if re.fullmatch(r"\w+-[0-9a-f]{24}", other.name) and other != directory:
            try:
                if time.time() - other.stat().st_mtime > _KEPT:
                    shutil.rmtree(other, ignore_errors=True)
            except OSError:
                continue


def sources_of(file: Path) -> set[Path]:
    """The files that the machine code of a file's kernels can depend on: itself and what it
    imports from this package, and so on down."""
    found: set[Path] = set()
    waiting = [file]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting.extend(_imports(file))
    return found


@cache
def _imports(file: Path) -> tuple[Path, ...]:
    source = _COMMENT.sub(b"", _read(file))
    modules = set()
    for package, names, module in _IMPORT.findall(source):
        base = (package or module).decode()
        modules.add(base)
        for name in re.findall(rb"(\w+)(?:\s+as\s+\w+)?\s*(?:,|\)|$)", names.strip()):
            modules.add(f"{base}.{name.decode()}")
    root = _PACKAGE.parent
    places = [root.joinpath(*module.split(".")) for module in modules]
    files = [place.with_suffix(".py") for place in places] + [p / "__init__.py" for p in places]
    return tuple(f for f in files if f.is_file() and f != Path(__file__))


@cache
def _read(file: Path) -> bytes:
    return file.read_bytes()


@cache
def _digest(file: Path) -> bytes:
    return hashlib.sha256(_read(file)).digest()
