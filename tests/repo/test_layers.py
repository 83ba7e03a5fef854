"""Which part may import what. The table is the architecture; the tests read every import, type-checking ones too."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class Layer:
    """What one part may import: other parts of crkr, third-party packages."""

    parts: frozenset[str]
    packages: frozenset[str]


def _layer(parts: str, packages: str) -> Layer:
    return Layer(frozenset(parts.split()), frozenset(packages.split()))


LAYERS = {
    "protocol": _layer("", "numpy msgpack typing_extensions"),
    "learner": _layer("protocol", "numpy scipy numba"),
    "client": _layer("protocol", "numpy zenoh typer rich pyarrow onnx tomli async_timeout"),
    "server": _layer("protocol learner", "numpy zenoh typer rich prometheus_client psycopg"),
    "sim_worker": _layer(
        "protocol client",
        "numpy scipy mujoco gymnasium gymnasium_robotics ray pinocchio coal clarabel matplotlib PIL av typer rich",
    ),
    "dashboard": _layer("protocol client", "numpy rerun starlette typer rich uvicorn"),
    "experiments": _layer(
        "protocol learner client sim_worker",
        "numpy scipy matplotlib joblib sklearn zenoh typer rich gymnasium fancy_gym ray"
        " botorch gpytorch nevergrad optuna ribs stable_baselines3 torch",
    ),
}
# The mirror is a learner that lives in the client: that one module may know the mathematics.
MIRROR = re.compile(r"client/crkr/client/mirror(\.py|/.*\.py)")
# The mathematics does no I/O, starts no threads and reads no clock.
IMPURE = frozenset({"asyncio", "concurrent", "io", "multiprocessing", "os", "pathlib", "queue", "random"}) | frozenset(
    {"socket", "sqlite3", "subprocess", "threading", "time"}
)
# Unpickling runs whatever it is sent.
UNSAFE = frozenset({"marshal", "pickle", "shelve"})
# Bindings without type information are wrapped, each in one module.
WRAPPED = ("clarabel", "coal", "pyarrow")


def imported_modules(source: str, package: str) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything a module of `package` imports, by any of Python's ways with a literal name."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.lineno, name) for name in _from_targets(node, package))
        elif isinstance(node, ast.Call) and _is_dynamic_import(node.func) and node.args:
            argument = node.args[0]
            if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                yield node.lineno, argument.value


def _from_targets(node: ast.ImportFrom, package: str) -> list[str]:
    stem = _from_stem(node, package)
    # `from crkr import server` names the part in the list, not in the stem.
    return [f"{stem}.{alias.name}" for alias in node.names] if stem == "crkr" else [stem]


def _from_stem(node: ast.ImportFrom, package: str) -> str:
    base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
    return ".".join([*base, *([node.module] if node.module else [])])


def _is_dynamic_import(function: ast.expr) -> bool:
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name in {"import_module", "__import__"}


def violations(source: str, path: str) -> list[str]:
    """What a file under a root imports although its layer forbids it; `path` is relative to the repository."""
    root, *inner, _ = path.split("/")
    layer = LAYERS[root]
    parts = layer.parts | {root} | ({"learner"} if MIRROR.fullmatch(path) else set())
    found = []
    for line, name in imported_modules(source, ".".join(inner)):
        top, _, rest = name.partition(".")
        if top == "crkr":
            crossed = rest.split(".")[0] not in parts
        elif top in sys.stdlib_module_names:
            crossed = top in UNSAFE or (root == "learner" and top in IMPURE)
        else:
            crossed = top not in layer.packages
        if crossed:
            found.append(f"{path}:{line}: {root} may not import {name}")
    return found


def sources(root: str) -> list[Path]:
    return sorted((REPOSITORY / root).rglob("*.py"))


def module_name(path: str) -> str:
    """Dotted name of a file under a root; `path` is relative to the repository."""
    parts = path.removesuffix(".py").split("/")[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def import_graph(files: dict[str, str]) -> dict[str, set[str]]:
    """Which module imports which, imports within functions and for types included. Args: files: path to source."""
    names = {module_name(path) for path in files}
    graph = {}
    for path, source in files.items():
        name = module_name(path)
        package = name if path.endswith("__init__.py") else name.rpartition(".")[0]
        graph[name] = set(_modules_imported(source, package, names)) - {name}
    return graph


def _modules_imported(source: str, package: str, names: set[str]) -> Iterator[str]:
    """Those of `names` that a module imports; `from . import store` is the module `store`, where there is one."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom):
            stem = _from_stem(node, package)
            targets = (f"{stem}.{alias.name}" for alias in node.names)
            yield from (target if target in names else stem for target in targets if {target, stem} & names)


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that reach each other by imports, each group in order."""
    reached = {name: _reachable(graph, name) for name in graph}
    groups = {frozenset({name, *(other for other in reached[name] if name in reached[other])}) for name in graph}
    return sorted(sorted(group) for group in groups if len(group) > 1)


def _reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = graph[waiting.pop()] - found
        found |= new
        waiting += new
    return found


@pytest.mark.parametrize("root", LAYERS)
def test_no_module_crosses_its_layer(root: str) -> None:
    found = [
        line for path in sources(root) for line in violations(path.read_text(), path.relative_to(REPOSITORY).as_posix())
    ]
    assert not found, "\n".join(found)


def test_modules_do_not_import_each_other_in_circles() -> None:
    files = {path.relative_to(REPOSITORY).as_posix(): path.read_text() for root in LAYERS for path in sources(root)}
    assert cycles(import_graph(files)) == []


def test_a_circle_of_imports_is_found() -> None:
    files = {
        "client/crkr/client/a.py": "from .b import B",
        "client/crkr/client/b.py": "if TYPE_CHECKING:\n    from crkr.client import c",
        "client/crkr/client/c.py": "def f() -> None:\n    import crkr.client.a",
        "client/crkr/client/d.py": "from .a import A",
        "client/crkr/client/__init__.py": "from .d import D",
    }
    assert cycles(import_graph(files)) == [["crkr.client.a", "crkr.client.b", "crkr.client.c"]]


@pytest.mark.parametrize("package", WRAPPED)
def test_an_untyped_binding_is_imported_in_one_module_of_a_part(package: str) -> None:
    for root in LAYERS:
        users = [
            path.relative_to(REPOSITORY).as_posix()
            for path in sources(root)
            if any(name.split(".")[0] == package for _, name in imported_modules(path.read_text(), ""))
        ]
        assert len(users) <= 1, f"{package} is imported in {', '.join(users)}"


def test_the_client_imports_zenoh_in_one_folder() -> None:
    allowed = [REPOSITORY / "client/crkr/client" / folder for folder in ("network", "bench")]
    users = [
        path.relative_to(REPOSITORY).as_posix()
        for path in sources("client")
        if not any(path.is_relative_to(folder) for folder in allowed)
        and any(name.split(".")[0] == "zenoh" for _, name in imported_modules(path.read_text(), ""))
    ]
    assert users == []


@pytest.mark.parametrize("root", LAYERS)
def test_no_modules_import_each_other_in_a_circle(root: str) -> None:
    """Imports in functions and for type checking count too."""
    paths = {
        ".".join(path.relative_to(REPOSITORY / root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sources(root)
    }
    remaining = {
        module: {name for _, name in imported_modules(path.read_text(), module)} & paths.keys()
        for module, path in paths.items()
    }
    while free := {module for module, needed in remaining.items() if not needed}:
        remaining = {module: needed - free for module, needed in remaining.items() if module not in free}
    assert not remaining


def test_the_table_names_the_roots_that_are_installed() -> None:
    build = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert set(build["dev-mode-dirs"]) == set(LAYERS)
    assert set(build["targets"]["wheel"]["sources"]) == set(LAYERS)
    assert set(build["targets"]["wheel"]["only-include"]) == {f"{root}/crkr" for root in LAYERS}


def test_the_table_has_no_cycle() -> None:
    remaining = {root: set(layer.parts) for root, layer in LAYERS.items()}
    remaining["client"].add("learner")
    while free := {root for root, needed in remaining.items() if not needed}:
        remaining = {root: needed - free for root, needed in remaining.items() if root not in free}
    assert not remaining


@pytest.mark.parametrize(
    ("path", "statement"),
    [
        ("server/crkr/server/a.py", "from crkr.client import Client"),
        ("client/crkr/client/a.py", "import crkr.server.store"),
        ("client/crkr/client/a.py", "from crkr.learner import Learner"),
        ("client/crkr/client/a.py", "from crkr import learner"),
        ("client/crkr/client/a.py", "import scipy.linalg"),
        ("client/crkr/client/a.py", "def f() -> None:\n    import mujoco"),
        ("protocol/crkr/protocol/a.py", "if TYPE_CHECKING:\n    from crkr.learner import Learner"),
        ("protocol/crkr/protocol/a.py", "from ..learner import Learner"),
        ("learner/crkr/learner/deep/a.py", "from ...server.store import Trial"),
        ("dashboard/crkr/dashboard/a.py", "importlib.import_module('crkr.sim_worker')"),
        ("learner/crkr/learner/a.py", "import threading"),
        ("server/crkr/server/a.py", "import pickle"),
    ],
)
def test_a_crossed_layer_is_found(path: str, statement: str) -> None:
    assert len(violations(statement, path)) == 1


@pytest.mark.parametrize(
    ("path", "statement"),
    [
        ("server/crkr/server/a.py", "from crkr.learner import Learner"),
        ("server/crkr/server/a.py", "from . import store"),
        ("server/crkr/server/deep/a.py", "from ..store import Store"),
        ("client/crkr/client/mirror.py", "from crkr.learner import Model"),
        ("client/crkr/client/mirror/view.py", "from crkr.learner import Model"),
        ("protocol/crkr/protocol/a.py", "import threading, numpy.typing as npt"),
    ],
)
def test_an_allowed_import_is_let_pass(path: str, statement: str) -> None:
    assert violations(statement, path) == []
