"""The viewer's charts, by what their SVG draws: bars, wedges, curves and stages where the numbers are."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.geometry import moved
from service.results import IterationRecord
from service.types import Pose
from viewer import charts

HERE = Pose(np.eye(4))


def drawn(html: str) -> ET.Element:
    return ET.fromstring(f"<all>{html}</all>")


def numbers(element: ET.Element, *names: str) -> tuple[float, ...]:
    return tuple(float(element.attrib[name]) for name in names)


def texts(root: ET.Element) -> dict[str, tuple[float, ...]]:
    return {str(text.text): numbers(text, "x", "y") for text in root.iter("text")}


def record(index: int, stage: str = "match", **known: Any) -> IterationRecord:
    return IterationRecord(stage, HERE, index=index, **known)


# ------------------------------------------------------------------ histograms of match vectors


def test_lengths_have_bars_a_quarter_of_a_decade_wide_and_ticks_at_powers_of_ten() -> None:
    root = drawn(charts._length_histogram(np.repeat([3.0, 30.0, 300.0], [10, 20, 40])))
    bars = [numbers(bar, "x", "y", "width", "height") for bar in root.iter("rect")]
    wide = 164 / 12
    heights = {1: 30.0, 5: 60.0, 9: 120.0}  # of the quarter decades from 1 to 1000
    expected = [(i * wide + 0.5, 130 - heights.get(i, 0.0), wide - 1, heights.get(i, 0.0)) for i in range(12)]
    assert bars == [pytest.approx(each, abs=0.06) for each in expected]
    assert texts(root) == {f"{10**p:g}": pytest.approx((164 * p / 3, 145), abs=0.06) for p in range(4)}


def test_a_single_tiny_vector_adds_no_decades() -> None:
    lengths = np.r_[0.2, np.full(99, 30.0)]
    assert list(texts(drawn(charts._length_histogram(lengths)))) == ["10", "100"]
    # A decade at least, and nothing below what counts as a vector.
    assert list(texts(drawn(charts._length_histogram(np.full(9, 1e-6))))) == ["0.1", "1"]
    assert len(list(texts(drawn(charts._length_histogram(np.full(9, 10.0)))))) == 2


def test_directions_have_wedges_whose_areas_are_the_counts() -> None:
    counts = np.zeros(24)
    counts[[0, 6]] = 4.0, 1.0
    root = drawn(charts._polar_histogram(counts))
    wedges = [list(map(float, re.findall(r"-?[\d.]+", path.attrib["d"]))) for path in root.iter("path")]
    # M0 0 L ax ay A r r 0 0 1 bx by Z: a fourth of the area is half of the radius.
    assert [wedge[4] for wedge in wedges] == [62.0, *[0.0] * 5, 31.0, *[0.0] * 17]
    turn = np.radians(0.9 * 7.5)
    right, down = wedges[0], wedges[6]
    assert right[2:4] + right[9:11] == pytest.approx(
        [62 * np.cos(turn), -62 * np.sin(turn), 62 * np.cos(turn), 62 * np.sin(turn)], abs=0.06
    )
    # A quarter turn is downwards, as in the image.
    assert down[2:4] + down[9:11] == pytest.approx(
        [31 * np.sin(turn), 31 * np.cos(turn), -31 * np.sin(turn), 31 * np.cos(turn)], abs=0.06
    )
    assert sorted(numbers(ring, "r") for ring in root.iter("circle")) == [(31.0,), (62.0,)]
    assert texts(root) == {"0°": (72, 3), "90°": (0, 74), "180°": (-72, 3), "270°": (0, -67)}


def test_the_caption_tells_the_median_length() -> None:
    def told(*vectors: tuple[float, float]) -> str:
        view: Any = SimpleNamespace(inlier=np.ones(len(vectors), bool), vectors_px=np.array(vectors, float))
        return " ".join(caption.text or "" for caption in drawn(charts.vectors_html(view)).iter("figcaption"))

    assert "lengths: 5 px, the median" in told((3, 4), (0, 1), (30, 40))
    assert "angles: 90° between two, on average" in told((10, 0), (0, 10))
    assert f"below {charts.MIN_VECTOR_PX}" in told((0, 0.9 * charts.MIN_VECTOR_PX))
    assert f"lengths: {charts.MIN_VECTOR_PX:.3g} px" in told((0, charts.MIN_VECTOR_PX))
    assert "no vector is long enough" in told((0, 0.9 * charts.MIN_VECTOR_PX))
    nothing: Any = SimpleNamespace(inlier=np.ones(1, bool), vectors_px=np.full((1, 2), np.nan))
    assert "No match is in view" in charts.vectors_html(nothing)


# ------------------------------------------------------------------ curves over the steps


def chart(html: str, label: str) -> ET.Element:
    return next(svg for svg in drawn(html).iter("svg") if svg.attrib["aria-label"] == f"{label} by step")


def dots(svg: ET.Element) -> list[tuple[float, ...]]:
    return [numbers(dot, "cx", "cy") for dot in svg.iter("circle")]


def test_a_curve_has_a_dot_where_each_value_is_and_a_gap_where_none_is() -> None:
    values = [0.0, 5.0, None, 10.0, 2.5]
    records = [record(k, step_deg=value) for k, value in enumerate(values)]
    svg = chart(charts.curves_html(records, None, 3), "rotation step, degrees")
    # Steps from 50 to 382, values from 90 up to 8.
    at = [(50 + 83 * k, 90 - 8.2 * value) for k, value in enumerate(values) if value is not None]
    assert dots(svg) == [pytest.approx(each, abs=0.06) for each in at]
    assert [dot.findtext("title") for dot in svg.iter("circle")] == [
        "step 0: 0", "step 1: 5", "step 3: 10", "step 4: 2.5"
    ]  # fmt: skip
    curve = next(path.attrib["d"] for path in svg.iter("path") if path.attrib.get("fill") == "none")
    assert re.findall(r"[ML]", curve) == ["M", "L", "M", "L"]
    mark = next(path.attrib["d"] for path in svg.iter("path") if path.attrib["stroke"] == "#fff")
    assert mark == "M299.0 6V92"
    # Round values along the left, the first and the last step below.
    labels = [(text.text, *numbers(text, "x", "y")) for text in svg.iter("text")]
    assert labels == [
        *((f"{value}", 41.0, pytest.approx(93 - 8.2 * value, abs=0.06)) for value in (0, 2, 4, 6, 8, 10)),
        ("0", 50.0, 102.0),
        ("4", 382.0, 102.0),
    ]
    assert svg.attrib["viewBox"] == "0 0 390 104"


@pytest.mark.parametrize(("largest", "logarithmic"), [(30.0, False), (31.0, True)])
def test_more_than_one_and_a_half_decades_are_drawn_logarithmically(largest: float, logarithmic: bool) -> None:
    records = [record(k, loss=value) for k, value in enumerate((1.0, 10.0, largest))]
    heights = [y for _, y in dots(chart(charts.curves_html(records, None, 0), "loss"))]
    # From 1 to 100, or from 0 to the largest.
    expected = [90 - 41 * np.log10(v) if logarithmic else 90 - 82 * v / largest for v in (1.0, 10.0, largest)]
    assert heights == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(
    ("values", "logarithmic", "ticks"),
    [((0.02, 0.5, 2.0), True, [0.01, 0.1, 1, 10]), ((-4.0, 1.0, 4.0), False, [-4, -2, 0, 2, 4]),
     ((0.1, 1.0, 2.9), False, [0, 1, 2])],
)  # fmt: skip
def test_values_lie_among_the_lines_of_their_axis(
    values: tuple[float, ...], logarithmic: bool, ticks: list[float]
) -> None:
    svg = chart(charts.curves_html([record(k, loss=value) for k, value in enumerate(values)], None, 0), "loss")
    labels = [(float(text.text or ""), *numbers(text, "x", "y")) for text in svg.iter("text")][: len(ticks)]
    assert [value for value, *_ in labels] == pytest.approx(ticks)
    # Each has a line across, three above the text's base.
    lines = [re.fullmatch(r"M46 ([\d.]+)H386", path.attrib["d"]) for path in svg.iter("path")]
    heights = [float(line[1]) for line in lines if line]
    assert heights == pytest.approx([y - 3 for *_, y in labels], abs=0.06)
    scale = np.log10 if logarithmic else np.float64
    expected = np.interp(scale(values), scale(ticks), heights) if ticks[-1] >= values[-1] else None
    if expected is not None:
        assert [y for _, y in dots(svg)] == pytest.approx(expected, abs=0.11)


def test_a_loss_of_one_stage_has_the_stages_colour() -> None:
    records = [record(k, "refine", loss=value) for k, value in enumerate((1.0, 2.0))]
    (line,) = [p for p in chart(charts.curves_html(records, None, 0), "loss").iter("path") if p.get("fill") == "none"]
    assert line.attrib["stroke"] == charts.stage_colours(records)["refine"]


def test_losses_have_a_curve_a_stage_and_lengths_are_in_metres_where_the_scale_is_known() -> None:
    records = [record(0, "match", loss=1.0, step_units=2.0), record(1, "refine", loss=2.0, step_units=4.0)]
    html = charts.curves_html(records, None, 0, 2.5)
    assert len(dots(chart(html, "loss"))) == 2
    lines = [path for path in chart(html, "loss").iter("path") if path.attrib.get("fill") == "none"]
    assert [line.attrib["stroke"] for line in lines] == list(charts.stage_colours(records).values())
    assert [t.text for t in chart(html, "position step, m").iter("title") if "step" in str(t.text)] == [
        "step 0: 5", "step 1: 10"
    ]  # fmt: skip
    truth = moved(HERE, np.array([0, 0, np.radians(3), 0.5, 0, 0]))
    html = charts.curves_html(records, truth, 0, 2.5)
    assert "step 1: 3<" in html
    assert "step 1: 1.25<" in html
    assert "position error, units" in charts.curves_html(records, truth, 0)
    many = [record(k, num_matches=k + 5, num_inliers=k) for k in range(61)]
    assert dots(chart(charts.curves_html(many, None, 0), "matches and inliers")) == []
    assert len(dots(chart(charts.curves_html(many[:60], None, 0), "matches and inliers"))) == 120


def test_bands_and_strip_show_each_stage_over_its_steps() -> None:
    records = [record(k, "match" if k < 2 else "refine", step_deg=1.0) for k in range(5)]
    svg = chart(charts.curves_html(records, None, 0), "rotation step, degrees")
    bands = [numbers(band, "x", "y", "width", "height") for band in svg.iter("rect")]
    # Half a step to either side of each.
    assert bands == [pytest.approx((8.5, 4, 166, 86), abs=0.06), pytest.approx((174.5, 4, 249, 86), abs=0.06)]
    assert [band.findtext("title") for band in svg.iter("rect")] == ["Match with a view", "Refine the pose by pixels"]
    strip = charts.stages_html(records, 3)
    places = re.findall(r"title='([\w ]+): (\d) steps' style='position:absolute;left:([\d.]+)%;width:([\d.]+)%", strip)
    assert places == [("Match with a view", "2", "0.00", "37.50"), ("Refine the pose by pixels", "3", "37.50", "62.50")]
    assert "left:calc(75.00% - 1.5px)" in strip
    assert re.findall(r"</i>([\w ]+)</span>", strip) == ["Match with a view", "Refine the pose by pixels"]
    for colour in charts.stage_colours(records).values():
        assert strip.count(colour) == 2  # in the strip and beside its name


def test_after_eight_stages_colours_repeat() -> None:
    colours = list(charts.stage_colours([record(k, f"s{k}") for k in range(9)]).values())
    assert len(set(colours)) == 8
    assert colours[8] == colours[0]
