"""What the documents point at is there, and their code is code that works.

Python and command lines that localize are run by test_demo.py, docs/clients.md by test_clients.py, docs/frames.md by
test_frames.py. Of every block the syntax is checked here, and of a command line that the command, its options and the
route exist. A block in another language needs the comment `<!-- not run: why -->` right before it.
"""

from __future__ import annotations

import ast
import configparser
import hashlib
import json
import re
import subprocess
import tomllib

import pytest
import typer.core
import typer.main
import yaml
from api_server import ROOT, operations
from documents import Block, blocks, blocks_of, commands_of, lines_of, pages

from service.cli.app import app

BLOCKS = blocks()
PAGES = pages()
TARGETS = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))


def test_each_claim_of_security_names_tests_that_exist():
    text = (ROOT / "docs" / "security.md").read_text("utf-8")
    claims = [line for line in text.splitlines() if line.startswith("| ") and not re.match(r"\| (claim|---)", line)]
    assert len(claims) > 25
    for claim in claims:
        named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", claim.split(" | ")[1])
        assert named, claim
        for file, name in named:
            tree = ast.parse((ROOT / "tests" / file).read_text("utf-8"))
            functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            assert name in functions, f"{file}::{name}"


def test_the_citation_is_of_this_program_and_of_the_paper():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    # What version 1.2.0 of the format demands of a file and of each reference.
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    assert (cited["cff-version"], cited["type"]) == ("1.2.0", "software")
    assert (cited["title"], cited["license"]) == (project["name"], project["license"])
    (paper,) = cited["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert "Monte Carlo initialization and decoupled optimization" in paper["title"]


def test_scenes_of_the_repository_have_the_hash_and_split_of_the_benches_table():
    text = (ROOT / "docs" / "benchmarks.md").read_text("utf-8")
    ((path, said),) = re.findall(r"^\| `(scenes/\S+)` \| `([0-9a-f]{64})` \|", text, re.M)
    with (ROOT / path).open("rb") as file:
        assert hashlib.file_digest(file, "sha256").hexdigest() == said
    folder = (ROOT / path).parent
    trained = json.loads((folder / "transforms.json").read_text("utf-8"))["frames"]
    tested = json.loads((folder / "truth.json").read_text("utf-8"))
    assert f"| studio | {len(trained)} / {len(tested)} |" in text


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(path):
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", path.read_text("utf-8")):
        found = (path.parent / target).resolve() if target else path
        assert found.exists(), f"{path.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", found.read_text("utf-8"), re.M)
            assert anchor in map(slug, headings), f"{path.name}: {target}#{anchor}"


def test_contributing_names_files_that_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    named = set(re.findall(r"`((?:service|viewer|tests|docs|scenes|docker|\.ci)/[\w./]+)`", text))
    examples = {name for name in named if re.search(r"my_|[A-Z]{4}", name)}
    assert len(named - examples) > 50
    assert not {name for name in named - examples if not (ROOT / name).exists()}


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_each_code_block_is_sound_or_says_why_it_is_not_run(block):
    check(block)


@pytest.mark.parametrize(
    ("language", "text", "complaint"),
    [
        ("", "make demo", "language"),
        ("cobol", "STOP RUN.", "language"),
        ("python", "def f(:", "invalid syntax"),
        ("json", "{'a': 1}", "Expecting property name"),
        ("yaml", "a: b: c", "not allowed here"),
        ("ini", "key=value", "no section headers"),
        ("toml", "a = ", "Invalid value"),
        ("sh", "if true; then", "unexpected end of file"),
        ("sh", "make dmeo", "make dmeo"),
        ("sh", "SPLATFIX_PORT=1 .venv/bin/splatfix serv", "splatfix serv"),
        ("sh", "splatfix localize a.jpg --scene b --sead 3", "No such option"),
        ("sh", "splatfix localize a.jpg --scene b --seed x", "valid integer"),
        ("sh", "splatfix bench localize SCENE\n    [--start PROTOCOL] [--trails N]", "--trails"),
        ("sh", 'cat x | curl -T - "$URL/scene/attic" > a.json', "PUT /scene/attic"),
        ("sh", "curl http://127.0.0.1:8000/localize", "GET /localize"),
        ("sh", "docker build -f docker/Dockerfille .", "Dockerfille"),
    ],
)
def test_a_wrong_block_is_noticed(language, text, complaint):
    (block,) = blocks_of("x.md", f"```{language}\n{text}\n```\n")
    with pytest.raises((Exception, AssertionError), match=re.escape(complaint)):
        check(block)


def test_a_reason_is_read_only_right_before_its_block():
    told, untold = blocks_of("x.md", "<!-- not run: a drawing -->\n```text\n-->\n```\n\n```text\n-->\n```\n")
    assert (told.not_run, untold.not_run) == ("a drawing", "")
    assert (told.line, untold.line) == (2, 6)


def check(block: Block) -> None:
    match block.language:
        case "python":
            compile(block.text, str(block), "exec")
        case "json":
            json.loads(block.text)
        case "yaml":
            list(yaml.safe_load_all(block.text))
        case "toml":
            tomllib.loads(block.text)
        case "ini":
            configparser.ConfigParser(strict=False, interpolation=None).read_string(block.text)
        case "sh":
            done = subprocess.run(["bash", "-n"], input=block.text, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            for line in lines_of(block.text):
                check_line(line)
        case _:
            assert block.not_run, f"{block}: the language {block.language!r} can't be checked; say why it is not run"


def check_line(line: str) -> None:
    """Raise if a command, an option, a target, a file or a route of a shell line doesn't exist."""
    if " [--" in line:  # a synopsis
        command, _ = splatfix_command(line.split(" [--")[0].split()[1:])
        known = {option for parameter in command.params for option in parameter.opts}
        asked = set(re.findall(r"--[a-z][a-z-]*", line))
        assert asked <= known, asked - known
        return
    for words in commands_of(line):
        programs = [i for i, word in enumerate(words) if word == "splatfix" or word.endswith("bin/splatfix")]
        if programs:
            command, arguments = splatfix_command(words[programs[0] + 1 :])
            command.make_context(command.name, arguments)
        elif words[:1] == ["make"]:
            assert words[1] in TARGETS, line
        elif words[:1] == ["curl"]:
            check_route(words)
        if words[:1] == ["docker"] and "-f" in words:
            assert (ROOT / words[words.index("-f") + 1]).is_file(), line


def splatfix_command(words: list[str]) -> tuple[typer.core.TyperCommand | typer.core.TyperGroup, list[str]]:
    """Return the command that the words call, and its arguments."""
    command = typer.main.get_command(app)
    while isinstance(command, typer.core.TyperGroup):
        assert words[0] in command.commands, f"splatfix {' '.join(words)}"
        command, words = command.commands[words[0]], words[1:]
    return command, words


def check_route(words: list[str]) -> None:
    (url,) = (
        re.fullmatch(r"(?:http://[\w.:]+|\$URL)(/[^?]*).*", w) for w in words if w.startswith(("http://", "$URL"))
    )
    methods = {"-T": "PUT", "-F": "POST", "-d": "POST"}
    given = [methods[word] for word in words if word in methods]
    method = words[words.index("-X") + 1] if "-X" in words else (given or ["GET"])[0]
    path = re.sub(r"\$\w+", "x", url[1])
    assert any(m == method and pattern.fullmatch(path) for m, pattern, _ in operations()), f"{method} {path}"
