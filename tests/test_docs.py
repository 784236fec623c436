"""What the documents point at is there."""

from __future__ import annotations

import ast
import re

from api_server import ROOT


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
