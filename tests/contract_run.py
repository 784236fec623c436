"""The contract run: schemathesis asks for everything that openapi.yaml tells of, rightly and wrongly, in sequences.

    python tests/contract_run.py [--examples 60] [--scenarios 300] [--seed 1]

Needs `pip install splatfix[hostile]`. The service is real but for its estimator; its renderer is ours. Each answer is
held against the document: status, media type, headers, schema; a 5xx is a failure unless it is a documented "not now".
Prints the number of requests by status as JSON after schemathesis's own report; exits with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

HERE = Path(__file__).parent
CHECKS = (
    *("not_a_server_error", "status_code_conformance", "content_type_conformance", "response_headers_conformance"),
    *("response_schema_conformance", "unsupported_method", "allow_header_conformance"),
)


class Counted:
    """An ASGI layer that counts answers; failures with their code."""

    def __init__(self, app, counts: Counter, failures: Counter) -> None:
        self._app, self._counts, self._failures = app, counts, failures

    async def __call__(self, scope, receive, send) -> None:
        status = 0

        async def counted(message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._counts[status] += 1
            elif message["type"] == "http.response.body" and status >= 500 and message.get("body"):
                code = json.loads(message["body"]).get("code", "not ready")
                self._failures[f"{scope['method']} {scope['route'].path if 'route' in scope else '?'}: {code}"] += 1
            await send(message)

        await self._app(scope, receive, counted)


def hooks() -> None:
    """Loaded by schemathesis: half of the photos are photos, half of the scenes scenes."""
    import base64

    import schemathesis
    from api_server import photo
    from test_scenes import ply

    sent = {"photo": photo(size=(48, 40)), "scene": ply(5)}

    @schemathesis.hook
    def map_body(context, body):
        operation = context.operation.label
        if operation == "POST /localize" and isinstance(body, dict) and isinstance(body.get("photo"), str | bytes):
            odd = len(json.dumps(body, default=str)) % 2
            if odd and isinstance(body["photo"], bytes):
                body["photo"] = sent["photo"]
            elif odd:
                body["photo"] = base64.b64encode(sent["photo"]).decode()
            body.pop("estimator", None) if odd else None
        if operation.startswith("PUT /scenes") and isinstance(body, bytes) and len(body) % 2:
            return sent["scene"]
        return body


if os.environ.get("SCHEMATHESIS_HOOKS") == "contract_run":
    hooks()


def run(url: str, folder: Path, phases: str, examples: int, seed: int) -> int:
    command = [
        *(str(Path(sys.executable).parent / "schemathesis"), "run", str(HERE.parent / "openapi.yaml"), "--url", url),
        *("--checks", ",".join(CHECKS), "--phases", phases, "--continue-on-failure"),
        *("--max-examples", str(examples), "--seed", str(seed), "--request-timeout", "30"),
        *("--suppress-health-check", "all", "--no-shrink", "--warnings", "off"),
        *("--report", "ndjson", "--report-ndjson-path", str(folder / "events.ndjson")),
    ]
    path = f"{HERE}{os.pathsep}{HERE.parent}"
    return subprocess.call(
        command, env=os.environ | {"PYTHONPATH": path, "SCHEMATHESIS_HOOKS": "contract_run"}, cwd=folder
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=60, help="for each operation")
    parser.add_argument("--scenarios", type=int, default=300, help="sequences of requests")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    from api_server import create_app, fake_estimators, serving, settings, until
    from test_scenes import TRANSFORMS, ply

    counts, failures = Counter(), Counter()
    with tempfile.TemporaryDirectory() as name, fake_estimators():
        folder = Path(name)
        (folder / "room").mkdir()
        (folder / "room" / "scene.ply").write_bytes(ply())
        (folder / "room" / "transforms.json").write_text(json.dumps(TRANSFORMS))
        changes = {"scenes": [folder / "room"], "cache_dir": None, "rate_limit": "", "queue_size": 100_000}
        app = create_app(settings(**changes, max_wait_s=1, data_dir=folder / "data"))
        app.add_middleware(Counted, counts=counts, failures=failures)
        with serving(app) as client:
            until(lambda: client.get("/readyz").status_code == 200, 300)
            counts.clear(), failures.clear()
            url = str(client.base_url)
            code = run(url, folder, "examples,coverage,fuzzing", arguments.examples, arguments.seed)
            singles = sum(counts.values())
            code = run(url, folder, "stateful", arguments.scenarios, arguments.seed) or code
            alive = client.get("/livez").status_code == 200
    report = {
        "requests": sum(counts.values()),
        "in_sequences": sum(counts.values()) - singles,
        "by_status": {str(status): count for status, count in sorted(counts.items())},
        "5xx": dict(failures),
        "alive": alive,
        "schemathesis": code,
    }
    print(json.dumps(report, indent=1))
    return 1 if code or not alive else 0


if __name__ == "__main__":
    raise SystemExit(main())
