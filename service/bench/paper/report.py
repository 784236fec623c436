"""Writes the report of a run: PNG files, tables.json, and one self-contained HTML page."""

from __future__ import annotations

import base64
import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from service.bench.paper.claims import Claim, claims
from service.bench.paper.runs import RunSpec, load, read_lines
from service.bench.paper.tables import Line, Table, published, tables
from service.errors import BackendMissing, InvalidRequest

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1180px;margin:2rem auto;padding:0 1rem;color:#1b1b1b;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2.2rem}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}
th,td{padding:.22rem .6rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
thead th{border-bottom:2px solid #888;white-space:normal;vertical-align:bottom}
tr.published td{color:#6a6a6a}p.note{font-size:13px;color:#444;max-width:75ch;margin:.2rem 0}
img{max-width:100%}td.yes{color:#1d7a3a}td.no{color:#b3261e}
"""
FIGURES = {
    "figure1": "Figure 1: Match vectors (red: rendered, green: in the photo) when the camera is only turned about the "
    "scene's centre, or only shifted; along the steps without and with decoupling; the path of the camera. Not "
    "decoupled: icomma, which descends the distances of all matches by all six numbers at once.",
    "figure2": "Figure 2: Answers blended with the photo, start 'hard'.",
    "figure3": "Figure 3: The same, not blended.",
    "figure4": "Figure 4: Share of the queries within 5 deg and 0.05 units after each step. A step of view_index or "
    "mc_do is a record of its trace (a hypothesis, a render and its matches, or a gradient), of the others a gradient.",
}


def write(spec: RunSpec, folder: Path) -> None:
    """Write the report of the results in `spec.out`. Raises InvalidRequest, BackendMissing."""
    if find_spec("matplotlib") is None:
        raise BackendMissing("figures need matplotlib; install splatfix[bench].", where="--report")
    lines = [line for line in read_lines(spec.out / "results.jsonl") if line["scene"] in spec.scenes]
    if not lines:
        raise InvalidRequest("there are no results.", where=str(spec.out))
    config = json.loads((spec.out / "config.json").read_text("utf-8"))
    config["scenes"] = {name: config["scenes"][name] for name in spec.scenes if name in config["scenes"]}
    found, checked = tables(lines, config), claims(lines)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = _pictures(spec, lines)
    for name, png in pictures.items():
        (folder / f"{name}.png").write_bytes(png)
    machine_readable = {"tables": [dataclasses.asdict(table) for table in found]}
    machine_readable |= {"claims": [dataclasses.asdict(claim) for claim in checked], "config": config}
    (folder / "tables.json").write_text(json.dumps(machine_readable, indent=1) + "\n", encoding="utf-8")
    (folder / "index.html").write_text(page(found, checked, pictures, _facts(lines, config)), encoding="utf-8")


def _pictures(spec: RunSpec, lines: Sequence[Line]) -> dict[str, bytes]:
    from service.bench.paper import illustrations  # loads matplotlib

    # Figures render answers again, so the scenes are needed; tables need the lines alone.
    subjects = {name: load(spec, name) for name in spec.scenes}
    found = {"figure1": illustrations.figure_1(next(iter(subjects.values())))}
    both = illustrations.figures_2_and_3(subjects, lines)
    if both:
        found |= {"figure2": both[0], "figure3": both[1]}
    if shares := illustrations.figure_4(lines):
        found["figure4"] = shares
    return found


def _facts(lines: Sequence[Line], config: Mapping[str, Any]) -> list[str]:
    """Return the paragraphs that hold for all numbers: scenes, seed, units, versions, source of published ones."""
    versions = Counter(line["code"] for line in lines)
    scenes = [
        f"{name} ({scene['gaussians']:,} Gaussians, {scene['test_photos']} test photos, {scene['layout']} layout)"
        for name, scene in config["scenes"].items()
    ]
    facts = [f"Scenes: {', '.join(scenes)}. The test photos were not trained on."]
    facts.append(f"{len(lines)} queries, seed {config['general']['seed']}, matcher {config['general']['matcher']}.")
    facts.append(
        "Units: the training cameras' median distance from the scene's focus is 4. Success: rotation and translation "
        "errors within both bounds, as published; whatever the verdict."
    )
    if len(versions) > 1:
        each = ", ".join(f"{code} {count}" for code, count in versions.items())
        facts.append(f"The lines are of {len(versions)} versions of the code (digest, lines): {each}.")
    facts.append(f"Published numbers: {published()['source']} Their scenes' models, photos and hardware are others.")
    return facts


def page(found: Sequence[Table], checked: Sequence[Claim], pictures: Mapping[str, bytes], facts: Sequence[str]) -> str:
    """Return the HTML page of tables, claims and pictures (PNG bytes by name)."""
    parts = ["<h1>splatfix: the paper, reproduced</h1>", *(f"<p>{escape(fact)}</p>" for fact in facts)]
    parts += ["<h2>The paper's claims, and the results here</h2>", _claims_html(checked)]
    parts += [_table_html(table) for table in found]
    for name, png in pictures.items():
        source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
        # The heading is the figure's number; the caption has the rest.
        title, _, rest = FIGURES[name].partition(":")
        parts.append(f"<h2>{title}</h2><p class=note>{escape(rest.strip())}</p>")
        parts.append(f'<img alt="{escape(FIGURES[name])}" src="{source}">')
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>splatfix: the paper, reproduced</title><style>{STYLE}</style><body>{''.join(parts)}</body></html>\n"
    )


def _claims_html(checked: Sequence[Claim]) -> str:
    words = {True: ("yes", "holds"), False: ("no", "does not hold"), None: ("", "equal")}
    rows = [
        f"<tr><td>{escape(claim.statement)}</td><td>{escape(claim.finding)}</td>"
        f'<td class="{words[claim.holds][0]}">{words[claim.holds][1]}</td></tr>'
        for claim in checked
    ]
    head = "<thead><tr><th>claim</th><th>result, on queries that both methods answered</th><th></th></tr></thead>"
    return f'<div class="scroll"><table>{head}<tbody>{"".join(rows)}</tbody></table></div>'


def _table_html(table: Table) -> str:
    notes = "".join(f"<p class=note>{escape(note)}</p>" for note in table.notes)
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    rows = []
    for row in table.rows:
        kind = ' class="published"' if "published" in row else ""
        rows.append(f"<tr{kind}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>")
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<h2>{escape(table.title)}</h2>{notes}<div class="scroll"><table>{body}</table></div>'
