"""``python -m lab mutants``: change the product in one place at a time, and see whether a test fails."""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from drocap_ros.cli.options import Subparsers, add_command, add_seed_option
from lab.flights.branches import over_processes

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("flight", "recording", "ros")
#: What takes its place, by the operator.
_OPERATORS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
#: Not judged: words, types, and what only tells people.
_WORDS = (ast.JoinedStr, ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.ClassDef)


class Mutant(NamedTuple):
    """A change of one line of a module."""

    path: str
    line: int
    before: str
    after: str
    source: str


def _changed(node: ast.AST) -> ast.AST | None:
    """The node with another meaning; None = it is not changed."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.Compare) and len(new.ops) == 1 and type(new.ops[0]) in _OPERATORS:
        new.ops = [_OPERATORS[type(new.ops[0])]()]
    elif isinstance(new, ast.BoolOp | ast.BinOp) and type(new.op) in _OPERATORS:
        new.op = _OPERATORS[type(new.op)]()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.Not | ast.USub):
        return new.operand
    elif isinstance(new, ast.Call) and isinstance(new.func, ast.Name) and new.func.id in _CALLS:
        new.func.id = _CALLS[new.func.id]
    elif isinstance(new, ast.Constant) and isinstance(new.value, bool):
        new.value = not new.value
    elif isinstance(new, ast.Constant) and isinstance(new.value, int | float):
        new.value = 2 * new.value + 1
    elif isinstance(new, ast.IfExp):
        new.body, new.orelse = new.orelse, new.body
    else:
        return None
    return new


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes whose change is judged."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield from (n for part in child.body if isinstance(part, ast.FunctionDef) for n in _nodes(part))
        elif isinstance(child, ast.FunctionDef):
            yield from (n for part in child.body for n in _nodes(ast.Module([part], [])))
        elif not isinstance(child, (*_WORDS, ast.AnnAssign)):
            yield child
            yield from _nodes(child)


def mutants(path: str, source: str) -> list[Mutant]:
    """Every mutant of a module that is changed within one line; the other lines stay as they are."""
    found, lines = [], source.splitlines(keepends=True)
    for node in _nodes(ast.parse(source)):
        new = _changed(node)
        if new is None or not isinstance(node, ast.expr) or node.lineno != node.end_lineno:
            continue
        line = lines[node.lineno - 1].encode()
        text = line[: node.col_offset] + f"({ast.unparse(new)})".encode() + line[node.end_col_offset :]
        after = text.decode()
        whole = "".join([*lines[: node.lineno - 1], after, *lines[node.lineno :]])
        found.append(Mutant(path, node.lineno, lines[node.lineno - 1].strip(), after.strip(), whole))
    return found


def draw(rooms: list[str], number: int, seed: int) -> list[Mutant]:
    """So many mutants at random, of different lines, from all places alike."""
    every = [
        mutant for room in rooms for path in sorted((ROOT / "drocap_ros" / room).rglob("*.py"))
        for mutant in mutants(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8"))
    ]  # fmt: skip
    random.Random(seed).shuffle(every)
    chosen = {(mutant.path, mutant.line): mutant for mutant in reversed(every[: 2 * number])}
    return list(chosen.values())[-number:]


def judges_of(path: str) -> list[list[str]]:
    """Test files of a module, those that fail soonest first: what imports it, its folder, its room, flights, nodes."""
    name = ".".join(Path(path).with_suffix("").parts).removesuffix(".__init__")
    room, own = Path(path).parts[1], str(Path("test", *Path(path).parts[1:-1]))
    files = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in ROOT.glob("test/**/test_*.py")}
    near = {file for file, text in files.items() if name in text or Path(path).stem in Path(file).stem}
    more = {"flight": "test/lab/flights/", "ros": "test/nodes/"}.get(room, f"{own}/")
    groups: list[list[str]] = []
    tops = (near, f"test/{room}/"), (near, ""), (files, f"{own}/"), (files, f"test/{room}/"), (files, more)
    for judges, top in tops:
        groups.append(sorted(file for file in judges if file.startswith(top) and not any(file in g for g in groups)))
    return groups


def survives(mutant: Mutant, seconds: float) -> str:
    """Why a mutant is alive, in words; "" = a test has failed, or did not end in time."""
    with tempfile.TemporaryDirectory() as folder:
        top = Path(folder)
        for name in ("drocap_ros", "lab", "test", "config", "docs", "msg", "srv", "launch", "benchmarks"):
            shutil.copytree(ROOT / name, top / name, ignore=shutil.ignore_patterns("__pycache__"))
        for file in (*ROOT.glob("*.toml"), *ROOT.glob("*.xml"), *ROOT.glob("*.md"), ROOT / "setup.py"):
            shutil.copy(file, top)
        (top / mutant.path).write_text(mutant.source, encoding="utf-8")
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": folder}
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-rs", "-p", "no:cacheprovider", "--timeout", "300"]
        for files in judges_of(mutant.path):
            if not files:
                continue
            try:
                ended = subprocess.run(
                    [*command, *files], cwd=folder, env=environment, timeout=seconds, capture_output=True, check=False
                )
            except subprocess.TimeoutExpired:
                return f"alive after {seconds:g} s of tests"
            if ended.returncode:
                return ""
            if b"too slow here" in ended.stdout:  # a test of a clock has failed, and other programs were busy
                return "undecided, the machine is busy"
    return "alive"


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers, "mutants", run, help="change the product in places at random; a test must fail at each",
        description="Change one place of the product at a time, in a copy, and run the tests of its module and room. "
        "Exit status 1 where fewer than four of five are found.",
    )  # fmt: skip
    parser.add_argument("--draws", type=int, default=40, help="places (default 40)")
    parser.add_argument("--rooms", nargs="+", default=list(ROOMS), help=f"default {' '.join(ROOMS)}")
    parser.add_argument("--seconds", type=float, default=600.0, help="longest run of tests (default 600)")
    parser.add_argument("--processes", type=int, default=1, help="that run tests (default 1)")
    add_seed_option(parser, "seed of the places")


def run(args: argparse.Namespace) -> int:
    """Try the mutants, and print those that live."""
    chosen = draw(args.rooms, args.draws, args.seed)
    killed = 0
    fates = over_processes(partial(survives, seconds=args.seconds), chosen, args.processes)
    for mutant, alive in zip(chosen, fates, strict=True):
        killed += not alive
        print(f"{alive or 'killed'}: {mutant.path}:{mutant.line}: {mutant.after}", flush=True)
    print(f"{killed} of {len(chosen)} were killed")
    return int(killed < 0.8 * len(chosen))
