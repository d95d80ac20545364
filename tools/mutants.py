"""Which small changes can be made to the arithmetic of a Python file: see tools/mutation_run.py, which tries them."""

# ruff: noqa: D102 - methods of visitors are named by ast

from __future__ import annotations

import ast
import collections
import contextlib
import difflib
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
COMPARISONS: dict[type[ast.cmpop], list[type[ast.cmpop]]] = {
    ast.Lt: [ast.LtE, ast.Gt],
    ast.LtE: [ast.Lt, ast.GtE],
    ast.Gt: [ast.GtE, ast.Lt],
    ast.GtE: [ast.Gt, ast.LtE],
    ast.Eq: [ast.NotEq],
    ast.NotEq: [ast.Eq],
    ast.Is: [ast.IsNot],
    ast.IsNot: [ast.Is],
    ast.In: [ast.NotIn],
    ast.NotIn: [ast.In],
}
TWINS = [
    *[("mean", "sum"), ("min", "max"), ("amin", "amax"), ("argmin", "argmax"), ("minimum", "maximum"), ("sin", "cos")],
    *[("any", "all"), ("zeros", "ones"), ("zeros_like", "ones_like"), ("floor", "ceil"), ("clamp_min", "clamp_max")],
    *[("zeros_", "ones_"), ("add_", "sub_"), ("mul_", "div_"), ("rand", "randn"), ("cumsum", "cumprod")],
]
RENAMED = {a: b for pair in TWINS for a, b in (pair, pair[::-1])} | {"fmean": "sum", "std": "var", "prod": "sum"}
OMITTED = frozenset(
    [
        "sqrt",
        "square",
        "abs",
        "exp",
        "log",
        "log2",
        "flip",
        "roll",
        "tanh",
        "sigmoid",
        "softmax",
        "gelu",
        "relu",
        "silu",
    ]
    + ["clamp", "masked_fill", "where", "normalize", "sorted", "reversed", "round", "floor", "ceil", "unique", "neg"]
    + ["nan_to_num", "expm1", "log1p", "cumsum", "cumprod", "diff", "norm", "transpose"]
)
"""Functions and methods whose argument may stand for their value."""
SYMMETRIC = frozenset(
    ["min", "max", "minimum", "maximum", "logical_and", "logical_or", "equal", "isclose", "allclose"]
    + ["transpose", "swapaxes", "mse_loss", "l1_loss", "huber_loss"]
)
"""Functions and methods whose first two arguments may change places without any difference."""
EVEN = frozenset(["abs", "square", "square_", "norm", "vector_norm"])
"""Functions and methods that do not see the sign of their argument."""
BESIDES = frozenset(["device", "strict", "preserve_rng_state", "non_blocking"])
"""Keywords that change where or how fast something is computed, or what is refused, and not what."""
MODULES = ("torch", "math", "functional", "nn.functional", "torch.nn.functional", "F", "np")


@dataclass(frozen=True)
class Mutant:
    """One changed place.

    Attributes:
        file: relative to the project.
        line: of the change.
        function: qualified name of the outermost function (or class) around it; empty at the module's level.
        what: the kind of change.
        start: first byte of what is replaced.
        end: the byte after it.
        text: what stands there instead.
        key: names the change, also after lines elsewhere were edited.
    """

    file: str
    line: int
    function: str
    what: str
    start: int
    end: int
    text: str
    key: str

    def applied(self, source: bytes) -> bytes:
        """The changed file."""
        return source[: self.start] + self.text.encode() + source[self.end :]

    def diff(self, source: bytes) -> str:
        """The changed lines, before and after."""
        before, after = (text.decode().splitlines() for text in (source, self.applied(source)))
        lines = list(difflib.unified_diff(before, after, lineterm="", n=0))[2:]
        return "\n".join(line[0] + " " + line[1:].strip() for line in lines if not line.startswith("@@"))


class Finder(ast.NodeVisitor):
    """Collects the possible changes of one file: what computes, but no text, annotation, import or error."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        starts = [0]
        for line in source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self.starts = starts
        self.scope: list[str] = []
        self.inside = False
        self.found: list[tuple[ast.AST, str, str, str, bool]] = []
        self.signless: set[ast.AST] = set()
        self.written: set[ast.AST] = set()

    # Where a node stands; ast counts columns in bytes.
    def span(self, node: ast.AST) -> tuple[int, int]:
        return (
            self.starts[node.lineno - 1] + node.col_offset,  # type: ignore[attr-defined]
            self.starts[node.end_lineno - 1] + node.end_col_offset,  # type: ignore[attr-defined]
        )

    def add(self, node: ast.AST, what: str, new: ast.AST | str) -> None:
        text = new if isinstance(new, str) else f"({ast.unparse(new)})"
        self.found.append((node, what, text, ".".join(self.scope)))

    # What is left alone.
    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Texts."""

    def visit_Raise(self, node: ast.Raise) -> None:
        """Errors."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Assertions."""

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.enter(node.name, node.body)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        stub = all(isinstance(s, ast.Pass) or isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant)
                   for s in node.body)  # fmt: skip
        if stub:
            return
        outermost, self.inside = not self.inside, True
        if outermost:
            self.scope.append(node.name)
        for default in [*node.args.defaults, *node.args.kw_defaults]:
            if default is not None:
                self.visit(default)
        for statement in node.body:
            self.visit(statement)
        if outermost:
            self.scope.pop()
            self.inside = False

    def enter(self, name: str, body: Iterable[ast.stmt]) -> None:
        if not self.inside:
            self.scope.append(name)
        for statement in body:
            self.visit(statement)
        if not self.inside:
            self.scope.pop()

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        if self.inside and not all(isinstance(target, (ast.Name, ast.Tuple)) for target in node.targets):
            self.add(node, "statement removed", "pass")
        if not (isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__"):
            self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add(node, "statement removed", "pass")
        new = ARITHMETIC.get(type(node.op))
        if new is not None:
            self.add(node, "operator", ast.unparse(ast.AugAssign(node.target, new(), node.value)))
        self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if self.inside and isinstance(node.value, ast.Call):
            self.add(node, "statement removed", "pass")
            self.written.add(node.value)
        self.visit(node.value)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        # Shapes and ranges in annotations are no arithmetic.
        if ast.unparse(node.value).split(".")[-1] in {"Float", "Int", "Bool", "Annotated", "Literal", "ClassVar"}:
            return
        self.generic_visit(node)

    # What is changed.
    def visit_BinOp(self, node: ast.BinOp) -> None:
        if isinstance(node.op, ast.Pow) and isinstance(node.right, ast.Constant) and node.right.value == 2:
            self.ignores_sign(node.left)
        new = ARITHMETIC.get(type(node.op))
        text = isinstance(node.left, (ast.JoinedStr, ast.Constant)) and not isinstance(
            getattr(node.left, "value", None), (int, float)
        )
        if new is not None and not text and not self.is_type(node):
            self.add(node, "operator", ast.BinOp(node.left, new(), node.right))
            self.add(node, "left term only", node.left)
            if not isinstance(node.op, (ast.Pow, ast.FloorDiv, ast.Mod)):
                self.add(node, "right term only", node.right)
            if isinstance(node.op, (ast.Sub, ast.Div)) and node not in self.signless:
                self.add(node, "operands swapped", ast.BinOp(node.right, node.op, node.left))
        elif isinstance(node.op, ast.MatMult):
            self.add(node, "operands swapped", ast.BinOp(node.right, node.op, node.left))
        self.generic_visit(node)

    def ignores_sign(self, value: ast.AST | None) -> None:
        # A difference over time of a difference has the same two signs.
        while isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute) and value.func.attr == "diff":
            value = value.func.value
        if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Sub):
            self.signless.add(value)

    def is_type(self, node: ast.BinOp) -> bool:
        # `int | None` at the level of a module.
        return isinstance(node.op, ast.BitOr) and not self.inside

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self.add(node, "sign or negation dropped", node.operand)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for i, op in enumerate(node.ops):
            for new in COMPARISONS[type(op)]:
                ops = [*node.ops[:i], new(), *node.ops[i + 1 :]]
                self.add(node, "comparison", ast.Compare(node.left, ops, node.comparators))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        self.add(node, "and/or", ast.BoolOp(other, node.values))
        for i in range(len(node.values)):
            rest = [*node.values[:i], *node.values[i + 1 :]]
            self.add(node, "condition dropped", rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest))
        self.generic_visit(node)

    def conditioned(self, node: ast.If | ast.IfExp | ast.While) -> None:
        if isinstance(node.test, (ast.Compare, ast.UnaryOp)) and "TYPE_CHECKING" not in ast.unparse(node.test):
            pass  # negated by its own operators
        elif ast.unparse(node.test) != "TYPE_CHECKING":
            self.add(node.test, "condition negated", ast.UnaryOp(ast.Not(), node.test))
        self.generic_visit(node)

    visit_If = visit_IfExp = visit_While = conditioned

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add(node, "constant", repr(not value))
        elif isinstance(value, (int, float)):
            new = {value + 1, value - 1, 2 * value} if isinstance(value, int) else {2 * value, value + 1}
            for other in sorted(new - {value}):
                self.add(node, "constant", repr(other) if other >= 0 else f"({other!r})")

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in {"warn", "cast", "TypeVar", "getLogger"}:
            return
        owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
        if name in RENAMED and isinstance(node.func, ast.Attribute):
            other = ast.Attribute(node.func.value, RENAMED[name])
            self.add(node, f"{name} → {RENAMED[name]}", ast.Call(other, node.args, node.keywords))
        elif name in {"min", "max", "any", "all"}:
            self.add(node, f"{name} → {RENAMED[name]}", ast.Call(ast.Name(RENAMED[name]), node.args, node.keywords))
        if name in OMITTED:
            of_value = isinstance(node.func, ast.Attribute) and owner not in {*MODULES, "self"}
            inner = node.func.value if of_value else node.args[0] if node.args else None  # type: ignore[attr-defined]
            if name == "where" and len(node.args) == 3:
                inner = node.args[1]
            if inner is not None and not isinstance(inner, ast.Starred):
                self.add(node, f"{name} omitted", inner)
        elif owner == "self" and self.inside and len(node.args) == 1 and not node.keywords:
            self.add(node, f"{name} omitted", node.args[0])
        if name in EVEN:
            of_value = isinstance(node.func, ast.Attribute) and owner not in {*MODULES, "torch.linalg", "self"}
            self.ignores_sign(node.func.value if of_value else node.args[0] if node.args else None)  # type: ignore[attr-defined]
        plain = [a for a in node.args if not isinstance(a, ast.Starred)]
        symmetric = name in SYMMETRIC or len(plain) < len(node.args)
        if len(plain) >= 2 and not symmetric and ast.dump(plain[0]) != ast.dump(plain[1]):
            args = [plain[1], plain[0], *plain[2:]]
            self.add(node, "arguments swapped", ast.Call(node.func, args, node.keywords))
        for i, keyword in enumerate(node.keywords):
            # Where the value is used, ``out`` says only in which memory it is.
            besides = BESIDES if node in self.written else BESIDES | {"out"}
            if keyword.arg is not None and keyword.arg not in besides:
                rest = [*node.keywords[:i], *node.keywords[i + 1 :]]
                self.add(node, f"{keyword.arg}= dropped", ast.Call(node.func, node.args, rest))
        self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in BESIDES - {"device"}:
            self.visit(node.value)

    def visit_Slice(self, node: ast.Slice) -> None:
        for name in ("lower", "upper"):
            if getattr(node, name) is not None:
                rest = {"lower": node.lower, "upper": node.upper, "step": node.step, name: None}
                self.add(node, "slice", ast.unparse(ast.Slice(**rest)))
        self.generic_visit(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self.add(node, "statement removed", "pass")

    visit_Break = visit_Continue  # type: ignore[assignment]


def mutants_of(file: str, source: bytes) -> list[Mutant]:
    """All changes of a file; some few may be no Python."""
    finder = Finder(source)
    finder.visit(ast.parse(source))
    found: list[Mutant] = []
    seen: collections.Counter[str] = collections.Counter()
    lines = source.decode().splitlines()
    for node, what, text, function in finder.found:
        start, end = finder.span(node)
        old = source[start:end].decode()
        parts = (file, function, what, lines[node.lineno - 1].strip(), old, text)  # type: ignore[attr-defined]
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]
        seen[key] += 1
        key += f"-{seen[key]}" if seen[key] > 1 else ""
        found.append(Mutant(file, node.lineno, function, what, start, end, text, key))  # type: ignore[attr-defined]
    return found


def sample(root: Path, patterns: Iterable[str], count: int, seed: int) -> list[Mutant]:
    """Mutants of the files, in random order; ``count`` of them, or all if 0.

    The place of a mutant in this order depends on the seed and on itself alone: a sample stays what it is, but for the
    lines that were changed.
    """
    files = sorted({path for pattern in patterns for path in root.glob(pattern) if path.suffix == ".py"})
    sources = {str(path.relative_to(root)): path.read_bytes() for path in files}
    every = [mutant for file, source in sources.items() for mutant in mutants_of(file, source)]
    every.sort(key=lambda mutant: hashlib.sha256(f"{seed} {mutant.key}".encode()).digest())
    meant = {file: ast.dump(ast.parse(source)) for file, source in sources.items()}
    found: list[Mutant] = []
    for mutant in every:
        with contextlib.suppress(SyntaxError):
            if ast.dump(ast.parse(mutant.applied(sources[mutant.file]))) != meant[mutant.file]:
                found.append(mutant)
        if len(found) == count:
            break
    return found
