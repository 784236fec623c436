"""The entry of the `splatfix` command: makes sure that the packages which Python finds are this program's.

`service` and `viewer` are common names. Another distribution that brings one of them hides or overwrites ours, and
the command would end in an error that says nothing of that.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parents[1]
_OURS = {"service": "localize.py", "viewer": "viewer_server.py"}
"""Each of our packages with a module that another package of that name hardly has."""
_MARK = "3D Gaussian Splatting"
"""Is in the description of each of our packages."""


def main() -> None:
    """Run the command line; where a foreign package stands in the way, say so on stderr with exit code 2."""
    problem = foreign_package()
    if problem:
        sys.stderr.write(f"error: {problem}\n")
        raise SystemExit(2)
    from service.cli.app import main as run

    run()


def foreign_package() -> str:
    """Return which package stands in the way of ours and how to mend it; empty if none does."""
    for name, module in _OURS.items():
        spec = importlib.util.find_spec(name)
        found = Path(spec.origin).resolve().parent if spec and spec.origin else None
        whole = found is not None and (found / module).is_file() and _MARK in (found / "__init__.py").read_text("utf-8")
        if found == _HERE / name and whole:
            continue
        # In the right place the files of another one may have overwritten ours. Only now: this takes a second.
        owners = set(importlib.metadata.packages_distributions().get(name, ())) - {"splatfix"}
        where = f"Python finds {found}" if found != _HERE / name else f"{found} is not ours alone"
        by = f" (of {', '.join(sorted(owners))})" if owners else ""
        return (
            f"splatfix needs its own package '{name}', but {where}{by}. Install splatfix into an environment of "
            "its own (`uv tool install`, `pipx install`), and start it where no folder or PYTHONPATH has "
            f"another '{name}'."
        )
    return ""
