"""Imports point down: files above mathematics, commands on top, and each import where allowed."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import mclass

PACKAGE = Path(mclass.__file__).resolve().parent

MATHEMATICS = (
    ("errors", "records"),
    ("logarithms", "splines"),
    ("geometry", "transforms", "viewpoints"),
    ("camera", "classes"),
    ("footprint", "observation", "model"),
    ("pairs", "table", "results", "checks"),
    ("convolution", "correlation", "orientation", "spectra"),
    ("evidence",),
    ("belief", "looks", "summary"),
    ("drift", "gridmap", "objects"),
    ("association",),
    ("inference",),
    ("cells", "arrays", "joining"),
)
LAYERS = (
    ("allocation", "blockwise", "parallel", "progress"),
    *MATHEMATICS,
    ("places",),
    ("resources", "rules", "findings"),
    ("messages", "config"),
    ("logs",),
    ("outputs", "simulation"),
    ("evaluation",),
    ("text",),
    ("plot", "report", "viewing"),
    ("memory",),
    ("pipeline", "initialise", "inspection"),
    ("batch", "fusion"),
    ("commands",),
    ("__main__",),
)
"""From the ground up. A room may use the rooms of lower layers, not its neighbours'."""

LEVELS = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
NO_FILES = {"io", "os", "pathlib", "logging", "time", "datetime", "click", "tempfile", "shutil"}
HEAVY = {"numpy", "scipy", "mcap", "yaml", "google.protobuf", "matplotlib"}


def room_of(module: str) -> str:
    """``outputs`` of ``mclass.outputs.names``; empty for the package itself."""
    return ([*module.split("."), ""])[1]


def modules() -> dict[str, ast.Module]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = ast.parse(path.read_text("utf-8"))
    return found


MODULES = modules()


def imports(tree: ast.Module) -> Iterator[str]:
    """Every module imported, wherever; but not those that only a type checker sees."""
    skipped = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for statement in node.body
        for inner in ast.walk(statement)
    }
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole path"
            # `from mclass import geometry` imports a module too.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from [name for name in names if name in MODULES] or [str(node.module)]


def test_every_module_has_a_layer() -> None:
    rooms = {room_of(name) for name in MODULES} - {""}
    assert rooms - set(LEVELS) == set(), "new modules: name their layer in LAYERS"
    assert set(LEVELS) - rooms == set(), "these are gone: take them out of LAYERS"


@pytest.mark.parametrize("name", [name for name in MODULES if room_of(name) in LEVELS])
def test_imports_point_down(name: str) -> None:
    room = room_of(name)
    for imported in imports(MODULES[name]):
        used = room_of(imported)
        if imported.startswith("mclass.") and used in LEVELS and used != room:
            assert LEVELS[used] < LEVELS[room], f"{name} imports {imported}: no lower layer"


def test_mcap_is_imported_by_logs_alone() -> None:
    users = {
        name
        for name, tree in MODULES.items()
        if any(imported.split(".")[0] == "mcap" for imported in imports(tree))
    }
    assert users
    assert {room_of(name) for name in users} == {"logs"}


def test_mathematics_opens_no_file() -> None:
    rooms = {room for rooms in MATHEMATICS for room in rooms}
    for name, tree in MODULES.items():
        if room_of(name) not in rooms:
            continue
        forbidden = {imported.split(".")[0] for imported in imports(tree)} & NO_FILES
        assert not forbidden, f"{name} imports {forbidden}"
        called = {
            node.func.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not called & {"open", "print", "input"}, name


COMMAND_HELP = (
    "import mclass",
    *(
        f"from mclass.commands.cli import main; main({arguments!r}, standalone_mode=False)"
        for arguments in (["-h"], ["estimate", "-h"], ["inspect", "cell", "-h"], ["--version"])
    ),
)


@pytest.mark.parametrize("code", COMMAND_HELP)
def test_start_loads_nothing_heavy(code: str) -> None:
    program = f"import sys\n{code}\nprint(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = set(done.stderr.split())
    assert "mclass" in loaded
    assert loaded & HEAVY == set()
