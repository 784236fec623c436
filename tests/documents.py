"""The code blocks of the repository's documents, and the command lines in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from api_server import ROOT

FOLDERS = ("", "docs", "docs/results", "docker", "scenes")
FENCED = re.compile(r"(<!-- not run: (?P<why>.+?) -->\n)?^ *```(?P<language>\w*)\n(?P<text>.*?)^ *```$", re.M | re.S)


@dataclass(frozen=True, slots=True)
class Block:
    document: str
    line: int
    language: str
    text: str
    not_run: str
    """The reason that the comment before the block gives; empty if there is none."""

    def __str__(self) -> str:
        return f"{self.document}:{self.line}"


def pages() -> list[Path]:
    return [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.md"))]


def blocks() -> list[Block]:
    return [block for path in pages() for block in blocks_of(str(path.relative_to(ROOT)), path.read_text("utf-8"))]


def blocks_of(name: str, text: str) -> Iterator[Block]:
    for found in FENCED.finditer(text):
        line = text.count("\n", 0, found.start("language")) + 1
        yield Block(name, line, found["language"], found["text"], (found["why"] or "").strip())


def lines_of(script: str) -> list[str]:
    """Return the logical lines of a shell script: continued or indented ones belong to the line before."""
    joined = re.sub(r"\\\n|\n(?=[ \t])", " ", script)
    return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]


def commands_of(line: str) -> Iterator[list[str]]:
    """Yield the words of each command of a line, without what it is redirected to."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ";"]:
        if set(word) <= set("|&;<>()"):
            yield words
            words = []
        else:
            words.append(word)
