# SPDX-License-Identifier: MIT
"""Mutants of a module: single changes of its source text, found in its syntax tree.

Text is replaced at the positions given by the tree, so everything else, line numbers included, is unchanged.
Messages, annotations and imports are not mutated.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type, tuple[str, ...]] = {
    ast.Lt: ("<", ">=", "<="),
    ast.LtE: ("<=", ">", "<"),
    ast.Gt: (">", "<=", ">="),
    ast.GtE: (">=", "<", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
"""Symbol of each comparison, followed by its replacements."""
ARITHMETIC: dict[type, tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "+"),
    ast.Pow: ("**", "*"),
    ast.LShift: ("<<", ">>"),
    ast.RShift: (">>", "<<"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.BitXor: ("^", "&"),
}
SWAPS = {
    "min": "max",
    "amin": "amax",
    "minimum": "maximum",
    "argmin": "argmax",
    "any": "all",
    "floor": "ceil",
    "sum": "mean",
    "cos": "sin",
    "bit_length": "bit_count",
}
SWAPS |= {new: old for old, new in SWAPS.items() if new != "bit_count"}
UNWRAPPED = ("clip", "sqrt", "abs", "square", "normalize", "detach", "log", "exp", "sorted")
"""Functions whose calls a mutant replaces by their first argument."""
UNCHAINED = ("clamp_min", "clamp_max", "sqrt", "cumsum")
"""Methods whose calls a mutant removes: ``x.sqrt()`` becomes ``x``."""
WORDS = ("Problem", "input_error", "InputError", "ValueError", "RuntimeError", "print", "filterwarnings")
"""Functions whose arguments only form messages."""
SMALLEST = 1e-5  # smaller numbers guard against rounding: doubling them changes no result, so they become 0


@dataclass(frozen=True)
class Mutant:
    """Replacement of ``text``, from ``start`` to ``end`` in a module's source, by ``new``.

    ``first_line`` and ``last_line`` bound the statement or, if compound, its header; ``key`` depends only on
    the file name, the function, the statement and the change.
    """

    key: str
    kind: str
    function: str
    first_line: int
    last_line: int
    start: int
    end: int
    text: str
    new: str
    statement: str

    def apply(self, source: str) -> str:
        return source[: self.start] + self.new + source[self.end :]


class _Finder:
    def __init__(self, source: str):
        self.source = source
        lines = source.split("\n")
        self._starts = [0]
        for line in lines:
            self._starts.append(self._starts[-1] + len(line) + 1)
        self._lines = lines
        self.found: list[tuple[str, str, ast.stmt, int, int, str]] = []

    def offset(self, line: int, column: int) -> int:
        """Offset in characters of a line (from 1) and a column in bytes, as in the syntax tree."""
        return self._starts[line - 1] + len(self._lines[line - 1].encode()[:column].decode())

    def span(self, node: ast.AST) -> tuple[int, int]:
        return self.offset(node.lineno, node.col_offset), self.offset(node.end_lineno, node.end_col_offset)  # type: ignore[attr-defined]

    def text(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.source[start:end]

    def add(self, kind: str, function: str, statement: ast.stmt, start: int, end: int, new: str) -> None:
        self.found.append((kind, function, statement, start, end, new))

    # ---- statements ----------------------------------------------------------------------------------------

    def body(self, statements: list[ast.stmt], function: str) -> None:
        for statement in statements:
            self.statement(statement, function)

    def statement(self, node: ast.stmt, function: str) -> None:
        if isinstance(node, (ast.Import, ast.ImportFrom, ast.Assert, ast.Raise)):
            if isinstance(node, ast.Raise):
                self.add("removal", function, node, *self.span(node), "pass")
            return
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            name = f"{function}.{node.name}".lstrip(".")
            if not isinstance(node, ast.ClassDef):
                for default in [*node.args.defaults, *(d for d in node.args.kw_defaults if d)]:
                    self.expression(default, function, node)
            self.body(node.body, name)
            return
        if isinstance(node, (ast.If, ast.While)):
            if "TYPE_CHECKING" in self.text(node.test):
                return
            start, end = self.span(node.test)
            if isinstance(node, ast.If):
                self.add("logic", function, node, start, end, f"not ({self.source[start:end]})")
            self.expression(node.test, function, node)
        elif isinstance(node, ast.For):
            self.expression(node.iter, function, node)
        elif isinstance(node, (ast.With, ast.AsyncWith)):
            for item in node.items:
                self.expression(item.context_expr, function, node)
        elif isinstance(node, ast.Expr):
            if isinstance(node.value, ast.Constant):
                return  # a docstring
            if isinstance(node.value, ast.Call):
                self.add("removal", function, node, *self.span(node), "pass")
            self.expression(node.value, function, node)
        elif isinstance(node, ast.AugAssign):
            self.add("removal", function, node, *self.span(node), "pass")
            self._operator(node.op, self.span(node.target)[1], self.span(node.value)[0], function, node)
            self.expression(node.value, function, node)
        elif isinstance(node, ast.Assign):
            if isinstance(node.targets[0], ast.Subscript):
                self.add("removal", function, node, *self.span(node), "pass")
            self.expression(node.value, function, node)
            for target in node.targets:
                self.expression(target, function, node)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            self.expression(node.value, function, node)
        elif isinstance(node, ast.Return) and node.value is not None:
            if not (isinstance(node.value, ast.Constant) and node.value.value is None):
                self.add("removal", function, node, *self.span(node), "return None")
            self.expression(node.value, function, node)
        elif isinstance(node, (ast.Continue, ast.Break)):
            new = "break" if isinstance(node, ast.Continue) else "continue"
            self.add("removal", function, node, *self.span(node), new)
        for part in ("body", "orelse", "finalbody"):
            self.body(getattr(node, part, []), function)
        for handler in getattr(node, "handlers", []):
            self.body(handler.body, function)

    # ---- expressions ---------------------------------------------------------------------------------------

    def expression(self, node: ast.AST, function: str, of: ast.stmt) -> None:
        if isinstance(node, ast.JoinedStr):
            return
        if isinstance(node, ast.Compare):
            self._compare(node, function, of)
        elif isinstance(node, ast.BinOp):
            if not (_is_text(node.left) or _is_text(node.right)):  # these are paths and messages
                self._operator(node.op, self.span(node.left)[1], self.span(node.right)[0], function, of)
        elif isinstance(node, ast.BoolOp):
            start, end = self.span(node.values[0])[1], self.span(node.values[1])[0]
            old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
            self._replaced(start, end, old, new, "logic", function, of)
        elif isinstance(node, ast.UnaryOp):
            if isinstance(node.op, (ast.Not, ast.Invert, ast.USub)):
                kind = "arithmetic" if isinstance(node.op, ast.USub) else "logic"
                self.add(kind, function, of, *self.span(node), f"({self.text(node.operand)})")
        elif isinstance(node, ast.Constant):
            for new in _other_constants(node.value):
                self.add("constant", function, of, *self.span(node), new)
        elif isinstance(node, ast.IfExp):
            self.add("logic", function, of, *self.span(node.test), f"not ({self.text(node.test)})")
        elif isinstance(node, ast.Call):
            self._call(node, function, of)
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name in WORDS:
                return
        elif isinstance(node, ast.Subscript) and "Literal" in self.text(node.value):
            return
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.keyword) and child.arg in ("axis", "dim"):
                self._axis(child.value, function, of)
            elif isinstance(child, (ast.expr, ast.keyword, ast.comprehension)):
                self.expression(child, function, of)

    def _compare(self, node: ast.Compare, function: str, of: ast.stmt) -> None:
        left = node.left
        for operator, right in zip(node.ops, node.comparators, strict=True):
            start, end = self.span(left)[1], self.span(right)[0]
            old, *others = COMPARISONS[type(operator)]
            for new in others:
                self._replaced(start, end, old, new, "comparison", function, of)
            left = right

    def _operator(self, operator: ast.operator, start: int, end: int, function: str, of: ast.stmt) -> None:
        if type(operator) in ARITHMETIC:
            self._replaced(start, end, *ARITHMETIC[type(operator)], "arithmetic", function, of)

    def _replaced(
        self, start: int, end: int, old: str, new: str, kind: str, function: str, of: ast.stmt
    ) -> None:
        at = self.source[start:end].find(old)
        if at >= 0:
            self.add(kind, function, of, start + at, start + at + len(old), new)

    def _call(self, node: ast.Call, function: str, of: ast.stmt) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in SWAPS:
            end = self.span(node.func)[1]
            self.add("swap", function, of, end - len(name), end, SWAPS[name])
        if name in UNWRAPPED and node.args:
            self.add("swap", function, of, *self.span(node), f"({self.text(node.args[0])})")
        if name in UNCHAINED and isinstance(node.func, ast.Attribute):
            self.add("swap", function, of, *self.span(node), f"({self.text(node.func.value)})")
        if name in ("select", "where") and len(node.args) == 3:
            _, b, c = node.args
            start, end = self.span(b)[0], self.span(c)[1]
            self.add("swap", function, of, start, end, f"{self.text(c)}, {self.text(b)}")

    def _axis(self, node: ast.expr, function: str, of: ast.stmt) -> None:
        old = self.text(node)
        new = {"0": "-1", "1": "0", "-1": "0", "2": "1"}.get(old)
        if new is not None:
            self.add("axis", function, of, *self.span(node), new)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _other_constants(value: object) -> Iterator[str]:
    if isinstance(value, bool):
        yield str(not value)
    elif isinstance(value, int):
        yield str(value + 1)
        if value > 0:
            yield str(value - 1)
    elif isinstance(value, float):
        if value == 0.0:
            yield "1.0"
        elif abs(value) < SMALLEST:
            yield "0.0"
        else:
            yield repr(value * 2)
            yield repr(value / 2)


def find_mutants(name: str, source: str) -> list[Mutant]:
    """List all mutants of the module with the path ``name`` in the project."""
    finder = _Finder(source)
    finder.body(ast.parse(source).body, "")
    mutants, seen = [], set()
    for kind, function, statement, start, end, new in finder.found:
        first = finder.offset(statement.lineno, statement.col_offset)
        header = source[first : finder.offset(*_end_of_header(statement))]
        parts = (name.rpartition("/")[2], function, header, str(start - first), source[start:end], new)
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]
        if key in seen or source[start:end] == new:
            continue
        seen.add(key)
        last = finder.source.count("\n", 0, first + len(header)) + 1
        mutants.append(
            Mutant(key, kind, function, statement.lineno, last, start, end, source[start:end], new,
                   " ".join(header.split()))
        )  # fmt: skip
    return mutants


def _end_of_header(statement: ast.stmt) -> tuple[int, int]:
    """Line and column of the end of a statement or, if compound, of its header."""
    body = getattr(statement, "body", None)
    if not isinstance(body, list) or not body:
        return statement.end_lineno or 0, statement.end_col_offset or 0
    parts = [child for name in ("test", "iter", "target") if (child := getattr(statement, name, None))]
    parts += [item.context_expr for item in getattr(statement, "items", [])]
    arguments = getattr(statement, "args", None)
    if arguments is not None:
        parts += [*arguments.args, *arguments.kwonlyargs, *arguments.defaults]
        parts += [default for default in arguments.kw_defaults if default is not None]
    ends = [(part.end_lineno, part.end_col_offset) for part in parts]
    return max(ends, default=(statement.lineno, statement.col_offset))
