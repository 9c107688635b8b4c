"""Writes the list of messages: errors, warnings, and remarks on a recording, by the room that gives them.

Each message states what is wrong, where, and what to do, so the list is made of the sources. What a message
fills in stands as an ellipsis.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RAISED = re.compile(r"^(Input|Inference|NoWeight|NotANumber|OtherKind)Error$")
REMARKS = re.compile(r"problem|note|doubt|fault")
KINDS = {"error": "Errors", "warning": "Warnings", "remark": "Problems, notes and doubts of a recording"}
FEWEST_WORDS = 5  # of a message; what is shorter is a piece of one


def worded(node: ast.expr) -> str:
    """The text of a literal, an ellipsis in place of what is filled in."""
    if isinstance(node, ast.Constant):
        return str(node.value) if isinstance(node.value, str) else "…"
    if isinstance(node, ast.JoinedStr):
        return "".join(worded(value) for value in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return worded(node.left) + worded(node.right)
    return "…"


def called(node: ast.Call) -> str:
    """The last name of what is called."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def messages(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Kind and text of each message of a file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args:
            if RAISED.match(called(node)):
                yield "error", worded(node.args[0])
            elif called(node) == "warn":
                yield "warning", worded(node.args[0])
        if isinstance(node, ast.FunctionDef) and REMARKS.search(node.name):
            for inner in ast.walk(node):
                value = inner.value if isinstance(inner, ast.Yield | ast.Return) else None
                last = value.elts[-1] if isinstance(value, ast.Tuple) and value.elts else value
                if isinstance(last, ast.JoinedStr | ast.Constant | ast.BinOp):
                    yield "remark", worded(last)


def sources() -> Iterator[tuple[str, Path]]:
    """Room and file of every module."""
    for top in ("bcppl", "models", "inference"):
        for file in sorted((ROOT / top).rglob("*.py")):
            parts = file.relative_to(ROOT).with_suffix("").parts
            if parts[:2] not in (("bcppl", "models"), ("bcppl", "inference")):
                inner = parts[1:] if top == "bcppl" else parts
                yield ".".join(("bcppl", *inner[:-1])) if len(inner) > 1 else f"bcppl.{inner[0]}", file


def page() -> str:
    """The list in Markdown."""
    listed: dict[str, dict[str, set[str]]] = {kind: {} for kind in KINDS}
    for room, file in sources():
        for kind, text in messages(ast.parse(file.read_text(encoding="utf-8"))):
            text = re.sub(r"\s+", " ", re.sub(r"…(\s*…)+", "…", text)).strip()
            if len(re.findall(r"[a-z]+", text)) >= FEWEST_WORDS:
                listed[kind].setdefault(room, set()).add(text)
    made = (
        "# All messages\n\nErrors, warnings and remarks, by the room that gives them; … is filled in. "
        "Each states what is wrong and what to do. [Messages and cures](../messages.md) explains those that "
        "are frequent.\n"
    )
    for kind, title in KINDS.items():
        made += f"\n## {title}\n"
        for room, texts in sorted(listed[kind].items()):
            made += f"\n### {title.split()[0].rstrip(',')} of `{room}`\n\n"
            made += "".join(f"- {escaped(text)}\n" for text in sorted(texts, key=str.lower))
    return made


def escaped(text: str) -> str:
    """Plain text in Markdown; code stays between its backticks."""
    pieces = re.split(r"(`[^`]+`)", text)
    pieces[::2] = [re.sub(r"([\\*_\[\]<>{}$#|~])", r"\\\1", piece) for piece in pieces[::2]]
    return "".join(pieces)
