"""What nodes are made of reads no clock, no file and no chance, and rooms import one way only."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

import vibrissa

ROOT = Path(vibrissa.__file__).parent

MAY_IMPORT = {
    "messages": set(),
    "control": {"messages"},
    "slam": {"messages"},
    "rig": {"messages", "control"},
    "processes": {"messages", "control", "slam", "rig"},
    "tools": {"messages", "control", "slam", "rig", "processes"},
}
"""design: who may import whom; everybody may import the numerics below all rooms."""
BELOW = {"numerics", "compilation", "elementary", "philox"}
NODES = [f"processes/{name}.py" for name in ("rig", "sampler", "whisk", "arm", "slam")]

IMPURE = {"time", "datetime", "random", "secrets", "uuid", "os", "io", "tempfile", "shutil"}
IMPURE |= {"threading", "_thread", "multiprocessing", "concurrent", "asyncio", "subprocess"}
IMPURE |= {"socket", "select", "selectors", "signal", "urllib", "http", "zmq", "serial", "can"}
IMPURE |= {"logging", "locale", "platform", "getpass", "sqlite3", "ctypes"}
OUTSIDE_STEPS = {"rig/maze.py", "slam/config.py"}
OUTSIDE_STEPS |= {"processes/config.py", "processes/table.py", "processes/controllers.py"}
"""Read files or look up names when an experiment or a controller is made, never in a step."""
ELEMENTARY = {"sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp"}
ELEMENTARY |= {"arcsin", "arccos", "arctan", "arctan2", "exp2", "expm1", "log", "log2", "log10"}
ELEMENTARY |= {"log1p", "pow", "power", "hypot", "cbrt"}
ALGEBRA = {"dot", "vdot", "inner", "matmul", "einsum", "tensordot", "linalg", "fft"}
SCORES = {"slam/metrics.py": {"hypot", "sin", "cos"}}
"""Scores, and the export of trajectories: nothing a node decides by depends on them."""

ORDERS = {"slam/graph_solver.py"}
"""Ask SuperLU in which order to eliminate: integers that follow from the matrix's pattern alone."""


def files(*rooms: str) -> list[str]:
    found = [f for room in rooms for f in (ROOT / room).resolve().rglob("*.py")]
    top = (ROOT / "messages").resolve().parent
    return sorted(f.relative_to(top).as_posix() for f in found)


@functools.cache
def tree(file: str) -> ast.Module:
    room, _, rest = file.partition("/")
    return ast.parse((ROOT / room / rest).read_text(), file)


def imports(file: str) -> Iterator[tuple[str, int]]:
    """(dotted name, line) of everything a file imports, names from packages spelled out."""
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.lineno


def of_ours(file: str) -> Iterator[tuple[str, str, int]]:
    """(room, file or "", line) of what a file imports of this project."""
    for name, line in imports(file):
        parts = name.split(".")
        if parts[0] != "vibrissa":
            continue
        room = parts[1] if len(parts) > 1 else ""
        path = ROOT.joinpath(*parts[1:3]).with_suffix(".py")
        yield room, f"{room}/{parts[2]}.py" if len(parts) > 2 and path.is_file() else "", line


@functools.cache
def reached() -> list[str]:
    """Node files and every file of ours that they import, directly or through others."""
    waiting, found = list(NODES), set(NODES)
    while waiting:
        for room, path, _ in of_ours(waiting.pop()):
            if path and path not in found and room in ("control", "slam", "rig", "processes"):
                found.add(path)
                if path not in ("processes/config.py", "processes/table.py"):
                    waiting.append(path)
    return sorted(found - OUTSIDE_STEPS)


def mechanics() -> list[str]:
    """The rig without its drivers."""
    return [f for f in files("rig") if f.count("/") == 1]


PURE = sorted({*reached(), *files("control", "slam"), *mechanics()} - OUTSIDE_STEPS)


def test_the_lint_sees_the_files_it_is_about() -> None:
    for expected in ("control/rcp.py", "slam/ratslam.py", "rig/plant.py", "processes/whisk.py"):
        assert expected in reached() and expected in PURE
    assert len(PURE) > 25


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_imports_between_rooms_point_one_way(room: str) -> None:
    for file in files(room):
        for other, _, line in of_ours(file):
            allowed = MAY_IMPORT[room] | BELOW | {room, "", "__version__"}
            assert other in allowed, f"{file}:{line}: {room} imports {other}"


def test_the_rig_takes_only_kinematics_from_control() -> None:
    for file in files("rig"):
        for room, path, line in of_ours(file):
            assert room != "control" or path == "control/kinematics.py", f"{file}:{line}: {path}"


def test_nothing_below_the_rooms_imports_a_room() -> None:
    for name in BELOW:
        for node in ast.walk(ast.parse((ROOT / f"{name}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vibrissa"):
                assert (node.module or "").split(".")[1] in BELOW


@pytest.mark.parametrize("file", PURE)
def test_what_nodes_are_made_of_imports_nothing_that_knows_the_outside(file: str) -> None:
    for name, line in imports(file):
        assert name.split(".")[0] not in IMPURE, f"{file}:{line}: imports {name}"


@pytest.mark.parametrize("file", PURE)
def test_what_nodes_are_made_of_draws_no_global_numbers_and_does_no_input_or_output(
    file: str,
) -> None:
    for node in ast.walk(tree(file)):
        where = f"{file}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Attribute):
            assert node.attr not in ("random", "default_rng", "RandomState"), where
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            banned = ("open", "print", "input", "exec", "eval", "hash", "id")
            assert node.func.id not in banned, f"{where}: {node.func.id}()"


@pytest.mark.parametrize("file", PURE)
def test_what_nodes_are_made_of_never_walks_through_a_set(file: str) -> None:
    for node in ast.walk(tree(file)):
        for walked in _walked_through(node):
            unordered = isinstance(walked, ast.Set | ast.SetComp) or (
                isinstance(walked, ast.Call)
                and isinstance(walked.func, ast.Name)
                and walked.func.id in ("set", "frozenset", "vars", "dir", "globals")
            )
            assert not unordered, f"{file}:{walked.lineno}: order of a set"


def _walked_through(node: ast.AST) -> Iterator[ast.expr]:
    if isinstance(node, ast.For | ast.comprehension):
        yield node.iter
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id in ("list", "tuple", "enumerate", "zip", "map", "iter", "next", "sum"):
            yield from node.args
    elif isinstance(node, ast.Starred):
        yield node.value


@pytest.mark.parametrize("file", reached())
def test_steps_use_elementary_functions_of_the_project_and_no_linear_algebra_library(
    file: str,
) -> None:
    for node in ast.walk(tree(file)):
        where = f"{file}:{getattr(node, 'lineno', 0)}"
        assert not isinstance(node, ast.MatMult), f"{where}: BLAS"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            library, name = node.value.id, node.attr
            assert library != "found" or file not in ORDERS or name == "perm_c", where
            if library in ("np", "numpy", "math", "scipy"):
                allowed = SCORES.get(file, set())
                assert name not in ELEMENTARY - allowed, f"{where}: {library}.{name}"
                assert name not in ALGEBRA, f"{where}: {library}.{name}"
    for name, line in imports(file):
        orders = file in ORDERS and name in ("scipy.sparse", "scipy.sparse.linalg")
        assert name.split(".")[0] != "scipy" or orders, f"{file}:{line}: {name}"
        assert name.split(".")[0] != "math" or name.split(".")[-1] not in ELEMENTARY, (
            f"{file}:{line}"
        )


@pytest.mark.parametrize("file", [f for f in reached() if not f.startswith("processes/")])
def test_kernels_are_compiled_by_the_project_and_never_with_fast_maths(file: str) -> None:
    for name, line in imports(file):
        assert name.split(".")[0] != "numba", f"{file}:{line}: use vibrissa.numerics.compiled"
    for node in ast.walk(tree(file)):
        assert not (isinstance(node, ast.keyword) and node.arg in ("fastmath", "parallel"))
