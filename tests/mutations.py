"""Small faults put into Python source: what mutation_run.py asks the tests to notice.

A mutant replaces one expression or statement and leaves every other byte of the file as it is. Annotations, decorators,
f-strings, what only type checkers see and calls of loggers are left alone: no test is meant to notice them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

KINDS = ("comparison", "arithmetic", "boolean", "call", "number")

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult,
}  # fmt: skip
_LOGGERS = ("log", "_log", "logger", "_logger")


@dataclass(frozen=True, slots=True)
class Mutant:
    file: str
    line: int
    column: int
    kind: str
    before: str
    after: str
    start: int
    """Bytes of the file from here to `end` are `before`."""
    end: int

    @property
    def key(self) -> tuple[str, int, int, str, str]:
        return self.file, self.line, self.column, self.before, self.after

    def applied(self, source: bytes) -> bytes:
        assert source[self.start : self.end] == self.before.encode()
        return source[: self.start] + self.after.encode() + source[self.end :]


def mutants_of(file: str, source: bytes) -> list[Mutant]:
    """Return every mutant of a file, in the order of the lines."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node, kind, after in _changes(ast.parse(source)):
        start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        before = source[start:end].decode()
        found.append(Mutant(file, node.lineno, node.col_offset, kind, before, after, start, end))
    return sorted(found, key=lambda m: (m.start, m.end, m.after))


def _changes(node: ast.AST, constants: bool = True) -> Iterator[tuple[ast.expr | ast.stmt, str, str]]:
    """Yield (what is replaced, kind of change, new text) below a node.

    `constants`: numbers count as tuning values here, as they do in a module's and a class's assignments.
    """
    match node:
        case ast.JoinedStr() | ast.arg():
            return
        case ast.If() if "TYPE_CHECKING" in ast.unparse(node.test):
            return
        case ast.FunctionDef() | ast.AsyncFunctionDef():
            for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
                yield from _changes(default, True)
            for statement in node.body:
                yield from _changes(statement, False)
            return
        case ast.ClassDef():
            for statement in node.body:
                yield from _changes(statement, True)
            return
        case ast.AnnAssign():
            if node.value:
                yield from _changes(node.value, constants)
            return
        case ast.Constant() if constants and type(node.value) in (int, float):
            yield node, "number", repr(2 * node.value or 1)
        case ast.Expr(value=ast.Call(func=function) | ast.Await(value=ast.Call(func=function))):
            if not (isinstance(function, ast.Attribute) and ast.unparse(function.value) in _LOGGERS):
                yield node, "call", "pass"
        case ast.expr():
            for changed, kind in _changed(node):
                yield node, kind, f"({ast.unparse(changed)})"
    for child in ast.iter_child_nodes(node):
        compared = isinstance(node, ast.Compare) and isinstance(child, ast.Constant | ast.UnaryOp)
        yield from _changes(child, constants or compared)


def _changed(node: ast.expr) -> Iterator[tuple[ast.expr, str]]:
    """Yield each expression with another operator that an expression may become."""
    match node:
        case ast.Compare():
            for i, operator in enumerate(node.ops):
                ops = [*node.ops[:i], _COMPARISONS[type(operator)](), *node.ops[i + 1 :]]
                yield ast.Compare(node.left, ops, node.comparators), "comparison"
        case ast.BinOp() if type(node.op) in _ARITHMETIC:
            yield ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right), "arithmetic"
        case ast.BoolOp():
            yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values), "boolean"
        case ast.UnaryOp(op=ast.Not()):
            yield node.operand, "boolean"
